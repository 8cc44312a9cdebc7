"""What a frame shows, as coloured polygons in metres: ground, walls, trail, springs and masses; no pixels yet."""

from __future__ import annotations

from typing import Any

import numpy as np

from turgor.recording import Recording
from turgor.scene import Scene, highest_ground
from turgor.view.colours import Colour

Shape = tuple[Colour, np.ndarray]  # a filled polygon: its colour, its corners [m], shape [corner, 2]

TRAIL_LENGTH = 8.0  # [s]
WALL_THICKNESS = 1.0  # [m], of walls that are lines
SURFACE = 0.15  # [m], of the lighter line along everything that can be touched

INK = (28, 34, 44)  # of outlines, and of text
SOLID, EDGE = (66, 72, 84), (138, 149, 165)  # ground and walls, and their surface
MASS, MASS_EDGE = (116, 127, 144), (40, 47, 60)
TOUCHING, TOUCHING_EDGE = (34, 39, 50), (255, 176, 0)
CENTRE = (255, 255, 255)
TRAIL = (58, 66, 82)

# Lightness falls evenly from low to high pressure; greens stay apart from the springs' red and blue.
PRESSURE_MAP = ((247, 252, 214), (201, 233, 160), (120, 198, 121), (49, 145, 96), (0, 88, 66))
# ColorBrewer's RdBu: blue compressed, near white at rest, red stretched.
STRAIN_MAP = ((5, 48, 140), (67, 147, 210), (247, 247, 247), (236, 112, 84), (178, 10, 35))


# --- the world ---


def visible_ground(scene: Scene, left: float, right: float) -> list[tuple[float, float, float, float]]:
    """x1, y1, x2, y2 [m] of the ground between x = `left` and `right`, cut there, each from left to right."""
    visible = []
    for x1, y1, x2, y2 in scene.segments[scene.depth > 0].tolist():
        if x1 > x2:
            x1, y1, x2, y2 = x2, y2, x1, y1
        a, b = max(x1, left), min(x2, right)
        if a <= b and x1 < x2:
            slope = (y2 - y1) / (x2 - x1)
            visible.append((a, y1 + slope * (a - x1), b, y1 + slope * (b - x1)))
    return visible


def ground_shapes(ground: list[tuple[float, float, float, float]], bottom: float) -> list[Shape]:
    """The ground down to y = `bottom` [m], and its surface."""
    solid: list[Shape] = [(SOLID, np.array([(a, ya), (b, yb), (b, bottom), (a, bottom)])) for a, ya, b, yb in ground]
    surface: list[Shape] = [
        (EDGE, np.array([(a, ya), (b, yb), (b, yb - SURFACE), (a, ya - SURFACE)])) for a, ya, b, yb in ground
    ]
    return solid + surface


def wall_shapes(scene: Scene) -> list[Shape]:
    """Everything but the ground: closed loops around a solid are blocks, other segments thick lines."""
    walls = scene.segments[scene.depth == 0]
    blocks = [loop for loop in closed_loops(walls) if shoelace(walls[loop, :2]) > 1e-9]
    inside = {k for loop in blocks for k in loop}
    solid = [walls[loop, :2] for loop in blocks]
    solid += [reach_back(wall, depth_behind(scene, wall)) for k, wall in enumerate(walls) if k not in inside]
    surface = [reach_back(above_ground(scene, wall), SURFACE) for wall in walls]
    return [(SOLID, corners) for corners in solid] + [(EDGE, corners) for corners in surface]


def reach_back(wall: np.ndarray, thickness: float) -> np.ndarray:
    """Corners [m], shape [4, 2], of the wall x1, y1, x2, y2 with a thickness, away from its free side."""
    a, b = wall[:2], wall[2:]
    back = thickness * np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a))
    return np.array([a, b, b + back, a + back])


def above_ground(scene: Scene, wall: np.ndarray) -> np.ndarray:
    """The part of a vertical wall that stands out of the ground, other walls whole."""
    x1, y1, x2, y2 = wall.tolist()
    if x1 != x2 or not visible_ground(scene, x1, x1):
        return wall
    lowest = min(highest_ground(scene, x1, x1), max(y1, y2) - SURFACE)
    return np.array([x1, max(y1, lowest), x2, max(y2, lowest)])


def depth_behind(scene: Scene, wall: np.ndarray) -> float:
    """Thickness of a wall that is a line [m]; where nothing lies behind it, the rest of the world."""
    a, b = wall[:2], wall[2:]
    back = np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a))
    behind = float(((scene.segments.reshape(-1, 2) - a) @ back).max())
    return WALL_THICKNESS if behind > 1e-6 else 1000.0


def closed_loops(segments: np.ndarray) -> list[list[int]]:
    """Indices of segments that follow each other, end to start, back to the first."""
    start = {tuple(s[:2]): k for k, s in enumerate(segments.round(9).tolist())}
    following = [start.get(tuple(s[2:])) for s in segments.round(9).tolist()]
    loops, seen = [], set()
    for first in range(len(segments)):
        loop: list[int] = []
        k: int | None = first
        while k is not None and k not in seen:
            seen.add(k)
            loop.append(k)
            k = following[k]
        if loop and k == first:
            loops.append(loop)
    return loops


def shoelace(corners: np.ndarray) -> float:
    """Signed area [m^2] of the polygon, positive when counter-clockwise: solid on the left of its sides."""
    x, y = corners.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


# --- the body ---


def trail_shapes(recording: Recording, com: np.ndarray, step: int) -> list[Shape]:
    """The centre of mass's path of the last `TRAIL_LENGTH` seconds, older parts fainter."""
    stride = max(round(0.1 / recording.dt), 1)
    oldest = max(step - round(TRAIL_LENGTH / recording.dt), 0)
    # multiples of the stride: the corners stay where they are from frame to frame
    steps = np.append(np.arange(-(-oldest // stride) * stride, step, stride), step)
    if len(steps) < 2:
        return []
    age = (step - steps[1:]) * recording.dt / TRAIL_LENGTH
    colours = [(*TRAIL, alpha) for alpha in (0.55 * 255 * np.clip(1 - age, 0, 1) ** 1.5).astype(int).tolist()]
    path = thick_lines(com[steps[:-1]], com[steps[1:]], 0.03 * recording.body.radius)
    return list(zip(colours, path, strict=True))


def body_shapes(recording: Recording, step: int, strain_range: tuple[float, float]) -> list[Shape]:
    """Springs, then masses."""
    body, position = recording.body, np.asarray(recording.position[step], dtype=np.float64)
    side = float(body.side.mean())
    a, b = position[body.springs[:, 0]], position[body.springs[:, 1]]
    shapes: list[Shape] = [(INK, line) for line in thick_lines(a, b, 0.46 * side)]
    colours = [shade(STRAIN_MAP, s) for s in level(strain(recording, step), strain_range)]
    shapes += list(zip(colours, thick_lines(a, b, 0.3 * side), strict=True))
    touch = np.asarray(recording.touch[step], dtype=bool).tolist()
    for touching, edge, face in zip(touch, squares(body, position), squares(body, position, 0.72), strict=True):
        shapes.append((TOUCHING_EDGE if touching else MASS_EDGE, edge))
        shapes.append((TOUCHING if touching else MASS, face))
    return shapes


def centre_shapes(com: np.ndarray, scale: float) -> list[Shape]:
    """A ring around the centre of mass, a few pixels wide."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) / scale  # radius 1 px
    return [(INK, com + 5.0 * circle), (CENTRE, com + 3.4 * circle)]


def squares(body: Any, position: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Corners of the masses [m], shape [mass, 4, 2], each turned by its angle, with `share` of its side."""
    half = 0.5 * share * body.side
    cos, sin = half * np.cos(body.angle), half * np.sin(body.angle)
    along, across = np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)
    offsets = np.stack([along + across, across - along, -along - across, along - across], axis=1)
    return position[:, None] + offsets


def thick_lines(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Corners [m], shape [line, 4, 2], of lines from a to b [line, 2]."""
    along = b - a
    length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    across = 0.5 * width * np.stack([-along[:, 1], along[:, 0]], axis=1) / length
    return np.stack([a + across, b + across, b - across, a - across], axis=1)


# --- colours ---


def strain(recording: Recording, step: int) -> np.ndarray:
    """Length of each spring / its length in the body at rest [1], shape [spring]."""
    ends = np.asarray(recording.position[step], dtype=np.float64)[recording.body.springs]
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / recording.body.rest_length


def strain_range(recording: Recording) -> tuple[float, float]:
    """What the springs' colours span [1]: the lengths that can be commanded, as far to either side of 1."""
    body = recording.body
    reach = max(float((1 - body.shortest).max(initial=0)), float((body.longest - 1).max(initial=0)), 0.05)
    return 1 - reach, 1 + reach


def span(values: np.ndarray) -> tuple[float, float]:
    """Smallest and largest value, a tenth apart at least, so that noise stays pale."""
    values = np.asarray(values, dtype=np.float64)
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    missing = max(0.1 * abs(high) - (high - low), 0.0)
    return (low - missing / 2, high + missing / 2) if high > low or missing else (low - 0.5, high + 0.5)


def level(values: np.ndarray, limits: tuple[float, float]) -> list[float]:
    """`values` from 0 at the lower limit to 1 at the upper."""
    low, high = limits
    return np.clip((np.asarray(values, dtype=np.float64) - low) / (high - low), 0, 1).tolist()


def shade(colours: tuple[Colour, ...], share: float) -> Colour:
    """The colour at `share` (0 to 1) of the way through `colours`."""
    place = share * (len(colours) - 1)
    k = min(int(place), len(colours) - 2)
    return tuple(round(a + (place - k) * (b - a)) for a, b in zip(colours[k], colours[k + 1], strict=True))
