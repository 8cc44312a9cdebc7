"""Changed worlds, in which a robust evolution judges its candidates.

A controller that is the best of thousands in one world is partly the one that this world's contacts suit. In worlds
that change from generation to generation, what is left of that luck does not last (Jakobi, Husbands and Harvey, "Noise
and the reality gap", 1995; today it is called domain randomization).
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.physics.memory import check_memory
from turgor.rollout import Rollout
from turgor.scene import ground_heights
from turgor.simulate import Simulator
from turgor.task import REST_GAP, Task
from turgor.variants import Robust

SHARED = 5  # draws of a world, before those of each mass


def draw_worlds(task: Task, robust: Robust, seed: int, generation: int) -> list[Task]:
    """The changed worlds of a `generation` of the evolution with this `seed`, and of nothing else: `task` with the
    numbers that `robust` says changed at random. No generation of an evolution is number 0.

    More `worlds` begin with the same ones. Another spread leaves the draws of the others as they are. The task's own
    world is not among them: being in every generation, it would again be the one that candidates are chosen to suit.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(generation,)))
    draws = 2 * rng.random((robust.worlds, SHARED + 2 * task.body.mass_count)) - 1
    return [_changed(task, robust, draw) for draw in draws]


def check_worlds(task: Task, robust: Robust) -> None:
    """Raises `InvalidInput` where the most changed world cannot be simulated."""
    check_memory("robust shift: expected fewer masses or segments", 8 * task.body.mass_count * len(task.scene.segments))
    for most in (-1.0, 1.0):
        Simulator(_changed(task, robust, np.full(SHARED + 2 * task.body.mass_count, most)), threads=1)


def _changed(task: Task, robust: Robust, draw: np.ndarray) -> Task:
    """`task` changed by `draw`, numbers in [-1, 1]: `SHARED` ones, then one for each mass and axis."""
    friction, gravity, gas, damping, shift = draw[:SHARED].tolist()
    body, scene, physics = task.body, task.scene, task.physics
    replace = msgspec.structs.replace
    return replace(
        task,
        body=replace(
            body,
            gas_amount=body.gas_amount * (1 + robust.gas * gas),
            damping_ratio=body.damping_ratio * (1 + robust.damping * damping),
        ),
        scene=replace(scene, friction=scene.friction * (1 + robust.friction * friction)),
        physics=replace(physics, gravity=physics.gravity * (1 + robust.gravity * gravity)),
        position=_moved(task, robust.shift * shift) + robust.jitter * draw[SHARED:].reshape(-1, 2),
    )


def _moved(task: Task, shift: float) -> np.ndarray:
    """The start moved sideways by `shift` [m], shape [mass, 2]; and up where a mass would else stand deeper in the
    ground than before, or nearer to it than at rest."""
    if shift == 0:
        return task.position
    body, (x, y) = task.body, task.position.T
    reach = body.side / 2 * (np.abs(np.cos(body.angle)) + np.abs(np.sin(body.angle)))
    here, there = (ground_heights(task.scene, x + by - reach, x + by + reach) for by in (0.0, shift))
    missing = there + np.minimum(y - reach - here, REST_GAP) - (y - reach)
    return task.position + np.array([shift, max(0.0, float(missing.max()))])


def judge_generation(
    simulator: Simulator, theta: ArrayLike, robust: Robust | None, seed: int, generation: int
) -> Rollout:
    """The `Rollout` by which the agents of a generation, `theta` [agent, parameter], are judged: in the task's world
    or, where `robust` says so, in those of `draw_worlds`."""
    if robust is None:
        return simulator.rollout(theta)
    return kept(simulator.rollout_in(draw_worlds(simulator.task, robust, seed, generation), theta), robust)


def kept(rollouts: Sequence[Rollout], robust: Robust) -> Rollout:
    """Of the `rollouts` of the same agents, for each agent the one that counts, in all its fields: the worst, or the
    median (of an even number the lower one), where NaN is the worst."""
    fitness = np.array([out.fitness for out in rollouts])
    order = np.argsort(np.where(np.isnan(fitness), -np.inf, fitness), axis=0, kind="stable")
    which = order[0 if robust.keep == "worst" else (len(rollouts) - 1) // 2]
    agents, names = np.arange(len(which)), Rollout.__struct_fields__
    return Rollout(**{name: np.array([getattr(out, name) for out in rollouts])[which, agents] for name in names})
