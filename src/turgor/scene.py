"""Scenes: the static line segments that bodies stand on and bump into."""

from __future__ import annotations

import random
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.arrays import LARGEST, LARGEST_COORDINATE, as_numbers
from turgor.errors import InvalidInput, describe

GROUND_DEPTH = 2.0  # [m]: ground pushes out whatever lies this far beneath it
WALL_HEIGHT = 100.0  # [m]: walls at the ends of a terrain, from -WALL_HEIGHT to WALL_HEIGHT
PLANE_EXTENT = 500.0  # [m]: half length of the plane
MOST_SEGMENTS = 100_000


class Scene(msgspec.Struct, frozen=True, eq=False):
    """Static geometry. The free side of a segment is on the RIGHT of 1 -> 2; it acts on masses there alone.

    A segment with `depth` > 0 is ground: it also pushes out what lies up to `depth` metres behind it, between
    its ends in x, so that nothing that was pressed into the ground is lost.
    """

    segments: Any  # [m], shape [segment, 4]: x1, y1, x2, y2
    depth: Any = 0.0  # [m], shape [segment]
    friction: float = 0.2  # [1]

    def __post_init__(self) -> None:
        try:
            segments = np.array(as_numbers("segments", self.segments)).reshape(-1, 4)
            depth = np.broadcast_to(as_numbers("depth", self.depth), len(segments)).copy()
            friction = float(self.friction)
        except InvalidInput:
            raise
        except (TypeError, ValueError, OverflowError):
            raise InvalidInput(
                "segments: expected numbers of shape [segment, 4], depth: one or one per segment",
                f"{describe(self.segments)} and {describe(self.depth)}",
            ) from None
        if len(segments) > MOST_SEGMENTS:
            raise InvalidInput(f"segments: expected at most {MOST_SEGMENTS}", str(len(segments)))
        if not (np.abs(segments) <= LARGEST_COORDINATE).all():
            raise InvalidInput(f"segments: expected coordinates within {LARGEST_COORDINATE:g} m", "larger or NaN")
        length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
        if (length < 1e-3).any():
            raise InvalidInput("segments: expected two different ends", describe(segments[length.argmin()]))
        if not ((depth >= 0) & (depth <= LARGEST_COORDINATE)).all():
            raise InvalidInput(f"depth: expected 0 m or more, up to {LARGEST_COORDINATE:g} m", describe(depth))
        if not 0 <= friction <= LARGEST:
            raise InvalidInput(
                f"ground friction: expected a finite number, 0 or more, up to {LARGEST:g}", describe(self.friction)
            )
        segments.flags.writeable = depth.flags.writeable = False
        msgspec.structs.force_setattr(self, "segments", segments)
        msgspec.structs.force_setattr(self, "depth", depth)
        msgspec.structs.force_setattr(self, "friction", friction)

    def __repr__(self) -> str:
        if not len(self.segments):
            return "Scene(empty)"
        x, y = self.segments[:, ::2], self.segments[:, 1::2]
        spans = f"x {x.min():.6g} to {x.max():.6g} m, y {y.min():.6g} to {y.max():.6g} m"
        return f"Scene({len(self.segments)} segments, {spans}, friction {self.friction:g})"

    @property
    def normal(self) -> np.ndarray:
        """Outward unit normals [1], shape [segment, 2]: (dy, -dx) / length."""
        along = self.segments[:, 2:] - self.segments[:, :2]
        return np.stack([along[:, 1], -along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]

    def two_sided(self) -> Scene:
        """The same scene with every segment acting on both sides, as Box2D's do."""
        back = self.segments[:, [2, 3, 0, 1]]
        return Scene(np.concatenate([self.segments, back]), 0.0, self.friction)


def flat(*, friction: float = 0.2) -> Scene:
    """A horizontal plane at y = 0, a kilometre long."""
    return Scene([[PLANE_EXTENT, 0, -PLANE_EXTENT, 0]], GROUND_DEPTH, friction)


def hills(
    seed: int = 0,
    *,
    height: float = 1.0,
    step: float = 10.0,
    step_spread: float = 0.25,
    extent: float = 400.0,
    friction: float = 0.2,
) -> Scene:
    """Random hills from x = -20 m to `extent`, with a wall at either end.

    Heights are |N(0, height)| [m], distances max(step N(1, step_spread), 1) [m]. The draws are those of the
    paper's program (`random.Random(seed).gauss`; step, height, height, then step, height for each further
    vertex), so that seeds 0 to 4 are its terrains.
    """
    if not (height >= 0 and step > 0 and step_spread >= 0 and 0 < extent <= LARGEST_COORDINATE):
        raise InvalidInput(
            "hills: expected height >= 0, step > 0, step_spread >= 0, extent > 0",
            f"{height}, {step}, {step_spread}, {extent}",
        )
    draw = random.Random(seed).gauss

    def next_step() -> float:
        return max(step * draw(1, step_spread), 1.0)

    def next_height() -> float:
        return abs(draw(0, height))

    x, first = -20.0, next_step()
    vertices = [(x, next_height())]
    x += first
    vertices.append((x, next_height()))
    while x < extent:
        x += next_step()
        if x > extent:
            break
        vertices.append((x, next_height()))
        if len(vertices) >= MOST_SEGMENTS:
            raise InvalidInput(
                f"hills: expected fewer than {MOST_SEGMENTS} vertices, by a smaller extent", f"{extent:g} m"
            )
    return polyline(np.array(vertices), friction=friction)


def polyline(vertices: np.ndarray, *, friction: float = 0.2) -> Scene:
    """Ground through `vertices` [m], shape [vertex, 2], from left to right, with a wall at either end."""
    left, right = vertices[0, 0], vertices[-1, 0]
    ground = np.concatenate([vertices[1:], vertices[:-1]], axis=1)
    walls = [
        [left, -WALL_HEIGHT, left, WALL_HEIGHT],
        [right, WALL_HEIGHT, right, -WALL_HEIGHT],
    ]
    segments = np.concatenate([walls[:1], ground, walls[1:]])
    depth = np.full(len(segments), GROUND_DEPTH)
    depth[[0, -1]] = 0.0
    return Scene(segments, depth, friction)


def cage(
    *,
    width: float,
    roof: float,
    aperture: float,
    wall: float = 1.0,
    friction: float = 0.2,
) -> Scene:
    """A cage to escape from: ground, a roof, and two walls with an opening of height `aperture` at the ground.

    `width` is the distance between the walls' inner faces, `roof` the height of the roof's lower face, `wall`
    the thickness of roof and walls, all in m.
    """
    if not (width > 0 and wall > 0 and 0 <= aperture < roof):
        raise InvalidInput(
            "cage: expected width > 0, wall > 0 and 0 <= aperture < roof", f"{width}, {wall}, {aperture}, {roof}"
        )
    x, outer, top = width / 2, width / 2 + wall, roof + wall
    reach = max(100.0, outer + 50.0)
    segments = [
        [reach, 0, -reach, 0],
        [-x, roof, x, roof],
        [outer, top, -outer, top],
        [-x, aperture, -x, roof],
        [-outer, top, -outer, aperture],
        [x, roof, x, aperture],
        [outer, aperture, outer, top],
        [-outer, aperture, -x, aperture],
        [x, aperture, outer, aperture],
    ]
    return Scene(segments, [GROUND_DEPTH] + [0.0] * 8, friction)


def highest_ground(scene: Scene, left: float, right: float) -> float:
    """Highest y [m] of the ground (segments with a depth) between x = `left` and x = `right`; 0 without any."""
    highest = float(ground_heights(scene, left, right))
    return highest if highest > -np.inf else 0.0


def ground_heights(scene: Scene, left: ArrayLike, right: ArrayLike) -> np.ndarray:
    """The same of many intervals at once, shape [...] of `left` and `right`; minus infinity where there is none."""
    x1, y1, x2, y2 = scene.segments.T
    low = np.maximum(np.expand_dims(left, -1), np.minimum(x1, x2))
    high = np.minimum(np.expand_dims(right, -1), np.maximum(x1, x2))
    under = (scene.depth > 0) & (low <= high) & (x1 != x2)
    run = np.where(x1 == x2, 1.0, x2 - x1)
    a, b = (y1 + (y2 - y1) * (x - x1) / run for x in (low, high))
    return np.where(under, np.maximum(a, b), -np.inf).max(axis=-1, initial=-np.inf)
