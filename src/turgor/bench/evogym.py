"""Robots of EvoGym, in a process of their own, because EvoGym is for other Pythons than turgor.

The process (benchmarks/evogym_peer.py) waits until it is asked for a turn and times that itself, so that it can take
turns with the engine: neither its start nor what the two say to each other counts.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import IO

import msgspec

from turgor.errors import InvalidInput, describe

PROGRAM = Path(__file__).parents[3] / "benchmarks" / "evogym_peer.py"  # not part of the installed package
WORLDS = ("plane", "Walker-v0")  # the ground within EvoGym's physics, and the voxels of its walking task
TRY = "import evogym.simulator_cpp; print('EvoGym is here')"


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """What the program tells of its robot."""

    robot: str  # how many voxels
    masses: int
    springs: int
    actuators: int
    masses_in_world: int
    step: float  # [s], as EvoGym has it
    fall: float  # [s]: how long a mass takes to fall as far as its neighbour is away
    version: str


class Turn(msgspec.Struct, frozen=True, kw_only=True):
    """What the program tells of all its robots, moved one after the other from start to end."""

    seconds: float
    simulator: float  # [s], of those in EvoGym's C++
    steps: int  # that were taken
    voxels: list[float]  # how far each has come


class Robots:
    """The program at work in a world; raises `RuntimeError` where it fails."""

    def __init__(self, process: subprocess.Popen[bytes], errors: IO[bytes], world: str) -> None:
        self.process, self.errors, self.world = process, errors, world
        self.facts = msgspec.json.decode(self.answer(), type=Facts)
        self.turns: list[Turn] = []

    def turn(self) -> None:
        """All robots from start to end, once more; adds to `turns`."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):  # where the program has ended: its answer tells
            self.process.stdin.write(b"\n")
        self.turns.append(msgspec.json.decode(self.answer(), type=Turn))

    def fastest(self) -> Turn:
        """The turn with most steps a second."""
        return max(self.turns, key=lambda turn: turn.steps / turn.seconds)

    def answer(self) -> bytes:
        """The program's next line."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.errors.seek(0)
            last = self.errors.read().decode(errors="replace").strip().splitlines()[-1:]
            raise RuntimeError(f"{PROGRAM.name} ended: {(last or ['nothing on stderr'])[0]}")
        return line


@contextlib.contextmanager
def robots_at_work(python: str, body: str, world: str, robots: int, steps: int) -> Generator[Robots]:
    """`Robots` in a world of WORLDS, for as long as the `with` block lasts."""
    how = [body, world, "--robots", str(robots), "--steps", str(steps), "--serve"]
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(
            [python, str(PROGRAM), *how], env=surroundings(python), bufsize=0,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
        ) as process,
    ):  # fmt: skip
        try:
            yield Robots(process, errors, world)
        finally:
            process.kill()  # it keeps nothing


def find_python(named: str | None) -> str | None:
    """A Python that has EvoGym: the one that is named, or else this one; None where neither. Raises `InvalidInput`
    for a named one that does not."""
    if named is None:
        return sys.executable if importlib.util.find_spec("evogym") and has_evogym(sys.executable) else None
    if not PROGRAM.exists():
        expected = "--evogym: expected turgor's repository, which has benchmarks/evogym_peer.py"
        raise InvalidInput(expected, "an installed package")
    if not has_evogym(named):
        raise InvalidInput("--evogym: expected a Python that can import evogym", describe(named))
    return named


def has_evogym(python: str) -> bool:
    """Whether EvoGym's simulator can be loaded there."""
    try:
        done = subprocess.run(
            [python, "-c", TRY], env=surroundings(python), capture_output=True, text=True, check=False, timeout=120
        )
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return False
    return "EvoGym is here" in done.stdout


def surroundings(python: str) -> dict[str, str]:
    """The environment of a process: one thread; of another Python, without the paths that are meant for this one."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
    ours = () if python == sys.executable else ("PYTHONPATH", "PYTHONHOME")
    return {name: value for name, value in os.environ.items() if name not in ours} | dict.fromkeys(names, "1")
