"""Scenes as the kernel sees them: cut into columns, so that a mass looks only at segments that it can reach.

Columns are cut wherever the list of segments within reach changes, so that each list is exact, and the cost of a step
does not depend on the length of the terrain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from turgor.body import Body
from turgor.physics.memory import check_memory
from turgor.physics.model import MARGIN, NOWHERE
from turgor.scene import Scene


class Columns(NamedTuple):
    """The tables of one scene; see `model.Ground`. A column's list is as long as `candidate` is wide."""

    x1: np.ndarray  # [m], shape [segment]
    y1: np.ndarray
    x2: np.ndarray
    y2: np.ndarray
    nx: np.ndarray
    ny: np.ndarray
    depth: np.ndarray
    left: np.ndarray  # [m], shape [column]
    right: np.ndarray
    floor: np.ndarray
    ceiling: np.ndarray
    listed: np.ndarray
    candidate: np.ndarray  # [column, slot]


class Room(NamedTuple):
    """How much a scene may hold."""

    segments: int
    columns: int
    slots: int  # segments in a column

    def holds(self, other: Room) -> bool:
        """Whether a scene of the size of `other` finds room."""
        return all(mine >= needed for mine, needed in zip(self, other, strict=True))


def room_for(scenes: Sequence[Columns], share: float = 0.0) -> Room:
    """Room for every one of `scenes`, and a `share` more."""
    needed = np.max([[len(s.x1), *s.candidate.shape] for s in scenes], axis=0)
    return Room(*(int(n) for n in needed + np.ceil(share * needed)))


def reach_of(body: Body, skin: float) -> float:
    """How far from a mass's centre it can meet a segment [m]."""
    return math.sqrt(2) * (float(body.side.max()) / 2 + 2 * skin) + MARGIN


def cut_into_columns(scene: Scene, reach: float) -> Columns:
    """The `Columns` of a scene for masses that meet what lies within `reach` [m] of their centre."""
    segments, normal = scene.segments, scene.normal
    low = np.minimum(segments[:, 0], segments[:, 2]) - reach
    high = np.maximum(segments[:, 0], segments[:, 2]) + reach
    cuts = np.unique(np.float32(np.concatenate([low, high])))
    left, right = np.concatenate([[-np.inf], cuts]), np.concatenate([cuts, [np.inf]])
    # a segment is in reach of the columns from the first that ends behind its `low` to the last that begins before its
    # `high`; listed by column, then by segment
    first, last = np.searchsorted(right, low, side="right"), np.searchsorted(left, high, side="left")
    count = last - first
    listed = np.cumsum(np.bincount(first, minlength=len(left) + 1) - np.bincount(last, minlength=len(left) + 1))[:-1]
    slots = max(1, listed.max())
    expected = "segments: expected fewer that lie above each other"
    check_memory(expected, 8 * len(left) * int(slots))
    segment = np.repeat(np.arange(len(segments)), count)
    column = np.arange(len(segment)) + np.repeat(first - np.cumsum(count) + count, count)
    order = np.argsort(column, kind="stable")
    column, segment = column[order], segment[order]
    slot = np.arange(len(column)) - np.repeat(np.cumsum(listed) - listed, listed)
    candidate = np.full((len(left), slots), NOWHERE)
    candidate[column, slot] = segment

    bottom, top = _span(segments[segment], left[column] - reach, right[column] + reach)
    floor, ceiling = np.full(len(left), -np.inf), np.full(len(left), np.inf)
    up, down = normal[segment, 1] >= 0, normal[segment, 1] <= 0
    np.maximum.at(floor, column[up], top[up])
    np.minimum.at(ceiling, column[down], bottom[down])
    return Columns(*segments.T, *normal.T, scene.depth, left, right, floor, ceiling, listed, candidate)


def _span(segments: np.ndarray, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest y of segments between two x each."""
    x1, y1, x2, y2 = segments.T
    upright = x1 == x2
    run = np.where(upright, 1.0, x2 - x1)
    a, b = (y1 + (y2 - y1) * (np.clip(x, np.minimum(x1, x2), np.maximum(x1, x2)) - x1) / run for x in (left, right))
    a, b = np.where(upright, y1, a), np.where(upright, y2, b)
    return np.minimum(a, b), np.maximum(a, b)
