"""What else one could use: the same agent on other engines, and a robot of EvoGym, beside this engine."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from functools import cache, partial
from pathlib import Path
from typing import Any

from turgor.bench.evogym import WORLDS, Robots, robots_at_work
from turgor.bench.measuring import MILLION, Plan, Skipped, controllers, fastest, make_task
from turgor.bench.report import PEERS, Row, ratio_name, say

PEER = Path(__file__).parents[3] / "benchmarks" / "box2d_peer.py"  # not part of the installed package
LIKE_VOXELS = "inflated"  # the agents beside EvoGym's robots: they keep their shape, as voxels do


def peer(plan: Plan) -> Iterator[Row]:
    """Rows: the same agent on other engines, a robot of EvoGym, and this engine; in turn, all on one core."""
    if plan.evogym is None:
        say("EvoGym: no rows for it; --evogym PYTHON names a Python that has it (benchmarks/README.md)")
    try:
        box2d_peer = load_peer()
    except Skipped as reason:
        if plan.evogym is None:
            raise
        say(f"{reason}: no rows for Box2D")
        box2d_peer = None
    for body in plan.peer_bodies:
        for kind in plan.controllers:
            if box2d_peer is not None or kind == LIKE_VOXELS:
                yield from peer_rows(plan, box2d_peer, body, kind)


def peer_rows(plan: Plan, box2d_peer: Any, body: str, kind: str) -> Iterator[Row]:
    """Rows of one body: the rates, the engine's against the peers', and how far apart the agents are."""
    from threadpoolctl import threadpool_limits

    from turgor.simulate import Simulator

    task = make_task("hilly", body, plan.steps, kind)
    simulator = Simulator(task, threads=1)
    many = controllers(kind, task, plan.peer_batch, plan.generations)
    few = many[: plan.peer_agents]

    def each(run: Callable[..., object], *given: Any) -> None:
        for theta in few:
            run(theta, *given)

    others = peers(box2d_peer)
    calls: list[Callable[[], object]] = []
    calls += [partial(each, partial(box2d_peer.rollout, task), agent) for agent in others.values()]
    calls += [lambda: each(lambda theta: simulator.rollout(theta[None])), lambda: simulator.rollout(many)]
    with ExitStack() as open_now:
        robots = [open_now.enter_context(one) for one in robots_beside(plan, body, kind)]
        calls += [one.turn for one in robots]
        with threadpool_limits(1):
            times = fastest(calls, plan.seconds, plan.repeats)[: len(others) + 2]
    rates = [len(few) * plan.steps / took / MILLION for took in times[:-1]]
    rates.append(len(many) * plan.steps / times[-1] / MILLION)
    same: dict[str, Any] = {"body": body, "task": "hilly", "controllers": kind, "threads": 1}
    told = [*(f"{PEERS[name]}, {len(few)} agents one after the other" for name in others)]
    told += [f"the engine, {len(few)} agents one after the other", "the engine, all agents at once"]
    names, batches = [*others, "engine", "engine"], [1] * (len(others) + 1) + [len(many)]
    for name, batch, rate, what in zip(names, batches, rates, told, strict=True):
        yield Row(name=f"peer.{name}", **same, batch=batch, value=rate, unit="M agent-steps/s", what=what)
    for k, name in enumerate(others):
        for batch, rate in zip((1, len(many)), rates[-2:], strict=True):
            what = f"the engine against {PEERS[name]}, measured in turn"
            yield Row(name=ratio_name(name), **same, batch=batch, value=rate / rates[k], unit="times", what=what)
    if others:
        together = min(30, plan.steps)
        there, here = box2d_peer.trajectory(task, few[0], together), simulator.record(few[0]).position[: together + 1]
        what = f"largest difference of a coordinate between pybox2d and the engine in the first {together} steps"
        yield Row(name="peer.difference", **same, batch=1, value=float(abs(there - here).max()), unit="m", what=what)
    for one in robots:
        yield from evogym_rows(one, task, body, {1: rates[-2], len(many): rates[-1]})


def robots_beside(plan: Plan, body: str, kind: str) -> Iterator[AbstractContextManager[Robots]]:
    """EvoGym's robots, a program for each world, where there is a Python for them."""
    if plan.evogym is not None and kind == LIKE_VOXELS:
        for world in WORLDS:
            yield robots_at_work(plan.evogym, body, world, plan.evogym_robots, plan.evogym_steps)


def evogym_rows(robots: Robots, task: Any, body: str, engine: dict[int, float]) -> Iterator[Row]:
    """Rows of EvoGym in one world, and `engine` against it: million agent-steps/s of `task` by agents at once."""
    facts, turn = robots.facts, robots.fastest()
    rate = turn.steps / turn.seconds / MILLION
    of = f"EvoGym {facts.version}, {facts.robot}, {facts.masses} masses, {facts.springs} springs"
    figures = [
        ("peer.evogym", rate, "M agent-steps/s", f"{of}; {facts.masses_in_world} masses in its world"),
        ("peer.evogym.life", rate * MILLION * facts.step, "s/s", f"{of}; its simulated time, {facts.step:g} s a step"),
        ("peer.evogym.simulator", 100 * turn.simulator / turn.seconds, "%", f"{of}; of its time, the part in its C++"),
    ]
    same: dict[str, Any] = {"body": body, "task": robots.world, "controllers": "random", "threads": 1}
    for name, value, unit, what in figures:
        yield Row(name=name, **same, batch=1, value=value, unit=unit, what=what)
    falls = falls_a_step(task) / (facts.step / facts.fall)
    for batch, fast in engine.items():
        what = f"the engine ({LIKE_VOXELS}, hilly) against EvoGym, measured in turn"
        yield Row(name=ratio_name("evogym"), **same, batch=batch, value=fast / rate, unit="times", what=what)
        what += "; simulated time, in falls from mass to mass"
        yield Row(
            name=f"{ratio_name('evogym')}.life", **same, batch=batch, value=fast / rate * falls, unit="times", what=what
        )


def falls_a_step(task: Any) -> float:
    """How much of a fall from mass to mass a step of `task` is: a measure of time that needs no units."""
    # the fall takes t = sqrt(2 d / g) over the distance d
    return task.physics.dt / (2 * float(task.body.rest_length.mean()) / task.physics.gravity) ** 0.5


def peers(box2d_peer: Any) -> dict[str, Any]:
    """The agents of the peers on Box2D that can run here, by name."""
    from turgor.fidelity.engines import installed

    if box2d_peer is None:
        return {}
    if "box2d-v3" in installed():
        return {"box2d": box2d_peer.Agent, "box2d-v3": box2d_peer.AgentV3}
    say("Box2D v3 (the package pyb2d3) cannot be imported: no rows for it")
    return {"box2d": box2d_peer.Agent}


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
