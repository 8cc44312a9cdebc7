"""What stands still: ground, walls and ruler, drawn once in tiles that every frame is then laid out with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from turgor.scene import Scene, highest_ground
from turgor.view.camera import SUBPIXELS, Camera
from turgor.view.colours import Colours, premultiplied
from turgor.view.shapes import SURFACE, Shape, ground_shapes, visible_ground, wall_shapes

if TYPE_CHECKING:
    import pygame

TILE = (256, 64)  # [px], low: most tiles are then sky alone or earth alone
LABEL_REACH = 60  # [px], more than half of a label's width
MOST_TILES = 100  # that are kept although the camera has left them
GRID = (205, 217, 228)
TICK, TICK_TEXT = (146, 156, 171), (214, 220, 229)

Place = tuple[int, int]  # of a tile: how many tiles to the right of the world's origin, and below it


class Scenery:
    """Draws ground, walls and ruler of a scene, and the grid behind them, where the camera looks.

    The camera moves by whole thirds of a pixel, so that each part of the world has 3 x 3 looks. A tile is drawn three
    times larger when it first comes into view, and averaged for each of its looks when that is first seen.
    """

    def __init__(self, scene: Scene, camera: Camera, colours: Colours, font: Any, zoom: float) -> None:
        """`zoom`: how much larger than in a frame of 1280 x 720 ticks and text are."""
        self.scene, self.camera, self.colours, self.zoom = scene, camera, colours, zoom
        self._minor = camera.spacing / (10 if camera.spacing * camera.scale >= 80 else 5)  # [m], between ticks
        self._font = font
        self._walls = wall_shapes(scene)
        self._labels: dict[float, pygame.Surface] = {}
        self._heights: dict[float, float | None] = {}  # of the ground at x [m]
        self._tiles: dict[Place, Tile] = {}
        self._grid = [self._grid_line(part / SUBPIXELS) for part in range(SUBPIXELS)]

    def draw(self, surface: pygame.Surface, step: int) -> None:
        """Draws the world that the camera sees at `step`."""
        import pygame

        (x, across), (y, down) = (divmod(n, SUBPIXELS) for n in self.camera.origin(step))
        surface.fblits(list(self._grid_lines(step)), pygame.BLEND_PREMULTIPLIED)
        seen, looks = {}, []
        for place in self._in_view(x, y):
            tile = seen[place] = self._tiles.get(place) or Tile(self, place)
            corner = (x + place[0] * TILE[0], y + place[1] * TILE[1])
            if tile.mixed:
                looks.append((tile.look(across, down), corner))
            elif tile.colour[3]:
                surface.fill(tile.colour, (corner, TILE))
        surface.fblits(looks, pygame.BLEND_PREMULTIPLIED)
        self._tiles = seen if len(self._tiles) > MOST_TILES else self._tiles | seen

    def shapes(self, left: float, right: float, low: float) -> list[Shape]:
        """Ground and walls from x = `left` to `right` [m]; the ground reaches down to y = `low` [m] at least."""
        ground = visible_ground(self.scene, left, right)
        bottom = min([low, *(y for _, y1, _, y2 in ground for y in (y1, y2))]) - 2 * SURFACE
        return ground_shapes(ground, bottom) + self._walls

    def ticks(self, left: float, right: float) -> Iterator[tuple[float, float, pygame.Surface | None]]:
        """x and y [m] of the ruler's ticks from `left` to `right` [m], with the labels that some of them have."""
        each = round(self.camera.spacing / self._minor)
        for k in range(math.ceil(left / self._minor), math.floor(right / self._minor) + 1):
            metres = k * self._minor
            height = self._height(metres)
            if height is not None:
                yield metres, height, self._label(metres) if k % each == 0 else None

    def _in_view(self, x: int, y: int) -> list[Place]:
        """The tiles in the frame, whose origin is `x`, `y` [px]."""
        across, down = (
            range(-n // tile, (size - 1 - n) // tile + 1)
            for n, tile, size in zip((x, y), TILE, self.camera.size, strict=True)
        )
        return [(i, j) for i in across for j in down]

    def _height(self, x: float) -> float | None:
        """Height of the ground at x [m]; None: there is none."""
        if x not in self._heights:
            self._heights[x] = highest_ground(self.scene, x, x) if visible_ground(self.scene, x, x) else None
        return self._heights[x]

    def _label(self, metres: float) -> pygame.Surface:
        if metres not in self._labels:
            text = f"{metres:g} m".replace("-", "−")
            self._labels[metres] = self._font.render(text, True, self.colours(TICK_TEXT)).premul_alpha()
        return self._labels[metres]

    def _grid_line(self, part: float) -> pygame.Surface:
        """A vertical line one pixel wide that begins `part` of a pixel from the left."""
        import pygame

        line = pygame.Surface((2, self.camera.size[1]), pygame.SRCALPHA, 32)
        for column, share in enumerate((1 - part, part)):
            line.fill(premultiplied(self.colours((*GRID, round(255 * share)))), (column, 0, 1, self.camera.size[1]))
        return line

    def _grid_lines(self, step: int) -> Iterator[tuple[pygame.Surface, Place]]:
        origin, width = self.camera.origin(step)[0], self.camera.size[0]
        spacing = SUBPIXELS * self.camera.scale * self.camera.spacing
        for k in range(math.ceil(-origin / spacing), math.floor((SUBPIXELS * width - origin) / spacing) + 1):
            x, part = divmod(math.floor(origin + k * spacing - 0.5 * SUBPIXELS + 0.5), SUBPIXELS)  # never half to even
            yield self._grid[part], (x, 0)


class Tile:
    """A part of the world: of one colour, or with a picture for each of its looks."""

    def __init__(self, scenery: Scenery, place: Place) -> None:
        import pygame

        self._looks: dict[Place, pygame.Surface] = {}
        # three times larger, and from so far left and above that each look lies in it; [px / SUBPIXELS]
        extent = SUBPIXELS * np.array(TILE) + SUBPIXELS - 1
        self._corner = SUBPIXELS * np.array(place) * TILE - (SUBPIXELS - 1)
        self._canvas = pygame.Surface(extent.tolist(), pygame.SRCALPHA, 32)
        unit = SUBPIXELS * scenery.camera.scale  # [px / SUBPIXELS / m]
        (left, _), (right, bottom) = self._corner / unit, (self._corner + extent) / unit
        for colour, corners in scenery.shapes(left, right, -bottom):
            points = corners * (unit, -unit) - self._corner
            if (points.max(axis=0) >= 0).all() and (points.min(axis=0) <= extent).all():
                pygame.draw.polygon(self._canvas, scenery.colours(colour), points.tolist())
        self._labels = list(self._draw_ruler(scenery))
        buffer: Any = self._canvas.get_buffer()
        pixels = np.frombuffer(buffer, np.uint32)
        self.mixed = bool(self._labels) or bool((pixels != pixels[0]).any())
        self.colour = tuple(self._canvas.get_at((0, 0)))  # where it is not mixed; transparent: nothing there
        if not self.mixed:
            del self._canvas  # of no more use, and half a megabyte

    def look(self, across: int, down: int) -> pygame.Surface:
        """The picture, colours times alpha, where the world lies that far right and down [px / SUBPIXELS]."""
        if (across, down) not in self._looks:
            self._looks[across, down] = self._draw_look(across, down)
        return self._looks[across, down]

    def _draw_look(self, across: int, down: int) -> pygame.Surface:
        import pygame

        corner = (SUBPIXELS - 1 - across, SUBPIXELS - 1 - down)
        part = self._canvas.subsurface(corner, [SUBPIXELS * n for n in TILE])
        look = pygame.transform.smoothscale(part, TILE)
        for label, x, y in self._labels:
            place = round((x + across) / SUBPIXELS - label.get_width() / 2), round((y + down) / SUBPIXELS)
            look.blit(label, place, special_flags=pygame.BLEND_PREMULTIPLIED)
        return look

    def _draw_ruler(self, scenery: Scenery) -> Iterator[tuple[pygame.Surface, float, float]]:
        """Draws the ticks; the labels that reach into the tile, with the middle and top of each [px / SUBPIXELS]."""
        zoom, unit = SUBPIXELS * scenery.zoom, SUBPIXELS * scenery.camera.scale
        extent, reach = self._canvas.get_size(), LABEL_REACH * zoom
        for metres, height, label in scenery.ticks(
            *((self._corner[0] + x) / unit for x in (-reach, extent[0] + reach))
        ):
            x, y = metres * unit - self._corner[0], -height * unit - self._corner[1] + 5 * zoom
            length = (12 if label else 4) * zoom
            line = (round(x - 0.5 * SUBPIXELS), round(y), SUBPIXELS, round(length))
            self._canvas.fill(scenery.colours((*TICK, 255)), line)
            if label and -SUBPIXELS * label.get_height() < y + 15 * zoom < extent[1]:
                yield label, x, y + 15 * zoom
