"""Does the engine run on this machine's GPU, with the CPU's bits, and how fast? `python benchmarks/gpu.py`

Needs an NVIDIA GPU and its driver. First what was found, and how long it took to make PTX and to have the driver
assemble it. Then tests/test_cuda.py, which compares bits on that GPU. Then whole rollouts of 1800 steps on hilly ground
for growing batches, the fastest of several: "kernel" counts the time in the GPU's code, "call" also what goes there and
back. Controllers: "random" has theta uniform in [-1, 1], "inflated" the same with pressure moving by 1 Pa per unit of
output, so that bodies keep their gas. theta is float32. The rates are measured even where tests fail; the exit status
is then 1.
"""

import argparse
import csv
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

import turgor
from turgor.bench.measuring import controllers, make_task
from turgor.physics.driver import Device
from turgor.physics.engine import ENTRY, PTX, code_of
from turgor.physics.gpu import first_gpu

TESTS = Path(__file__).parents[1] / "tests" / "test_cuda.py"
COLUMNS = ("device", "date", "turgor", "body", "controllers", "batch", "kernel", "call", "seconds")


def look() -> Device:
    """This machine's GPU, after telling of it."""
    device = Device()
    print(f"{device.name}, {device.free_bytes() / 1e9:.1f} GB of memory are free")
    began = time.perf_counter()
    code = code_of(PTX, lambda: None)
    made = time.perf_counter()
    device.load(code, ENTRY)
    print(f"PTX: {made - began:.1f} s; assembled by the driver, which keeps it: {time.perf_counter() - made:.1f} s")
    return first_gpu().device


def fastest(simulator, device, theta, repeats):
    """Million agent-steps/s of the kernel and of the call, and the call's seconds: the best of some."""
    calls, kernels = [], []
    for _ in range(repeats):
        began, busy = time.perf_counter(), device.busy
        steps = simulator.rollout(theta).steps.sum()
        calls.append(time.perf_counter() - began)
        kernels.append(device.busy - busy)
    return steps / min(kernels) / 1e6, steps / min(calls) / 1e6, min(calls)


def measure(device, options):
    """Rows of COLUMNS."""
    print("million agent-steps/s:")
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    for body in options.bodies:
        for kind in ("random", "inflated"):
            task = make_task("hilly", body, options.steps, kind)
            simulator = turgor.Simulator(task, device="cuda")
            for batch in options.batches:
                theta = controllers(kind, task, batch, 0).astype(np.float32)
                rates = fastest(simulator, device, theta, options.repeats)
                kernel, call, seconds = (f"{number:.4g}" for number in rates)
                print(
                    f"{body:>6} {kind:>9} {batch:>8} agents  kernel {kernel:>7}  call {call:>7}  {seconds:>6} s",
                    flush=True,
                )
                yield [device.name, today, turgor.__version__, body, kind, batch, kernel, call, seconds]


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--bodies", nargs="+", default=["large", "small"])
parser.add_argument("--batches", nargs="+", type=int, default=[1024, 4096, 16_384, 65_536, 262_144])
parser.add_argument("--repeats", type=int, default=3)
parser.add_argument("--steps", type=int, default=1800)
parser.add_argument("--csv", help="a file for the rows")
options = parser.parse_args()

try:
    device = look()
except turgor.InvalidInput as error:
    sys.exit(f"gpu: {error}")
failed = subprocess.run([sys.executable, "-m", "pytest", "-q", "-rs", str(TESTS)]).returncode
rows = list(measure(device, options))
if options.csv:
    with open(options.csv, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
sys.exit(1 if failed else 0)
