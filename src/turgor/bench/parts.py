"""What is measured: every part of the benchmark yields its rows, as many and as large as the plan says."""

from __future__ import annotations

import importlib.util
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from turgor.bench.measuring import (
    MILLION,
    SEED,
    Plan,
    Skipped,
    controllers,
    fastest,
    make_task,
    run_python,
    usable_threads,
    warm_up,
)
from turgor.bench.peers import peer
from turgor.bench.report import Row, say
from turgor.bench.scaling import scaling


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


def environment(plan: Plan) -> Iterator[Row]:
    """Rows: million agent-steps/s through Gymnasium's interface, and of the same work as a rollout."""
    threads = usable_threads(plan.threads)
    for body in plan.environment_bodies:
        for agents in plan.environments:
            yield from environment_rows(plan, body, agents, threads)


def environment_rows(plan: Plan, body: str, agents: int, threads: list[int]) -> Iterator[Row]:
    """Rows of one number of environments: stepped and rolled out, on each number of threads, all in turn."""
    import gymnasium

    from turgor.simulate import Simulator

    kind = "inflated"
    task = make_task("hilly", body, plan.steps, kind)
    theta = controllers(kind, task, agents, plan.generations)
    how: dict[str, Any] = {"body": body, "steps": plan.steps, "pressure_unit": task.pressure_unit, "seed_terrain": SEED}
    envs = [gymnasium.make_vec("turgor/Hilly-v0", num_envs=agents, threads=t, **how) for t in threads]
    actions = actions_of(envs[-1], task, theta)
    calls: list[Callable[[], object]] = [partial(play, each, actions) for each in envs]
    calls += [partial(Simulator(task, threads=t).rollout, theta) for t in threads]
    times = fastest(calls, plan.curve_seconds, plan.repeats)
    same: dict[str, Any] = {"body": body, "task": "hilly", "controllers": kind, "batch": agents}
    for t, stepped, rolled in zip(threads, times, times[len(threads) :], strict=False):
        rates = [agents * plan.steps / took / MILLION for took in (stepped, rolled)]
        what = f"make_vec stepped {plan.steps} times, with the actions that the controllers gave before"
        yield Row(name="environment", **same, threads=t, value=rates[0], unit="M agent-steps/s", what=what)
        what = "the same agents with their controllers in one rollout, measured in turn"
        yield Row(name="environment.rollout", **same, threads=t, value=rates[1], unit="M agent-steps/s", what=what)
        what = "how many times as long stepping takes"
        yield Row(name="environment.overhead", **same, threads=t, value=stepped / rolled, unit="times", what=what)


def actions_of(envs: Any, task: Any, theta: Any) -> Any:
    """What linear controllers `theta` [agent, parameter] do in `envs` over a whole episode, float32
    [step, agent, output]."""
    import numpy as np

    from turgor.control import rows

    weight, bias = rows(theta, task.body, task.condition)
    actions = np.empty((task.steps, *envs.action_space.shape), dtype=np.float32)
    springs = task.body.spring_count
    observation, _ = envs.reset(seed=SEED)
    for action in actions:
        output = np.matmul(weight, observation[:, :, None])[:, :, 0] + bias
        action[:, :springs] = np.tanh(output[:, :springs])
        action[:, springs:] = np.clip(output[:, springs:], -1, 1)
        observation = envs.step(action)[0]
    return actions


def play(envs: Any, actions: Any) -> None:
    """A whole episode of all environments."""
    envs.reset(seed=SEED)
    for action in actions:
        envs.step(action)


MEMORY = """
import sys, numpy, turgor
from turgor.bench.measuring import peak_memory
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


EVOLUTION = """
import json, sys, time, turgor
import numpy as np
from turgor.runs import Run

disk = 0.0

def timed(write):
    def write_and_count(*given):
        global disk
        began = time.perf_counter()
        write(*given)
        disk += time.perf_counter() - began
    return write_and_count

for name in ("add", "write_champion", "write_checkpoint", "write_record"):  # all that a run writes
    setattr(Run, name, timed(getattr(Run, name)))
task = turgor.make_task("hilly", body=sys.argv[1])
run = turgor.evolve(task, evaluations=int(sys.argv[2]), seed=0, out=sys.argv[3])
best = run.champion
print(json.dumps({"seconds": run.seconds | {"disk": disk}, "best": best.fitness,
                  "robust": float(np.median(best.robust)), "population": run.settings.population,
                  "threads": run.settings.threads}))
"""


def evolution(plan: Plan) -> Iterator[Row]:
    """Rows: how long the default evolution of each body takes, where the time goes, and what comes out."""
    warm_up()
    for body in plan.bodies:
        with tempfile.TemporaryDirectory() as folder:
            wall, out = run_python("-c", EVOLUTION, body, str(plan.evaluations), str(Path(folder) / "run"))
        yield from evolution_rows(body, plan.evaluations, wall, json.loads(out.splitlines()[-1]))


def evolution_rows(body: str, evaluations: int, wall: float, told: dict[str, Any]) -> Iterator[Row]:
    """Rows of one evolution: its parts add up to the whole process."""
    what, seconds = f"{evaluations} evaluations, seed 0", told["seconds"]
    outside = wall - seconds["simulation"] - seconds["strategy"] - seconds["disk"]
    figures = [
        ("evolution.wall", wall, "s", f"{what}: the whole process, engine cached, no video"),
        ("evolution.simulation", seconds["simulation"], "s", f"{what}: of which in rollouts"),
        ("evolution.strategy", seconds["strategy"], "s", f"{what}: of which in CMA-ES"),
        ("evolution.disk", seconds["disk"], "s", f"{what}: of which writing the run's files"),
        ("evolution.python", outside, "s", f"{what}: all else: Python's start, imports, loading the engine, the loop"),
        ("evolution.best", told["best"], "m/s", f"{what}: fitness of the champion"),
        ("evolution.robust", told["robust"], "m/s", f"{what}: median of the champion's perturbed starts"),
    ]
    for name, value, unit, what in figures:
        yield Row(name=name, body=body, task="hilly", controllers="evolved", batch=told["population"],
                  threads=told["threads"], value=value, unit=unit, what=what)  # fmt: skip


PARTS: dict[str, Callable[[Plan], Iterator[Row]]] = {
    "kernel": kernel,
    "scaling": scaling,
    "environment": environment,
    "memory": memory,
    "startup": startup,
    "evolution": evolution,
    "peer": peer,
}
