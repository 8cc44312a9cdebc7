"""Scaling curves: the engine's speed over the batch, the body's masses, the terrain's segments and the threads."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from turgor.bench.measuring import MILLION, Plan, controllers, fastest, make_task, usable_threads
from turgor.bench.report import Row

if TYPE_CHECKING:
    from turgor.task import Task

RATE = "M agent-steps/s"
GAS = 14.0067  # [mol] times the square of the masses: the small body's pressure, whatever the size
POINT = 0.01  # [m], side of a mass that hardly ever meets another one
CLOSE = 1.2  # [m], between the centres of two masses: squares of 1 m touch there, or nearly so
SETTLING = 600  # [step] after which bodies have come to lie
SPACING = 4.0  # [m] between the vertices of the terrain
HEIGHTS = (0.0, 0.6, 0.2, 1.0, 0.3, 0.0, 0.8, 0.4)  # [m], again and again: every stretch is as hard as any other
ROOM = 8.0  # [m] that a small body needs on either side of its middle


def scaling(plan: Plan) -> Iterator[Row]:
    """Rows: million agent-steps/s of rollouts, each curve over one number."""
    yield from over_batches(plan)
    yield from over_masses(plan)
    yield from over_segments(plan)
    yield from over_threads(plan)


def over_batches(plan: Plan) -> Iterator[Row]:
    """Rows: agents at once, on each number of threads in turn."""
    from turgor.simulate import Simulator

    threads = usable_threads(plan.threads)
    for body in plan.curve_bodies:
        task = make_task("hilly", body, plan.curve_steps, "inflated")
        simulators = [Simulator(task, threads=t) for t in threads]
        for batch in plan.curve_batches:
            theta = controllers("inflated", task, batch, plan.generations)
            times = fastest([partial(s.rollout, theta) for s in simulators], plan.curve_seconds, plan.repeats)
            for t, took in zip(threads, times, strict=True):
                yield Row(
                    name="scaling.batch",
                    body=body,
                    task="hilly",
                    controllers="inflated",
                    batch=batch,
                    threads=t,
                    value=batch * plan.curve_steps / took / MILLION,
                    unit=RATE,
                    what=f"rollouts of {plan.curve_steps} steps",
                )


# --- masses -----------------------------------------------------------------------------------------------------------

SHAPES = {
    "inflated": "a ring with the small body's pressure, its springs controlled at random",
    "inflated, passive": "the same without a controller: the physics alone",
    "collapsed": "a ring without gas, mass on mass, its springs controlled at random",
    "collapsed, points": "the same with masses of 1 cm, as heavy, which hardly ever meet each other",
}


def over_masses(plan: Plan) -> Iterator[Row]:
    """Rows: the body's masses, each of `SHAPES` in turn, from where a rollout of 10 s has left them."""
    from turgor.simulate import Simulator

    for masses in plan.curve_masses:
        calls, ends = [], []
        for shape in SHAPES:
            task = ring_task(masses, shape, SETTLING)
            theta = controllers("random", task, plan.curve_agents, plan.generations)
            starts = Simulator(task).rollout(theta).position
            ends.append(told_of(task, starts))
            calls.append(
                partial(Simulator(ring_task(masses, shape, plan.curve_steps), threads=1).rollout, theta, starts)
            )
        times = fastest(calls, plan.curve_seconds, plan.repeats)
        for shape, end, took in zip(SHAPES, ends, times, strict=True):
            yield Row(
                name="scaling.masses",
                body="ring",
                task="flat",
                controllers=shape,
                batch=plan.curve_agents,
                threads=1,
                size=masses,
                value=plan.curve_agents * plan.curve_steps / took / MILLION,
                unit=RATE,
                what=f"{SHAPES[shape]}; {end}",
            )


def ring_task(masses: int, shape: str, steps: int) -> Task:
    """A ring of so many masses on a plane, half a metre of radius for each."""
    from turgor.body import ring
    from turgor.task import make_task

    small: dict[str, Any] = {"side": POINT, "density": 2500 / POINT**2} if shape.endswith("points") else {}
    gas = GAS * masses**2 if shape.startswith("inflated") else 0.0
    body = ring(masses, masses / 2, gas_amount=gas, **small)
    return make_task("flat", body=body, condition="passive" if shape.endswith("passive") else "springs", steps=steps)


def told_of(task: Task, position: Any) -> str:
    """In words: how flat bodies at `position` [m], shape [agent, mass, 2], are, and how many masses lie on others."""
    import numpy as np

    ratio = task.body.area(position)[:, 0] / task.area_reference[0]
    a, b = np.triu_indices(task.body.mass_count, 2)
    a, b = a[b - a < task.body.mass_count - 1], b[b - a < task.body.mass_count - 1]  # the last spring closes the ring
    close = np.hypot(*np.moveaxis(position[:, a] - position[:, b], 2, 0)) < CLOSE
    pairs = close.sum(axis=1).mean()
    return f"area ratio {ratio.mean():.2f}, {pairs:.1f} pairs of masses that no spring joins within {CLOSE:g} m"


# --- segments ---------------------------------------------------------------------------------------------------------


def over_segments(plan: Plan) -> Iterator[Row]:
    """Rows: the terrain's segments, all numbers in turn; and what a step costs on the longest against the shortest."""
    times = segment_times(plan.curve_segments, plan.curve_agents, plan.curve_steps, plan.curve_seconds, plan.repeats)
    same: dict[str, Any] = {
        "body": "small",
        "task": "hilly",
        "controllers": "inflated",
        "batch": plan.curve_agents,
        "threads": 1,
    }
    for segments, took in times.items():
        rate = plan.curve_agents * plan.curve_steps / took / MILLION
        what = f"rollouts of {plan.curve_steps} steps from starts all over the terrain"
        yield Row(name="scaling.segments", **same, size=segments, value=rate, unit=RATE, what=what)
    shortest, longest = min(times), max(times)
    what = f"the time of a step on {longest} segments against {shortest}"
    yield Row(name="scaling.segments.growth", **same, size=longest, value=times[longest] / times[shortest],
              unit="times", what=what)  # fmt: skip


def segment_times(segments: tuple[int, ...], agents: int, steps: int, seconds: float, repeats: int) -> dict[int, float]:
    """Shortest time [s] of a rollout on a terrain of each number of `segments`."""
    from turgor.simulate import Simulator

    calls = []
    for count in segments:
        task = terrain_task(count, steps)
        theta, starts = controllers("inflated", task, agents, 0), spread_starts(task, agents)
        calls.append(partial(Simulator(task, threads=1).rollout, theta, starts))
    return dict(zip(segments, fastest(calls, seconds, repeats), strict=True))


def terrain_task(segments: int, steps: int) -> Task:
    """The small body on a terrain of so many segments, two of them walls, around x = 0: float32 is finest there."""
    import msgspec
    import numpy as np

    from turgor.scene import polyline

    vertices = segments - 1
    x = SPACING * (np.arange(vertices) - (vertices - 1) / 2)
    scene = polyline(np.stack([x, np.resize(HEIGHTS, vertices)], axis=1))
    return msgspec.structs.replace(make_task("hilly", "small", steps, "inflated"), scene=scene)


def spread_starts(task: Task, agents: int) -> Any:
    """Starts from one end of the terrain to the other [m], shape [agent, mass, 2], just above its highest vertices."""
    import numpy as np

    half = task.scene.segments[-1, 0] - ROOM
    x = np.linspace(-half, half, agents)
    y = np.full(agents, max(HEIGHTS) + 0.5 - task.body.lowest_corner())
    return task.body.position + np.stack([x, y], axis=1)[:, None]


# --- threads ----------------------------------------------------------------------------------------------------------


def over_threads(plan: Plan) -> Iterator[Row]:
    """Rows: threads, up to all cores, in turn."""
    from turgor.simulate import Simulator, available_cores

    threads = thread_counts(available_cores())
    for body in plan.curve_bodies:
        task = make_task("hilly", body, plan.curve_steps, "inflated")
        theta = controllers("inflated", task, plan.curve_crowd, plan.generations)
        calls = [partial(Simulator(task, threads=t).rollout, theta) for t in threads]
        for t, took in zip(threads, fastest(calls, plan.curve_seconds, plan.repeats), strict=True):
            yield Row(
                name="scaling.threads",
                body=body,
                task="hilly",
                controllers="inflated",
                batch=plan.curve_crowd,
                threads=t,
                value=plan.curve_crowd * plan.curve_steps / took / MILLION,
                unit=RATE,
                what=f"rollouts of {plan.curve_steps} steps; {available_cores()} cores",
            )


def thread_counts(cores: int) -> list[int]:
    """1, 2, 4, ... and all cores."""
    return sorted({*(2**k for k in range(cores.bit_length())), cores})
