"""How fast the engine runs on this machine's GPU: `python benchmarks/gpu.py`, about five minutes.

Needs an NVIDIA GPU and the extra `cuda`. First some agents of each kind run on the CPU as well, and their bits are
compared. Then whole rollouts of 1800 steps on hilly ground for growing batches, the fastest of several: "kernel"
counts the time in the GPU's code, "call" also what goes there and back. Controllers: "random" has theta uniform in
[-1, 1], "inflated" the same with pressure moving by 1 Pa per unit of output, so that bodies keep their gas. theta is
float32.
"""

import argparse
import csv
import sys
import time
from datetime import UTC, datetime

import numpy as np

import turgor
from turgor.simulate import open_gpu

KINDS = {"random": {}, "inflated": {"pressure_unit": 1.0}}
COLUMNS = ("device", "date", "turgor", "body", "controllers", "batch", "kernel", "call", "seconds", "same_bits")


def simulators(body, kind, steps):
    """A simulator on either device, and what draws controllers for them."""
    task = turgor.make_task("hilly", body=body, steps=steps, **KINDS[kind])

    def theta(agents):
        return np.random.default_rng(0).uniform(-1, 1, (agents, task.parameter_count)).astype(np.float32)

    return turgor.Simulator(task, device="cuda"), turgor.Simulator(task), theta


def same_bits(gpu, cpu, theta):
    """Whether agents end at the same bits, and how far apart they end at most [m]."""
    mine, expected = (simulator.rollout(theta).position for simulator in (gpu, cpu))
    return mine.tobytes() == expected.tobytes(), float(np.abs(mine - expected).max())


def fastest(simulator, device, theta, repeats):
    """Million agent-steps/s of the kernel and of the call, and the call's seconds: the best of some."""
    calls, kernels = [], []
    for _ in range(repeats):
        began, busy = time.perf_counter(), device.busy
        steps = simulator.rollout(theta).steps.sum()
        calls.append(time.perf_counter() - began)
        kernels.append(device.busy - busy)
    return steps / min(kernels) / 1e6, steps / min(calls) / 1e6, min(calls)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--bodies", nargs="+", default=["large", "small"])
parser.add_argument("--batches", nargs="+", type=int, default=[1024, 4096, 16_384, 65_536, 262_144])
parser.add_argument("--repeats", type=int, default=3)
parser.add_argument("--steps", type=int, default=1800)
parser.add_argument("--compared", type=int, default=512, help="agents that run on the CPU as well")
parser.add_argument("--csv", help="a file for the rows")
options = parser.parse_args()

try:
    device = open_gpu().device
except turgor.InvalidInput as error:
    sys.exit(f"gpu: {error}")
rows = []
print(f"{device.name}; million agent-steps/s")
for body in options.bodies:
    for kind in KINDS:
        gpu, cpu, theta = simulators(body, kind, options.steps)
        same, apart = same_bits(gpu, cpu, theta(options.compared))
        print(f"{body}, {kind}: {options.compared} agents end", "at the CPU's bits" if same else f"{apart:.3g} m apart")
        for batch in options.batches:
            kernel, call, seconds = fastest(gpu, device, theta(batch), options.repeats)
            print(f"{batch:>9} agents  kernel {kernel:8.2f}  call {call:8.2f}  {seconds:7.2f} s", flush=True)
            today = f"{datetime.now(UTC):%Y-%m-%d}"
            numbers = [f"{number:.4g}" for number in (kernel, call, seconds)]
            rows.append([device.name, today, turgor.__version__, body, kind, batch, *numbers, same])
if options.csv:
    with open(options.csv, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
