"""Frames: one picture of a `Recording` at one step, drawn in memory, without a window.

A frame is made of coloured polygons in metres, back to front: ground, walls, gas, trail, springs and masses.
The camera turns metres into pixels; text and colour bars are laid over the result.
"""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.recording import Recording
from turgor.scene import Scene, highest_ground

if TYPE_CHECKING:
    import pygame

Colour = tuple[int, ...]  # red, green, blue (, alpha), 0 to 255
Shape = tuple[Colour, np.ndarray]  # a filled polygon: its colour, its corners [m], shape [corner, 2]

SMALLEST_SIZE, LARGEST_SIZE = 64, 8192  # [px]
SUPERSAMPLING = 3  # polygons are drawn this many times larger, then averaged: smooth edges
BODY_SHARE = 1 / 3  # [1], the body's size at rest / the frame's height
BODY_HEIGHT = 0.6  # [1], where the camera's centre lies, from the top of the frame
CAMERA_SMOOTHING = (0.4, 0.7)  # [s], standard deviation of the Gaussian over the path in x and y
CAMERA_SLACK = 0.22  # [1], furthest that the body's centre gets from the camera's / the frame's size
SPEED_WINDOW = 1.0  # [s]
TRAIL_LENGTH = 8.0  # [s]
WALL_THICKNESS = 1.0  # [m], of walls that are lines
SURFACE = 0.15  # [m], of the lighter line along everything that can be touched

SKY_TOP, SKY_BOTTOM = (196, 217, 236), (246, 249, 251)
GRID = (205, 217, 228)
SOLID, EDGE = (66, 72, 84), (138, 149, 165)  # ground and walls, and their surface
PANEL = (250, 252, 253, 190)
TICK, TICK_TEXT = (146, 156, 171), (214, 220, 229)
INK, FAINT_INK = (28, 34, 44), (92, 102, 116)
MASS, MASS_EDGE = (116, 127, 144), (40, 47, 60)
TOUCHING, TOUCHING_EDGE = (34, 39, 50), (255, 176, 0)
CENTRE = (255, 255, 255)
TRAIL = (58, 66, 82)

# Lightness falls evenly from low to high pressure; greens stay apart from the springs' red and blue.
PRESSURE_MAP = ((247, 252, 214), (201, 233, 160), (120, 198, 121), (49, 145, 96), (0, 88, 66))
# ColorBrewer's RdBu: blue compressed, near white at rest, red stretched.
STRAIN_MAP = ((5, 48, 140), (67, 147, 210), (247, 247, 247), (236, 112, 84), (178, 10, 35))


def draw_frame(recording: Recording, step: int, size: tuple[int, int] = (1280, 720), title: str = "") -> np.ndarray:
    """The picture of `recording` after `step` steps, uint8, shape [height, width, 3].

    `size` is (width, height) [px]. For many frames make one `Painter` and ask it for each.
    """
    return Painter(recording, size, title).frame(step)


class Painter:
    """Draws the frames of one recording; holds what they share (camera, fonts, sky, colour bars).

    `pressure_range` (low, high) [Pa] is what the gas's colours span; None: what the recording spans.
    Raises `InvalidInput` for a size or a recording that cannot be drawn.
    """

    def __init__(
        self,
        recording: Recording,
        size: tuple[int, int] = (1280, 720),
        title: str = "",
        *,
        pressure_range: tuple[float, float] | None = None,
    ) -> None:
        self.recording = recording
        self.size = width, height = checked_size(size)
        if not np.isfinite(recording.position).all():
            raise InvalidInput("recording: expected finite positions", "NaN or infinity")
        self.title = title
        self.com = recording.com  # [m], shape [step + 1, 2]
        self.camera = follow(recording, self.com, self.size)
        self.walls = wall_shapes(recording.scene)
        self.pressure_range = pressure_range or span(recording.pressure)  # [Pa]
        self.strain_range = strain_range(recording)  # [1]
        pygame = _pygame()
        self._zoom = min(max(min(width / 1280, height / 720), 0.72), 4.0)  # of the text
        self._text, self._bold = (_font(name, 17 * self._zoom) for name in ("DejaVuSans", "DejaVuSans-Bold"))
        self._small = _font("DejaVuSans", 13.5 * self._zoom)
        self._surface = pygame.Surface(self.size, 0, 32)
        self._canvas = pygame.Surface((1, 1), pygame.SRCALPHA, 32)
        self._sky = self._draw_sky()
        self._panel = self._draw_panel()
        self._bars = self._draw_bars()
        self._labels: dict[float, pygame.Surface] = {}
        self._heights: dict[float, float | None] = {}  # of the ground at x [m]

    def frame(self, step: int) -> np.ndarray:
        """The picture after `step` steps, uint8, shape [height, width, 3]."""
        width, height = self.size
        pixels = _pygame().image.tobytes(self.surface(step), "RGB")
        return np.frombuffer(pixels, np.uint8).reshape(height, width, 3).copy()

    def surface(self, step: int) -> pygame.Surface:
        """The picture after `step` steps, 32 bits a pixel; the next call draws over it."""
        if not 0 <= step <= self.recording.steps:
            raise InvalidInput(f"step: expected 0 to {self.recording.steps}", describe(step))
        self._surface.blit(self._sky, (0, 0))
        self._draw_grid(step)
        self._draw_ground(step)
        for shape in self.walls:
            self._fill(step, [shape])
        self._draw_ruler(step)
        self._draw_gas(step)
        self._fill(step, trail_shapes(self.recording, self.com, step))
        body = body_shapes(self.recording, step, self.strain_range)
        self._fill(step, body + centre_shapes(self.com[step], self.camera.scale))
        self._draw_readings(step)
        self._draw_pointers(step)
        return self._surface

    def _fill(self, step: int, shapes: list[Shape]) -> None:
        """Fills the polygons, back to front, with smooth edges."""
        if not shapes:
            return
        pygame = _pygame()
        points = self.camera.pixels(step, np.concatenate([corners for _, corners in shapes]))
        low, high = np.floor(points.min(axis=0)) - 1, np.ceil(points.max(axis=0)) + 2
        low, high = np.clip(low, 0, self.size), np.clip(high, 0, self.size)
        if (high <= low).any():
            return
        extent = tuple((high - low).astype(int).tolist())
        canvas = self._cleared_canvas(extent)
        corners = (SUPERSAMPLING * (points - low)).tolist()
        first = 0
        for colour, polygon in shapes:
            last = first + len(polygon)
            pygame.draw.polygon(canvas, colour, corners[first:last])
            first = last
        # averaging over a transparent ground yields colours times alpha: premultiplied
        smooth = pygame.transform.smoothscale(canvas, extent)
        self._surface.blit(smooth, low.tolist(), special_flags=pygame.BLEND_PREMULTIPLIED)

    def _cleared_canvas(self, extent: tuple[int, int]) -> pygame.Surface:
        pygame = _pygame()
        needed = [SUPERSAMPLING * n for n in extent]
        had = self._canvas.get_size()
        if needed[0] > had[0] or needed[1] > had[1]:
            largest = (max(needed[0], had[0]), max(needed[1], had[1]))
            self._canvas = pygame.Surface(largest, pygame.SRCALPHA, 32)
        canvas = self._canvas.subsurface((0, 0, *needed))
        canvas.fill((0, 0, 0, 0))
        return canvas

    def _draw_sky(self) -> pygame.Surface:
        pygame = _pygame()
        column = pygame.Surface((1, 2), 0, 32)
        column.set_at((0, 0), SKY_TOP)
        column.set_at((0, 1), SKY_BOTTOM)
        return pygame.transform.smoothscale(column, self.size)

    def _draw_grid(self, step: int) -> None:
        line = _pygame().draw.aaline
        for _, x in self._marks(step, self.camera.spacing):
            line(self._surface, GRID, (x, 0), (x, self.size[1]))

    def _marks(self, step: int, spacing: float) -> list[tuple[float, float]]:
        """(x [m], x [px]) of every multiple of `spacing` [m] in view."""
        left, right, _, _ = self.camera.view(step)
        metres = spacing * np.arange(math.ceil(left / spacing), math.floor(right / spacing) + 1)
        pixels = (metres - left) * self.camera.scale
        return list(zip(metres.tolist(), pixels.tolist(), strict=True))

    def _draw_ground(self, step: int) -> None:
        left, right, low, _ = self.camera.view(step)
        ground = visible_ground(self.recording.scene, left, right)
        if not ground:
            return
        bottom = max(min(y for x1, y1, x2, y2 in ground for y in (y1, y2)), low) - 2 * SURFACE
        # smooth edges where there are edges, plain rectangles below
        self._fill(step, ground_shapes(ground, bottom))
        top = math.ceil(self.camera.pixels(step, np.array([left, bottom]))[1]) - 1
        for x1, _, x2, _ in ground:
            a, b = ((x - left) * self.camera.scale for x in (x1, x2))
            self._surface.fill(SOLID, (math.floor(a), top, math.ceil(b) - math.floor(a), self.size[1]))

    def _draw_ruler(self, step: int) -> None:
        """Ticks in the ground, with metres."""
        line, spacing, zoom = _pygame().draw.aaline, self.camera.spacing, self._zoom
        minor = spacing / (10 if spacing * self.camera.scale >= 80 else 5)
        _, _, low, _ = self.camera.view(step)
        for metres, x in self._marks(step, minor):
            height = self._height(metres)
            if height is None:
                continue
            labelled = round(metres / minor) % round(spacing / minor) == 0
            top = self.size[1] - (height - low) * self.camera.scale + 5 * zoom
            line(self._surface, TICK, (x, top), (x, top + (12 if labelled else 4) * zoom))
            if labelled:
                label = self._label(metres)
                self._surface.blit(label, (round(x - label.get_width() / 2), round(top + 15 * zoom)))

    def _draw_gas(self, step: int) -> None:
        """The chambers, straight onto the frame: springs hide their edges, and nothing shines through."""
        position = self.camera.pixels(step, np.asarray(self.recording.position[step], dtype=np.float64))
        levels = level(self.recording.pressure[step], self.pressure_range)
        for share, loop in zip(levels, self.recording.body.chambers, strict=True):
            corners = position[list(loop)].tolist()
            _pygame().draw.polygon(self._surface, shade(PRESSURE_MAP, share), corners)

    def _height(self, x: float) -> float | None:
        """Height of the ground at x [m]; None: there is none."""
        if x not in self._heights:
            scene = self.recording.scene
            self._heights[x] = highest_ground(scene, x, x) if visible_ground(scene, x, x) else None
        return self._heights[x]

    def _label(self, metres: float) -> pygame.Surface:
        if metres not in self._labels:
            self._labels[metres] = self._small.render(_minus(f"{metres:g} m"), True, TICK_TEXT)
        return self._labels[metres]

    def _draw_panel(self) -> pygame.Surface:
        """The title and the names of the readings, for the top left corner."""
        zoom, line = self._zoom, 25 * self._zoom
        title = self._bold.render(self.title, True, INK)
        top = 10 * zoom + (1.15 * line if self.title else 0)
        remark = self._small.render(f"mean of the last {SPEED_WINDOW:g} s", True, FAINT_INK)
        width = max(title.get_width() + 28 * zoom, 206 * zoom + remark.get_width() + 12 * zoom)
        panel = self._blank_panel((width, top + 3 * line + 8 * zoom))
        panel.blit(title, (14 * zoom, 9 * zoom))
        for row, name in enumerate(("time", "distance", "speed")):
            panel.blit(self._text.render(name, True, FAINT_INK), (14 * zoom, top + row * line))
        panel.blit(remark, (206 * zoom, top + 2 * line + 3 * zoom))
        return panel

    def _blank_panel(self, extent: tuple[float, float]) -> pygame.Surface:
        pygame = _pygame()
        panel = pygame.Surface((round(extent[0]), round(extent[1])), pygame.SRCALPHA, 32)
        pygame.draw.rect(panel, PANEL, panel.get_rect(), border_radius=round(8 * self._zoom))
        return panel

    def _draw_readings(self, step: int) -> None:
        """Title, time, distance and speed in the top left corner."""
        zoom, line, margin = self._zoom, 25 * self._zoom, round(12 * self._zoom)
        self._surface.blit(self._panel, (margin, margin))
        top = margin + 10 * zoom + (1.15 * line if self.title else 0)
        time, distance, speed = readings(self.recording, self.com, step)
        for row, value in enumerate((f"{time:.2f} s", f"{distance:.1f} m", f"{speed:.2f} m/s")):
            number = self._text.render(_minus(value), True, INK)
            self._surface.blit(number, (margin + 196 * zoom - number.get_width(), top + row * line))

    def _draw_bars(self) -> list[Bar]:
        """The colour bars for the top right corner, those that the body needs and that fit."""
        body, zoom = self.recording.body, self._zoom
        margin = round(12 * zoom)
        width = round(240 * zoom)
        if self._panel.get_width() + width + 3 * margin > self.size[0]:
            return []
        bars, corner = [], (self.size[0] - width - margin, margin)
        if body.chamber_count:
            divisor, unit = (1e3, "kPa") if self.pressure_range[1] >= 1e4 else (1.0, "Pa")
            ends = [f"{p / divisor:.3g}" for p in self.pressure_range]
            picture = self._draw_bar(width, f"gas pressure [{unit}]", PRESSURE_MAP, ends)
            bars.append(Bar("pressure", picture, corner, self.pressure_range))
            corner = (corner[0], corner[1] + picture.get_height() + margin // 2)
        if body.spring_count:
            ends = [f"{s - 1:+.0%}" for s in self.strain_range]
            picture = self._draw_bar(width, "spring strain", STRAIN_MAP, ends)
            bars.append(Bar("strain", picture, corner, self.strain_range))
        return bars

    def _draw_bar(self, width: int, name: str, colours: tuple[Colour, ...], ends: list[str]) -> pygame.Surface:
        pygame, zoom = _pygame(), self._zoom
        picture = self._blank_panel((width, 62 * zoom))
        bar = bar_place(width, zoom)
        label = self._small.render(name, True, INK)
        picture.blit(label, ((width - label.get_width()) / 2, 5 * zoom))
        for x in range(bar[2]):
            picture.fill(shade(colours, x / (bar[2] - 1)), (bar[0] + x, bar[1], 1, bar[3]))
        pygame.draw.rect(picture, FAINT_INK, (bar[0] - 1, bar[1] - 1, bar[2] + 2, bar[3] + 2), 1)
        for side, text in enumerate(ends):
            end = self._small.render(_minus(text), True, FAINT_INK)
            picture.blit(end, (bar[0] + side * (bar[2] - end.get_width()), bar[1] + bar[3] + 7 * zoom))
        return picture

    def _draw_pointers(self, step: int) -> None:
        """The colour bars, with a triangle beneath each present value."""
        polygon, size = _pygame().draw.polygon, max(round(5 * self._zoom), 3)
        for bar in self._bars:
            self._surface.blit(bar.picture, bar.corner)
            left, top, width, height = bar_place(bar.picture.get_width(), self._zoom)
            values = self.recording.pressure[step] if bar.kind == "pressure" else strain(self.recording, step)
            y = bar.corner[1] + top + height + 2
            for value in level(values, bar.limits):
                x = bar.corner[0] + left + round(value * (width - 1))
                polygon(self._surface, INK, [(x, y), (x - size, y + size), (x + size, y + size)])


class Bar(msgspec.Struct, frozen=True, eq=False):
    """A colour bar's picture and where it stands."""

    kind: str  # "pressure" or "strain"
    picture: Any
    corner: tuple[int, int]  # [px]
    limits: tuple[float, float]  # [Pa] or [1]


def bar_place(width: int, zoom: float) -> tuple[int, int, int, int]:
    """Left, top, width, height [px] of the colours in a bar's picture of `width`."""
    margin = round(14 * zoom)
    return margin, round(25 * zoom), width - 2 * margin, round(11 * zoom)


class Camera(msgspec.Struct, frozen=True, eq=False):
    """Where the frame lies in the world at every step."""

    centre: np.ndarray  # [m], shape [step + 1, 2], what stands at BODY_HEIGHT in the middle of the frame
    scale: float  # [px/m]
    size: tuple[int, int]  # [px], width and height

    def pixels(self, step: int, points: np.ndarray) -> np.ndarray:
        """Pixels from the top left of the frame, shape [..., 2], for `points` [m] [..., 2]."""
        middle = np.array([0.5, BODY_HEIGHT]) * self.size
        return middle + (points - self.centre[step]) * (self.scale, -self.scale)

    def view(self, step: int) -> tuple[float, float, float, float]:
        """Left, right, lowest and highest coordinate in the frame [m]."""
        (x, y), (width, height) = self.centre[step].tolist(), (n / self.scale for n in self.size)
        return x - width / 2, x + width / 2, y - (1 - BODY_HEIGHT) * height, y + BODY_HEIGHT * height

    @property
    def spacing(self) -> float:
        """Distance of the labelled marks [m]: 10 m for the bodies of the paper."""
        least = 0.155 * min(self.size) / self.scale
        power = 10.0 ** math.floor(math.log10(least))
        return next(m * power for m in (1, 2, 5, 10) if m * power >= least)


def follow(recording: Recording, com: np.ndarray, size: tuple[int, int]) -> Camera:
    """The `Camera` that follows the centre of mass `com` [m] [step + 1, 2], smoothly in x and y."""
    body = recording.body
    extent = max(float((np.ptp(body.position, axis=0) + body.side.max()).max()), 3.0)  # [m]
    scale = BODY_SHARE * min(size) / extent
    centre = np.stack(
        [smoothed(com[:, k], deviation / recording.dt) for k, deviation in enumerate(CAMERA_SMOOTHING)],
        axis=1,
    )
    slack = CAMERA_SLACK * np.array(size) / scale
    return Camera(com + np.clip(centre - com, -slack, slack), scale, size)


def smoothed(values: np.ndarray, deviation: float) -> np.ndarray:
    """`values` [step] under a Gaussian of that standard deviation [steps], the ends held."""
    reach = math.ceil(3 * deviation)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(deviation, 1e-9)) ** 2)
    return np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), mode="valid")


def readings(recording: Recording, com: np.ndarray, step: int) -> tuple[float, float, float]:
    """Time [s], distance in x from the start [m], speed in x over the last `SPEED_WINDOW` [m/s]."""
    steps = min(max(round(SPEED_WINDOW / recording.dt), 1), step)
    speed = (com[step, 0] - com[step - steps, 0]) / (steps * recording.dt) if steps else 0.0
    return step * recording.dt, com[step, 0] - com[0, 0], speed


# --- what is drawn, as polygons in metres ---


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


def trail_shapes(recording: Recording, com: np.ndarray, step: int) -> list[Shape]:
    """The centre of mass's path of the last `TRAIL_LENGTH` seconds, older parts fainter."""
    stride = max(round(0.1 / recording.dt), 1)
    oldest = max(step - round(TRAIL_LENGTH / recording.dt), 0)
    # multiples of the stride: the corners stay where they are from frame to frame
    steps = np.append(np.arange(-(-oldest // stride) * stride, step, stride), step)
    if len(steps) < 2:
        return []
    age = (step - steps[1:]) * recording.dt / TRAIL_LENGTH
    alpha = (0.55 * np.clip(1 - age, 0, 1) ** 1.5)[:, None]
    colours = (alpha * (*TRAIL, 255)).astype(int).tolist()
    path = thick_lines(com[steps[:-1]], com[steps[1:]], 0.03 * recording.body.radius)
    return list(zip(map(tuple, colours), path, strict=True))


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


# --- the library that draws ---


def checked_size(size: Any) -> tuple[int, int]:
    """`size` as (width, height) [px]."""
    try:
        width, height = size
        whole = int(width) == width and int(height) == height
    except (TypeError, ValueError):
        whole = False
    if not whole or min(width, height) < SMALLEST_SIZE or max(width, height) > LARGEST_SIZE:
        raise InvalidInput(f"size: expected (width, height), {SMALLEST_SIZE} to 8192 pixels each", describe(size))
    return int(width), int(height)


def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    return pygame


def _font(name: str, size: float) -> Any:
    """A font that comes with Matplotlib: the same letters on every machine."""
    import matplotlib

    font = _pygame().font
    font.init()
    return font.Font(f"{matplotlib.get_data_path()}/fonts/ttf/{name}.ttf", round(size))


def _minus(text: str) -> str:
    return text.replace("-", "−")
