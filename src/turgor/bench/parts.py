"""What is measured: every part of the benchmark yields its rows, as many and as large as the plan says."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from turgor.bench.report import Row, say

SEED = 0  # of controllers and of the evolution that finds evolved ones
MILLION = 1e6
PEER = Path(__file__).parents[3] / "benchmarks" / "box2d_peer.py"  # not part of the installed package


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
    memory_body: str = "large"
    memory_agents: int = 10_000
    starts: int = 5  # of a process
    evaluations: int = 10_000
    peer_bodies: tuple[str, ...] = ("large", "small")
    peer_agents: int = 6  # that the peer runs, one after the other
    peer_batch: int = 1024  # that the engine runs beside it


QUICK = Plan(
    bodies=("large",),
    batches=(1, 20, 256),
    seconds=0.1,
    generations=20,
    memory_agents=2000,
    starts=2,
    evaluations=1000,
    peer_bodies=("large",),
    peer_agents=2,
    peer_batch=256,
)


class Skipped(Exception):
    """A part that cannot be measured here; says why."""


# --- measuring --------------------------------------------------------------------------------------------------------


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


# --- the parts --------------------------------------------------------------------------------------------------------


def kernel(plan: Plan) -> Iterator[Row]:
    """Rows: million agent-steps/s of whole rollouts, sensing and control included."""
    threads = usable_threads(plan.threads)
    for body in plan.bodies:
        for name in plan.tasks:
            for kind in plan.controllers:
                for batch in plan.batches:
                    yield from kernel_rows(plan, body, name, kind, batch, threads)


def kernel_rows(plan: Plan, body: str, name: str, kind: str, batch: int, threads: list[int]) -> Iterator[Row]:
    """Rows of one batch: one for each number of threads, measured in turn; how they compare for the largest batch."""
    from turgor.simulate import Simulator

    task = make_task(name, body, plan.steps, kind)
    theta = controllers(kind, task, batch, plan.generations)
    simulators = [Simulator(task, threads=t) for t in threads]
    agent_steps = int(simulators[0].rollout(theta).steps.sum())
    calls = [lambda simulator=simulator: simulator.rollout(theta) for simulator in simulators]
    rates = [agent_steps / took / MILLION for took in fastest(calls, plan.seconds, plan.repeats)]
    same: dict[str, Any] = {"body": body, "task": name, "controllers": kind, "batch": batch}
    what = f"rollouts of {plan.steps} steps at most, {agent_steps} agent-steps taken"
    for t, rate in zip(threads, rates, strict=True):
        yield Row(name="kernel", **same, threads=t, value=rate, unit="M agent-steps/s", what=what)
    if batch == max(plan.batches):
        for t, rate in zip(threads[1:], rates[1:], strict=True):
            what = f"{t} threads against {threads[0]}, measured in turn"
            yield Row(name="kernel.scaling", **same, threads=t, value=rate / rates[0], unit="times", what=what)


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


MEMORY = """
import sys, numpy, turgor
from turgor.bench.parts import peak_memory
body, agents, steps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
task = turgor.make_task("hilly", body=body, steps=steps)
theta = numpy.random.default_rng(0).uniform(-1, 1, (agents, task.parameter_count))
simulator = turgor.Simulator(task)
simulator.rollout(theta)
print(peak_memory(), theta.nbytes, simulator.threads)
"""


def memory(plan: Plan) -> Iterator[Row]:
    """The row: peak memory of a process that does one large rollout."""
    if os.name == "nt":
        raise Skipped("peak memory is not told on Windows")
    warm_up()
    _, out = run_python("-c", MEMORY, plan.memory_body, str(plan.memory_agents), str(plan.steps))
    peak, given, threads = map(int, out.split())
    what = f"peak resident memory of a process that does one rollout; {given / MILLION:.0f} MB of it are theta"
    yield Row(name="memory.peak", body=plan.memory_body, task="hilly", controllers="random", batch=plan.memory_agents,
              threads=threads, value=peak / MILLION, unit="MB", what=what)  # fmt: skip


FIRST_ROLLOUT = """
import numpy, turgor
task = turgor.make_task()
turgor.Simulator(task).rollout(numpy.zeros((1, task.parameter_count)))
"""


def startup(plan: Plan) -> Iterator[Row]:
    """Rows: wall time of whole processes, from their start to their end."""
    programs = {
        "startup.python": (("-c", "pass"), "Python itself: part of all the other start-up rows"),
        "startup.import": (("-c", "import turgor"), "import turgor"),
        "startup.help": (("-m", "turgor", "--help"), "turgor --help"),
    }
    if not (importlib.util.find_spec("turgor.cli") and importlib.util.find_spec("turgor.__main__")):
        say("no command line here: no row for turgor --help")
        del programs["startup.help"]
    for name, (arguments, what) in programs.items():
        yield Row(name=name, value=quickest_start(plan, *arguments), unit="s", what=what)
    rollout: dict[str, Any] = {"body": "small", "task": "hilly", "batch": 1, "unit": "s"}
    with tempfile.TemporaryDirectory() as cache:
        cold, _ = run_python("-c", FIRST_ROLLOUT, NUMBA_CACHE_DIR=cache)
        what = "process start to the result of the first rollout, the engine compiled on the way"
        yield Row(name="startup.cold", **rollout, value=cold, what=what)
        warm = quickest_start(plan, "-c", FIRST_ROLLOUT, NUMBA_CACHE_DIR=cache)
        what = "process start to the result of the first rollout, the engine from its file"
        yield Row(name="startup.warm", **rollout, value=warm, what=what)
        what = "startup.cold less startup.warm: what compiling takes"
        yield Row(name="startup.compile", value=cold - warm, unit="s", what=what)


def quickest_start(plan: Plan, *arguments: str, **environment: str) -> float:
    """Shortest wall time [s] of a process that Python starts with `arguments`; the first start does not count."""
    run_python(*arguments, **environment)
    return min(run_python(*arguments, **environment)[0] for _ in range(plan.starts))


def warm_up() -> None:
    """Has the engine compiled and in its file."""
    import numpy as np

    from turgor.simulate import Simulator

    task = make_task("hilly", "small", 1)
    Simulator(task).rollout(np.zeros((1, task.parameter_count)))


EVOLUTION = """
import json, sys, turgor
import numpy as np
run = turgor.evolve(turgor.make_task(), evaluations=int(sys.argv[1]), seed=0, out=sys.argv[2])
best = run.champion
print(json.dumps({"seconds": run.seconds, "best": best.fitness, "robust": float(np.median(best.robust)),
                  "population": run.settings.population, "threads": run.settings.threads}))
"""


def evolution(plan: Plan) -> Iterator[Row]:
    """Rows: how long the default evolution takes, where the time goes, and what comes out."""
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        wall, out = run_python("-c", EVOLUTION, str(plan.evaluations), str(Path(folder) / "run"))
    told = json.loads(out.splitlines()[-1])
    what = f"{plan.evaluations} evaluations, seed 0"
    figures = [
        ("evolution.wall", wall, "s", f"{what}: the whole process, engine cached, no video"),
        ("evolution.simulation", told["seconds"]["simulation"], "s", f"{what}: of which in rollouts"),
        ("evolution.strategy", told["seconds"]["strategy"], "s", f"{what}: of which in CMA-ES"),
        ("evolution.best", told["best"], "m/s", f"{what}: fitness of the champion"),
        ("evolution.robust", told["robust"], "m/s", f"{what}: median of the champion's perturbed starts"),
    ]
    for name, value, unit, what in figures:
        yield Row(name=name, body="small", task="hilly", controllers="evolved", batch=told["population"],
                  threads=told["threads"], value=value, unit=unit, what=what)  # fmt: skip


def peer(plan: Plan) -> Iterator[Row]:
    """Rows: the same agent in a pybox2d program and in the engine, in turn, both on one core."""
    box2d_peer = load_peer()
    for body in plan.peer_bodies:
        for kind in plan.controllers:
            yield from peer_rows(plan, box2d_peer, body, kind)


def peer_rows(plan: Plan, box2d_peer: Any, body: str, kind: str) -> Iterator[Row]:
    """Rows of one body: three rates, the engine's two against the peer's, and how far apart their agents are."""
    from threadpoolctl import threadpool_limits

    from turgor.simulate import Simulator

    task = make_task("hilly", body, plan.steps, kind)
    simulator = Simulator(task, threads=1)
    many = controllers(kind, task, plan.peer_batch, plan.generations)
    few = many[: plan.peer_agents]

    def each(run: Callable[[Any], object]) -> None:
        for theta in few:
            run(theta)

    calls = [
        lambda: each(lambda theta: box2d_peer.rollout(task, theta)),
        lambda: each(lambda theta: simulator.rollout(theta[None])),
        lambda: simulator.rollout(many),
    ]
    with threadpool_limits(1):
        times = fastest(calls, plan.seconds, plan.repeats)
    agents, batches = [len(few), len(few), len(many)], [1, 1, len(many)]
    rates = [n * plan.steps / took / MILLION for n, took in zip(agents, times, strict=True)]
    same: dict[str, Any] = {"body": body, "task": "hilly", "controllers": kind, "threads": 1}
    subjects = ("pybox2d, ", "the engine, ", "the engine, ")
    for k, (name, subject) in enumerate(zip(("peer.box2d", "peer.engine", "peer.engine"), subjects, strict=True)):
        what = subject + (f"{len(few)} agents one after the other" if batches[k] == 1 else "all agents at once")
        yield Row(name=name, **same, batch=batches[k], value=rates[k], unit="M agent-steps/s", what=what)
    for k in (1, 2):
        what = "the engine against pybox2d, measured in turn"
        yield Row(name="peer.ratio", **same, batch=batches[k], value=rates[k] / rates[0], unit="times", what=what)
    together = min(30, plan.steps)
    there, here = box2d_peer.trajectory(task, few[0], together), simulator.record(few[0]).position[: together + 1]
    what = f"largest difference of a coordinate between pybox2d and the engine in the first {together} steps"
    yield Row(name="peer.difference", **same, batch=1, value=float(abs(there - here).max()), unit="m", what=what)


@cache
def load_peer() -> Any:
    """The module benchmarks/box2d_peer.py; raises `Skipped` where it or Box2D is missing."""
    spec = importlib.util.spec_from_file_location("box2d_peer", PEER)
    if spec is None or spec.loader is None or not PEER.exists():
        raise Skipped("benchmarks/box2d_peer.py is in the repository, not in the installed package")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ImportError as error:
        raise Skipped(f"the package box2d cannot be imported ({error})") from None
    return module


PARTS: dict[str, Callable[[Plan], Iterator[Row]]] = {
    "kernel": kernel,
    "memory": memory,
    "startup": startup,
    "evolution": evolution,
    "peer": peer,
}
