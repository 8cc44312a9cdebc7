"""Rollouts: where a batch of agents starts, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.arrays import as_numbers
from turgor.errors import InvalidInput
from turgor.scene import LARGEST_COORDINATE
from turgor.task import Task

AGENTS_AT_ONCE = 4096  # whose final positions are looked at in float64


class Rollout(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """What a batch of agents achieved; every field is per agent."""

    fitness: Any  # [agent], see `Task.fitness`
    steps: Any  # [agent], steps until the end
    solved: Any  # [agent], bool: the end came before the time was up
    com: Any  # [m], shape [agent, 2], final centre of mass
    start: Any  # [m], shape [agent, 2], centre of mass at the start
    position: Any  # [m], shape [agent, mass, 2], final

    def __repr__(self) -> str:
        if not np.isfinite(self.fitness).any():
            return f"Rollout({len(self.fitness)} agents, none with a fitness)"
        low, median, high = np.nanmin(self.fitness), np.nanmedian(self.fitness), np.nanmax(self.fitness)
        return (
            f"Rollout({len(self.fitness)} agents, fitness {low:.3f} to {high:.3f}, median {median:.3f}, "
            f"{int(np.sum(self.solved))} solved)"
        )


def starts_of(task: Task, agents: int, position: ArrayLike | None) -> np.ndarray:
    """Where `agents` agents start [m], float32 [agent, mass, 2]: at the task's start, or at `position` of that shape.
    Raises `InvalidInput`."""
    shape = (agents, task.body.mass_count, 2)
    if position is None:
        return np.broadcast_to(task.position.astype(np.float32), shape)
    starts = as_numbers("position", position)
    if starts.shape != shape or not (np.abs(starts) <= LARGEST_COORDINATE).all():
        raise InvalidInput(
            f"position: expected finite numbers of shape {list(shape)}", f"shape {list(starts.shape)} or too large"
        )
    return starts.astype(np.float32) + np.float32(0)  # no negative zeros


def judge(task: Task, starts: np.ndarray, final: np.ndarray, steps: np.ndarray, solved: np.ndarray) -> Rollout:
    """The `Rollout` of agents that went from `starts` to `final` [m], shape [agent, mass, 2], in `steps` [agent].
    Raises `InvalidInput` where a fitness function of the user's own returns another shape."""
    share = task.body.mass / task.body.mass.sum()
    start, com = (_in_pieces(lambda p: np.einsum("amd,m->ad", p, share), where) for where in (starts, final))
    travel = com[:, 0] - start[:, 0]
    if task.fitness == "progress":
        fitness = travel / task.duration
    elif task.fitness == "distance":
        fitness = np.abs(travel) / task.duration
    elif task.fitness == "elapsed":
        fitness = np.abs(travel) / (steps * task.physics.dt)
    else:
        fitness = np.full(len(steps), np.nan)
    if task.fitness == "area":
        fitness = _in_pieces(lambda p: task.body.area(p)[:, 0], final) / task.area_reference[0]
    out = Rollout(fitness=fitness, steps=steps, solved=solved, com=com, start=start, position=final)
    if callable(task.fitness):
        fitness = np.asarray(task.fitness(out), dtype=np.float64)
        if fitness.shape != steps.shape:
            raise InvalidInput(f"fitness: expected numbers of shape [{len(steps)}]", f"shape {list(fitness.shape)}")
        out = msgspec.structs.replace(out, fitness=fitness)
    return out


def _in_pieces(measure: Callable[[np.ndarray], np.ndarray], position: np.ndarray) -> np.ndarray:
    """What `measure` finds of every agent's `position` [agent, mass, 2] in float64, of which there is no whole copy."""
    parts = cut_evenly(len(position), max(1, -(-len(position) // AGENTS_AT_ONCE)))
    return np.concatenate([measure(position[part].astype(np.float64)) for part in parts])


def cut_evenly(agents: int, parts: int) -> list[slice]:
    """`agents` agents cut into `parts` equal parts."""
    bounds = [agents * k // parts for k in range(parts + 1)] if parts else []
    return [slice(a, b) for a, b in pairwise(bounds)]
