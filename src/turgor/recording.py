"""Recordings: everything that one agent did, step by step."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from turgor.body import Body
from turgor.scene import Scene


class Recording(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One agent's trajectory. Index t is the state after step t, index 0 the start.

    `pressure`, `rest_length` and `touch` at t are those that acted in step t (at 0: before any step).
    """

    body: Body
    scene: Scene
    dt: float  # [s]
    position: Any  # [m], shape [step + 1, mass, 2]
    velocity: Any  # [m/s], shape [step + 1, mass, 2]
    pressure: Any  # [Pa], shape [step + 1, chamber]
    rest_length: Any  # [m], shape [step + 1, spring]
    touch: Any  # bool, shape [step + 1, mass]: touches anything but its spring neighbours
    observation: Any = None  # [1], shape [step, input]: the window's mean that the controller saw in step t + 1
    fitness: float | None = None
    solved: bool = False

    def __repr__(self) -> str:
        fitness = "" if self.fitness is None else f", fitness {self.fitness:.3f}" + ", solved" * self.solved
        return f"Recording({self.steps} steps, {self.steps * self.dt:.1f} s, {self.body.mass_count} masses{fitness})"

    @property
    def steps(self) -> int:
        return len(self.position) - 1

    @property
    def time(self) -> np.ndarray:
        """[s], shape [step + 1]."""
        return np.arange(self.steps + 1) * self.dt

    @property
    def com(self) -> np.ndarray:
        """Centre of mass [m], shape [step + 1, 2]."""
        return np.average(self.position, axis=1, weights=self.body.mass)

    @property
    def com_velocity(self) -> np.ndarray:
        """Velocity of the centre of mass [m/s], shape [step + 1, 2]."""
        return np.average(self.velocity, axis=1, weights=self.body.mass)

    @property
    def area(self) -> np.ndarray:
        """Signed area of each chamber [m^2], shape [step + 1, chamber]."""
        return self.body.area(np.asarray(self.position, dtype=np.float64))

    @property
    def area_ratio(self) -> np.ndarray:
        """rho = area / (pi r^2) of each chamber [1], shape [step + 1, chamber]."""
        radius = np.array([self.body.chamber_radius(c) for c in range(self.body.chamber_count)])
        return self.area / (np.pi * radius**2)

    @property
    def spring_length(self) -> np.ndarray:
        """Present length of each spring [m], shape [step + 1, spring]."""
        ends = np.asarray(self.position, dtype=np.float64)[:, self.body.springs]
        return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)

    @property
    def tangled(self) -> np.ndarray:
        """Whether any wall of the scene goes through a spring, bool, shape [step + 1]."""
        return tangled(np.asarray(self.position, dtype=np.float64), self.body, self.scene)


def tangled(position: np.ndarray, body: Body, scene: Scene) -> np.ndarray:
    """Whether any wall of `scene` (a segment without depth) crosses any spring of `body` at `position` [m],
    shape [..., mass, 2]; bool [...]. Springs collide with nothing, so a body can close around a wall."""
    crossed = np.zeros(position.shape[:-2], dtype=bool)
    a, b = position[..., body.springs[:, 0], :], position[..., body.springs[:, 1], :]
    for x1, y1, x2, y2 in scene.segments[scene.depth == 0]:
        p, q = np.array([x1, y1]), np.array([x2, y2])
        ends_apart = _side(a, b, p) * _side(a, b, q) < 0
        crossed |= (ends_apart & (_side(p, q, a) * _side(p, q, b) < 0)).any(axis=-1)
    return crossed


def _side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed area of the triangle a, b, c."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
