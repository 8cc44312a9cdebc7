"""How it is measured: how much, what controllers, what counts, and what a process needs."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import msgspec

from turgor.bench.report import say

SEED = 0  # of controllers and of the evolution that finds evolved ones
MILLION = 1e6


class Plan(msgspec.Struct, frozen=True):
    """How much is measured; the defaults are the whole benchmark."""

    bodies: tuple[str, ...] = ("small", "medium", "large")
    tasks: tuple[str, ...] = ("hilly", "escape")
    controllers: tuple[str, ...] = ("random", "inflated", "evolved")
    batches: tuple[int, ...] = (1, 20, 1024)
    threads: tuple[int, ...] = (1, 2)
    steps: int = 1800  # of a rollout
    seconds: float = 0.5  # of measuring, at least, for every row
    repeats: int = 3  # at least
    generations: int = 80  # of the evolution behind evolved controllers
    curve_bodies: tuple[str, ...] = ("small", "large")  # of `scaling`
    curve_batches: tuple[int, ...] = (1, 2, 4, 8, 16, 20, 24, *(2**k for k in range(5, 15)))
    curve_masses: tuple[int, ...] = (10, 15, 20, 30, 40, 60, 80, 120, 160, 200)
    curve_segments: tuple[int, ...] = (10, 30, 100, 300, 1000, 3000, 10_000)
    curve_agents: int = 64  # of every number of masses and segments
    curve_crowd: int = 4096  # agents of every number of threads
    curve_steps: int = 600
    curve_seconds: float = 0.2  # of measuring, at least, for every point and for environments
    environment_bodies: tuple[str, ...] = ("small", "large")
    environments: tuple[int, ...] = (64, 1024)
    memory_body: str = "large"
    memory_agents: int = 10_000
    starts: int = 5  # of a process
    evaluations: int = 10_000
    peer_bodies: tuple[str, ...] = ("large", "small")
    peer_agents: int = 6  # that the peer runs, one after the other
    peer_batch: int = 1024  # that the engine runs beside it
    evogym: str | None = None  # a Python that has EvoGym
    evogym_robots: int = 2  # one after the other
    evogym_steps: int = 100  # of each: on the ground of its walking task a step takes about a millisecond


QUICK = Plan(
    bodies=("large",),
    batches=(1, 20, 256),
    seconds=0.1,
    generations=20,
    curve_bodies=("small",),
    curve_batches=(1, 8, 16, 20, 24, 64, 1024),
    curve_masses=(10, 40, 120),
    curve_segments=(10, 300, 10_000),
    curve_agents=32,
    curve_crowd=512,
    curve_steps=120,
    curve_seconds=0.05,
    environment_bodies=("small",),
    environments=(64,),
    memory_agents=2000,
    starts=2,
    evaluations=1000,
    peer_bodies=("large",),
    peer_agents=2,
    peer_batch=256,
    evogym_robots=1,
    evogym_steps=50,
)


class Skipped(Exception):
    """A part that cannot be measured here; says why."""


def fastest(calls: Sequence[Callable[[], object]], seconds: float, repeats: int) -> list[float]:
    """Shortest time [s] of each of `calls`. They take turns, so that what slows one slows all; at least `repeats`
    rounds, and more until every call has had `seconds`."""
    best, spent, rounds = [float("inf")] * len(calls), [0.0] * len(calls), 0
    while rounds < repeats or min(spent) < seconds:
        for k, call in enumerate(calls):
            began = time.perf_counter()
            call()
            took = time.perf_counter() - began
            best[k], spent[k] = min(best[k], took), spent[k] + took
        rounds += 1
    return best


@cache
def make_task(name: str, body: str, steps: int, kind: str = "random") -> Any:
    """The benchmark's `Task` for a kind of controllers: terrain 0, pressure and springs controlled. "inflated" bodies
    keep their gas, because their pressure moves by the paper's 1 Pa per unit of output, 27 to 53 times less."""
    from turgor.task import make_task

    unit = 1.0 if kind == "inflated" else None
    return make_task(name, body=body, condition="pressure", seed=SEED, steps=steps, pressure_unit=unit)


def controllers(kind: str, task: Any, agents: int, generations: int) -> Any:
    """Controllers theta [agent, parameter]: "random" and "inflated" (uniform in [-1, 1]) or "evolved"; the first are
    the same whatever `agents`."""
    import numpy as np

    if kind != "evolved":
        return np.random.default_rng(SEED).uniform(-1, 1, (agents, task.parameter_count))
    champion, strategy, drawn = evolved(task, generations)
    while len(drawn) < agents:
        drawn.extend(strategy.ask())
    return np.array([champion, *drawn[: agents - 1]])


@cache
def evolved(task: Any, generations: int) -> tuple[Any, Any, list[Any]]:
    """The champion of a short CMA-ES run, its strategy, whose draws are the population around it, and no draws yet."""
    import numpy as np

    from turgor.evolution.cma_es import CMAES
    from turgor.simulate import Simulator

    say(f"evolving controllers: {task.name}, {task.body.mass_count} masses, {generations} generations")
    simulator = Simulator(task)
    strategy = CMAES(task.parameter_count, np.random.default_rng(SEED))
    best, champion = -np.inf, None
    for _ in range(generations):
        theta = strategy.ask()
        fitness = simulator.rollout(theta).fitness
        strategy.tell(theta, fitness)
        if fitness.max() > best:
            best, champion = fitness.max(), theta[fitness.argmax()]
    return champion, strategy, []


def run_python(*arguments: str, **environment: str) -> tuple[float, str]:
    """Wall time [s] from the start to the end of a Python process, and what it printed."""
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *arguments], env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    took = time.perf_counter() - began
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing on stderr"])[-1]
        raise RuntimeError(f"a process of the benchmark ended with status {done.returncode}: {last}")
    return took, done.stdout


def usable_threads(threads: Sequence[int]) -> list[int]:
    """Those numbers of threads that there are cores for."""
    from turgor.simulate import available_cores

    usable = [t for t in threads if t <= available_cores()]
    if len(usable) < len(threads):
        say(f"{available_cores()} core: no rows with more threads than that")
    return usable


def peak_memory() -> int:
    """Peak resident memory of this process [byte]. Raises `Skipped` on Windows, which does not tell."""
    try:  # of this program alone; the other counts its parent until it was loaded
        with open("/proc/self/status", encoding="ascii") as file:
            return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmHWM"))
    except OSError:
        pass
    if sys.platform == "win32":
        raise Skipped("peak memory is not told on Windows")
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def warm_up() -> None:
    """Has the engine compiled and in its file."""
    import numpy as np

    from turgor.simulate import Simulator

    task = make_task("hilly", "small", 1)
    Simulator(task).rollout(np.zeros((1, task.parameter_count)))
