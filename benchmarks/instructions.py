"""Counts the instructions that fixed rollouts take, under valgrind: unlike seconds, the same on a busy machine.

./run python benchmarks/instructions.py            # measures, and compares with instructions.csv
./run python benchmarks/instructions.py --write    # and writes the file, in the change that made them other

The engine is compiled for AVX2 (an Intel Haswell), because valgrind knows no AVX-512: the same source, half as wide.
Counted is `Simulator.rollout` alone, engine loaded and warm, one thread. A test fails where counts have grown by more
than 5 % and the file has not been written anew.
"""

from __future__ import annotations

import argparse
import csv
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

FILE = Path(__file__).with_name("instructions.csv")
GROWTH = 0.05  # [1], that is let pass
AGENTS, STEPS = 32, 600
CASES = {
    "small, random": ("small", "random"),
    "large, random": ("large", "random"),
    "large, inflated": ("large", "inflated"),
}
FEATURES = "+avx,+avx2,+fma,+sse,+sse2,+sse3,+sse4.1,+sse4.2,+ssse3"
TARGET = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": FEATURES}

# Run under valgrind, which starts to count when it is told to from inside.
CHILD = """
import os, subprocess, sys
from turgor.bench.measuring import controllers, make_task
from turgor.simulate import Simulator

def count(on):
    command = ["callgrind_control", "-i", "on" if on else "off", str(os.getpid())]
    subprocess.run(command, check=True, capture_output=True)

body, kind, agents, steps = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
task = make_task("hilly", body, steps, kind)
theta = controllers(kind, task, agents, 0)
simulator = Simulator(task, threads=1)
simulator.rollout(theta)
count(True)
simulator.rollout(theta)
count(False)
"""


def count(case: str) -> int:
    """Instructions of the rollout of a `case`. Raises `RuntimeError` where valgrind does not count."""
    environment = {**os.environ, **TARGET, "PYTHONHASHSEED": "0"}
    load = "from turgor.physics.batch import load_kernel; load_kernel()"
    subprocess.run([sys.executable, "-c", load], env=environment, check=True, capture_output=True)  # into the cache
    with tempfile.TemporaryDirectory() as folder:
        command = ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={folder}/out"]
        command += [sys.executable, "-c", CHILD, *CASES[case], str(AGENTS), str(STEPS)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
    found = re.search(r"Collected\s*:\s*(\d+)", done.stderr)
    if done.returncode or not found:
        raise RuntimeError(done.stderr[-2000:])
    return int(found[1])


def recorded() -> dict[str, int]:
    """The counts in instructions.csv, by case."""
    with open(FILE, encoding="utf-8", newline="") as file:
        return {row["case"]: int(row["instructions"]) for row in csv.DictReader(file)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write instructions.csv")
    options = parser.parse_args()
    before = recorded() if FILE.exists() else {}
    counts = {}
    for case in CASES:
        counts[case] = count(case)
        change = f", {counts[case] / before[case] - 1:+.2%}" if case in before else ""
        print(f"{case}: {counts[case]:,}, {counts[case] / (AGENTS * STEPS):,.0f} an agent-step{change}", flush=True)
    if options.write:
        with open(FILE, "w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["case", "agents", "steps", "instructions"])
            writer.writerows([case, AGENTS, STEPS, n] for case, n in counts.items())


if __name__ == "__main__":
    main()
