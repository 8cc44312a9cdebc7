"""Frames: one picture of a `Recording` at one step, drawn in memory, without a window.

A frame is made of coloured polygons in metres, back to front: what stands still (`scenery.py`), gas, trail, springs
and masses. The camera turns metres into pixels; text and colour bars are laid over the result.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.recording import Recording
from turgor.view.camera import SUBPIXELS, follow
from turgor.view.colours import Colour, Colours, premultiplied, rgb
from turgor.view.scenery import Scenery
from turgor.view.shapes import (
    INK,
    PRESSURE_MAP,
    STRAIN_MAP,
    Shape,
    body_shapes,
    centre_shapes,
    level,
    shade,
    span,
    strain,
    strain_range,
    trail_shapes,
)

if TYPE_CHECKING:
    import pygame

SMALLEST_SIZE, LARGEST_SIZE = 64, 8192  # [px]
SPEED_WINDOW = 1.0  # [s]

SKY_TOP, SKY_BOTTOM = (196, 217, 236), (246, 249, 251)
PANEL = (250, 252, 253, 190)
FAINT_INK = (92, 102, 116)


def draw_frame(recording: Recording, step: int, size: tuple[int, int] = (1280, 720), title: str = "") -> np.ndarray:
    """The picture of `recording` after `step` steps, uint8, shape [height, width, 3].

    `size` is (width, height) [px]. For many frames make one `Painter` and ask it for each.
    """
    return Painter(recording, size, title).frame(step)


class Painter:
    """Draws the frames of one recording; holds what they share (camera, fonts, sky, scenery, colour bars).

    `pressure_range` (low, high) [Pa] is what the gas's colours span; None: what the recording spans. `colours` are
    those that a picture holds: `rgb`, or for the encoder `ycbcr`.
    Raises `InvalidInput` for a size or a recording that cannot be drawn.
    """

    def __init__(
        self,
        recording: Recording,
        size: tuple[int, int] = (1280, 720),
        title: str = "",
        *,
        pressure_range: tuple[float, float] | None = None,
        colours: Colours = rgb,
    ) -> None:
        self.recording = recording
        self.size = width, height = checked_size(size)
        if not np.isfinite(recording.position).all():
            raise InvalidInput("recording: expected finite positions", "NaN or infinity")
        self.title = title
        self.com = recording.com  # [m], shape [step + 1, 2]
        self.camera = follow(recording, self.com, self.size)
        self._colours = colours
        self.pressure_range = pressure_range or span(recording.pressure)  # [Pa]
        self.strain_range = strain_range(recording)  # [1]
        pygame = _pygame()
        self._zoom = min(max(min(width / 1280, height / 720), 0.72), 4.0)  # of the text
        self._text, self._bold = (_font(name, 17 * self._zoom) for name in ("DejaVuSans", "DejaVuSans-Bold"))
        self._small = _font("DejaVuSans", 13.5 * self._zoom)
        self._surface = pygame.Surface(self.size, 0, 32)
        self._sky = self._draw_sky()
        self._panel = self._draw_panel()
        self._bars = self._draw_bars()
        self._scenery = Scenery(recording.scene, self.camera, colours, self._small, self._zoom)

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
        self._scenery.draw(self._surface, step)
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
        extent = (high - low).astype(int)
        # made anew, transparent: measured, that is faster than to keep one for the largest extent and clear a part
        canvas = pygame.Surface((SUBPIXELS * extent).tolist(), pygame.SRCALPHA, 32)
        corners = (SUBPIXELS * (points - low)).tolist()
        first = 0
        for colour, polygon in shapes:
            last = first + len(polygon)
            pygame.draw.polygon(canvas, premultiplied(self._colours(colour)), corners[first:last])
            first = last
        # averaging over a transparent ground yields colours times alpha: premultiplied
        smooth = pygame.transform.smoothscale(canvas, extent.tolist())
        self._surface.blit(smooth, low.tolist(), special_flags=pygame.BLEND_PREMULTIPLIED)

    def _draw_sky(self) -> pygame.Surface:
        pygame = _pygame()
        column = pygame.Surface((1, 2), 0, 32)
        column.set_at((0, 0), self._colours(SKY_TOP))
        column.set_at((0, 1), self._colours(SKY_BOTTOM))
        return pygame.transform.smoothscale(column, self.size)

    def _draw_gas(self, step: int) -> None:
        """The chambers, straight onto the frame: springs hide their edges, and nothing shines through."""
        position = self.camera.pixels(step, np.asarray(self.recording.position[step], dtype=np.float64))
        levels = level(self.recording.pressure[step], self.pressure_range)
        for share, loop in zip(levels, self.recording.body.chambers, strict=True):
            corners = position[list(loop)].tolist()
            _pygame().draw.polygon(self._surface, self._colours(shade(PRESSURE_MAP, share)), corners)

    def _write(self, font: Any, text: str, colour: Colour) -> pygame.Surface:
        return font.render(text.replace("-", "−"), True, self._colours(colour))

    def _draw_panel(self) -> pygame.Surface:
        """The title and the names of the readings, for the top left corner."""
        zoom, line = self._zoom, 25 * self._zoom
        title = self._write(self._bold, self.title, INK)
        top = 10 * zoom + (1.15 * line if self.title else 0)
        remark = self._write(self._small, f"mean of the last {SPEED_WINDOW:g} s", FAINT_INK)
        width = max(title.get_width() + 28 * zoom, 206 * zoom + remark.get_width() + 12 * zoom)
        panel = self._blank_panel((width, top + 3 * line + 8 * zoom))
        panel.blit(title, (14 * zoom, 9 * zoom))
        for row, name in enumerate(("time", "distance", "speed")):
            panel.blit(self._write(self._text, name, FAINT_INK), (14 * zoom, top + row * line))
        panel.blit(remark, (206 * zoom, top + 2 * line + 3 * zoom))
        return panel

    def _blank_panel(self, extent: tuple[float, float]) -> pygame.Surface:
        pygame = _pygame()
        panel = pygame.Surface((round(extent[0]), round(extent[1])), pygame.SRCALPHA, 32)
        pygame.draw.rect(panel, self._colours(PANEL), panel.get_rect(), border_radius=round(8 * self._zoom))
        return panel

    def _draw_readings(self, step: int) -> None:
        """Title, time, distance and speed in the top left corner."""
        zoom, line, margin = self._zoom, 25 * self._zoom, round(12 * self._zoom)
        self._surface.blit(self._panel, (margin, margin))
        top = margin + 10 * zoom + (1.15 * line if self.title else 0)
        time, distance, speed = readings(self.recording, self.com, step)
        for row, value in enumerate((f"{time:.2f} s", f"{distance:.1f} m", f"{speed:.2f} m/s")):
            number = self._write(self._text, value, INK)
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
        label = self._write(self._small, name, INK)
        picture.blit(label, ((width - label.get_width()) / 2, 5 * zoom))
        for x in range(bar[2]):
            picture.fill(self._colours(shade(colours, x / (bar[2] - 1))), (bar[0] + x, bar[1], 1, bar[3]))
        pygame.draw.rect(picture, self._colours(FAINT_INK), (bar[0] - 1, bar[1] - 1, bar[2] + 2, bar[3] + 2), 1)
        for side, text in enumerate(ends):
            end = self._write(self._small, text, FAINT_INK)
            picture.blit(end, (bar[0] + side * (bar[2] - end.get_width()), bar[1] + bar[3] + 7 * zoom))
        return picture

    def _draw_pointers(self, step: int) -> None:
        """The colour bars, with a triangle beneath each present value."""
        polygon, ink, size = _pygame().draw.polygon, self._colours(INK), max(round(5 * self._zoom), 3)
        for bar in self._bars:
            self._surface.blit(bar.picture, bar.corner)
            left, top, width, height = bar_place(bar.picture.get_width(), self._zoom)
            values = self.recording.pressure[step] if bar.kind == "pressure" else strain(self.recording, step)
            y = bar.corner[1] + top + height + 2
            for value in level(values, bar.limits):
                x = bar.corner[0] + left + round(value * (width - 1))
                polygon(self._surface, ink, [(x, y), (x - size, y + size), (x + size, y + size)])


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


def readings(recording: Recording, com: np.ndarray, step: int) -> tuple[float, float, float]:
    """Time [s], distance in x from the start [m], speed in x over the last `SPEED_WINDOW` [m/s]."""
    steps = min(max(round(SPEED_WINDOW / recording.dt), 1), step)
    speed = (com[step, 0] - com[step - steps, 0]) / (steps * recording.dt) if steps else 0.0
    return step * recording.dt, com[step, 0] - com[0, 0], speed


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
