"""What an environment is: its task, its spaces, and what a batch of agents is told, rewarded and refused.

Every function works on a batch, agent by agent and without sums over agents, so that the scalar and the vector
environment share it and give the same bits.
"""

from __future__ import annotations

import difflib
from typing import Any

import msgspec
import numpy as np
from gymnasium import error, spaces
from numpy.typing import ArrayLike

from turgor.arrays import as_numbers
from turgor.body import Body
from turgor.control import observation_count, output_count
from turgor.errors import InvalidInput, describe, one_of
from turgor.simulate import Step
from turgor.task import Task, make_task
from turgor.variants import Condition, variant_names

CROSSING = 0.5  # [s]: how long a pressure command of 1 takes from p_min to p_max
TERRAINS = 2**31  # seeds that a reset draws from
CONTROLLED = ("pressure", "springs")
OWN_KEYWORDS = ("body", "condition", "seed_terrain", "render_mode", "render_size")
# environment -> the task it is made of, and the variants that it sets itself
BASES: dict[str, tuple[str, dict[str, Any]]] = {
    "hilly": ("hilly", {}),
    "flat": ("flat", {}),
    "escape": ("escape", {}),
    "inflate": ("flat", {"fitness": "area"}),
}


class Rules(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """What all episodes of an environment have in common. Raises Gymnasium's `Error`."""

    name: str
    body: str | Body
    condition: Condition
    seed_terrain: int | None  # None: every reset draws one
    variants: dict[str, Any]

    def __post_init__(self) -> None:
        if self.name not in BASES:
            raise error.Error(str(one_of("task", BASES, self.name)))
        for name in self.variants:
            if name not in variant_names():
                raise error.Error(_unknown(name))
        if self.condition not in CONTROLLED:
            raise error.Error(str(one_of("condition", CONTROLLED, self.condition)))
        if self.seed_terrain is not None and not self.has_terrain:
            raise error.Error(
                f"seed_terrain: expected None, because {self.name} has no random terrain; "
                f"got {describe(self.seed_terrain)}"
            )

    @property
    def has_terrain(self) -> bool:
        return self.name == "hilly"

    def task(self, terrain: int) -> Task:
        """The `Task` on the terrain of that seed; a pressure command of 1 crosses [p_min, p_max] in `CROSSING`."""
        base, own = BASES[self.name]
        try:
            task = make_task(base, body=self.body, condition=self.condition, seed=terrain, **(own | self.variants))
        except InvalidInput as refused:
            raise error.Error(str(refused).replace("seed:", "seed_terrain:")) from None
        if self.condition == "springs" or task.pressure_unit is not None:
            return task
        span = np.ptp(task.pressure_range, axis=1).max()
        return msgspec.structs.replace(task, pressure_unit=float(span * task.physics.dt / CROSSING))

    def draw(self, random: np.random.Generator) -> int:
        """The seed of an episode's terrain."""
        if self.seed_terrain is not None:
            return self.seed_terrain
        return int(random.integers(TERRAINS)) if self.has_terrain else 0


def _unknown(name: str) -> str:
    known = sorted([*variant_names(), *OWN_KEYWORDS])
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {close[0]}?" if close else f"; expected one of {', '.join(known)}"
    return f"unknown keyword {name!r}{hint}"


def observation_space(task: Task) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (observation_count(task.body),), np.float32)


def action_space(task: Task) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (output_count(task.body, task.condition),), np.float32)


# --- actions and observations -------------------------------------------------------------------------------------


def commands(actions: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """`actions` as commands within [-1, 1], float32 of that shape; raises Gymnasium's `InvalidAction` for another
    shape, NaN or infinity. What is beyond 1 is cut."""
    expected = f"action: expected finite numbers of shape {list(shape)}, within [-1, 1]"
    try:
        array = as_numbers("action", actions, np.float32)
    except InvalidInput:
        raise error.InvalidAction(f"{expected}; got {describe(actions)}") from None
    if array.shape != shape:
        raise error.InvalidAction(f"{expected}; got shape {list(array.shape)}")
    if not np.isfinite(array).all():
        place = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
        raise error.InvalidAction(f"{expected}; got {array[place]} at {list(place)}")
    return np.clip(array, -1.0, 1.0)


def observations(stand: Step) -> np.ndarray:
    """What the agents see, float32 [agent, input]: the kernel's own array, its numbers cut at 1. (The window's running
    sum can be a rounding larger than its terms allow.)"""
    return np.clip(stand.observation, -1.0, 1.0, out=stand.observation)


# --- what has been achieved ---------------------------------------------------------------------------------------


class Score(msgspec.Struct, frozen=True, eq=False):
    """What a batch has achieved so far; every field is float64 [agent]."""

    fitness: Any  # see `Task.fitness`; at the end the task's own
    gain: Any  # fitness times the time that it is measured over; a step's reward is what is gained in it


class Measure:
    """Measures how far agents of a task have come."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self._share = (task.body.mass / task.body.mass.sum()).tolist()
        self._disc = task.area_reference
        self._chambers = 0 if task.body.chamber_count == 1 else slice(None)

    def centre(self, position: np.ndarray) -> np.ndarray:
        """x of the centres of mass [m], float64 [agent]. Summed mass by mass: NumPy's sums add in an order that
        depends on the batch."""
        masses = np.ascontiguousarray(position[:, :, 0].T, dtype=np.float64)
        x = np.zeros(len(position))
        for share, of_mass in zip(self._share, masses, strict=True):
            x += share * of_mass
        return x

    def score(self, position: np.ndarray, start: np.ndarray, steps: np.ndarray) -> Score:
        """The `Score` of agents at `position` [m], shape [agent, mass, 2], that began with their centres of mass at
        `start` [m] [agent] and made `steps` [agent]."""
        task = self.task
        if task.fitness == "area":
            ratio = task.body.area(position.astype(np.float64))[:, 0] / self._disc[0]
            return Score(ratio, task.duration * ratio)
        travel = self.centre(position) - start
        gain = travel if task.fitness == "progress" else np.abs(travel)
        time = np.maximum(steps, 1) * task.physics.dt if task.fitness == "elapsed" else task.duration
        return Score(gain / time, gain)

    def infos(self, stand: Step, fitness: np.ndarray) -> dict[str, np.ndarray]:
        """What is told beside the observation, every value [agent], or [agent, chamber] for bodies that do not have
        exactly one chamber."""
        told = {
            "fitness": fitness,  # so far
            "area_ratio": (stand.area / self._disc)[:, self._chambers],
            "pressure": stand.pressure.astype(np.float64)[:, self._chambers],  # [Pa]
            "contacts": stand.touch.sum(axis=1).astype(np.int64),  # masses that touch something
        }
        if self.task.end is not None:
            told["is_success"] = stand.solved
        return told
