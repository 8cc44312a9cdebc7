"""Terrains: where the champions of RQ1 went, and why some came no further."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from turgor.experiments.rows import Champion, Tables
from turgor.experiments.sheets import (
    GREY,
    INK,
    LOOKS,
    SMALL_TEXT,
    WIDTH,
    Drawing,
    bodies_of,
    make_sheet,
    note,
    of_question,
)
from turgor.recording import Recording
from turgor.view.shapes import visible_ground

SLOW = 2.0  # [m/s] of robust fitness: champions below it are stuck; terrains where every one is, trap
ZOOMS = 9  # stuck champions that are drawn large
MOMENTS = (0, 10, 20, 30)  # [s] at which the body is drawn
FOOT = 4.0  # [m] of ground that is shown below y = 0


class Hollow(NamedTuple):
    """Ground between two crests that a disc of the body's radius would roll over, and the body's stay there."""

    left: float  # [m], x of the crests
    right: float
    bottom: float  # [m], x of the lowest ground
    floor: float  # [m], y of the lowest ground
    depth: float  # [m], of the lowest ground beneath the right crest
    slope: float  # [degree], steepest ground from there up to the right crest
    seconds: float  # that the centre of mass was in there
    area_ratio: float  # median over these [1]: small for a body that has collapsed


def find_hollows(film: Recording) -> list[Hollow]:
    """The hollows in which the body of `film` was, from left to right; none without ground."""
    corners = _profile(film, -np.inf, np.inf)
    if not len(corners):
        return []
    radius, step = film.body.radius, 0.1
    x = np.arange(corners[0, 0], corners[-1, 0], step)
    y = np.interp(x, *corners.T)
    # height of the centre of a disc that rolls over the ground
    reach = np.arange(-radius, radius + step / 2, step)
    arc = np.sqrt(np.maximum(radius**2 - reach**2, 0))
    disc = np.max([np.interp(x + d, *corners.T) + h for d, h in zip(reach, arc, strict=True)], axis=0)
    crests = np.flatnonzero((disc[1:-1] > disc[:-2]) & (disc[1:-1] >= disc[2:])) + 1
    bounds = np.array([0, *crests, len(x) - 1])
    # in which of them the centre of mass is after every step
    where = (np.searchsorted(x[bounds], film.com[1:, 0], side="right") - 1).clip(0, len(bounds) - 2)
    hollows = []
    for k in np.unique(where):
        left, right = bounds[k], bounds[k + 1]
        bottom = left + int(y[left : right + 1].argmin())
        rise = np.diff(y[bottom : right + 1]) / step
        hollow = Hollow(
            left=float(x[left]),
            right=float(x[right]),
            bottom=float(x[bottom]),
            floor=float(y[bottom]),
            depth=float(y[right] - y[bottom]),
            slope=float(np.degrees(np.arctan(rise.max(initial=0.0)))),
            seconds=float((where == k).sum() * film.dt),
            area_ratio=float(np.median(film.area_ratio[1:][where == k])),
        )
        hollows.append(hollow)
    return hollows


def find_trapping(champions: Sequence[Champion]) -> list[tuple[str, int]]:
    """Body and seed of the terrains on which champions evolved, but none that is faster than `SLOW` robustly."""
    best: dict[tuple[str, int], float] = {}
    for c in of_question(champions, "rq1"):
        if c.condition != "passive":
            best[c.body, c.seed] = max(c.robust, best.get((c.body, c.seed), -np.inf))
    return [where for where, robust in best.items() if robust < SLOW]


def draw_terrains(tables: Tables, films: Mapping[str, Recording]) -> Drawing | None:
    """RQ1: where the champions with pressure control went, and what held those that got nowhere."""
    evolved = [c for c in of_question(tables.champions, "rq1") if c.condition != "passive"]
    seen = [c for c in evolved if c.run in films]
    if not seen:
        return None
    bodies, seeds = bodies_of(evolved), sorted({c.seed for c in evolved})
    trapping = find_trapping(evolved)
    stuck = [c for c in seen if c.robust < SLOW]
    stuck.sort(key=lambda c: ((c.body, c.seed) not in trapping, c.robust))
    zoomed = sorted(stuck[:ZOOMS], key=lambda c: (bodies.index(c.body), c.seed, c.condition))

    # every strip to the same scale, so that distances, slopes and bodies compare
    corners = np.concatenate([films[c.run].position.reshape(-1, 2) for c in seen])
    (left, lowest), (right, top) = corners.min(axis=0) - 3, corners.max(axis=0) + 2
    bottom, right = min(-FOOT, float(lowest)), max(right, left + 150)
    margin, gap, text, head, foot = 0.5, 0.12, 0.17, 0.25, 0.35  # [in]
    wide = (WIDTH - margin - gap * len(bodies)) / len(bodies)
    high = wide * float((top - bottom) / (right - left))
    zoom_gap, zoom_high, title = 0.2, 0.85, 0.5
    zoom_wide = (WIDTH - 0.15 - 3 * zoom_gap) / 3
    zoom_row = title + zoom_high + foot
    total = head + len(seeds) * (high + text) + foot + -(-len(zoomed) // 3) * zoom_row
    figure = make_sheet(total, layout=None)

    def add(x: float, y: float, width: float, height: float) -> Any:
        """Axes `x` and `y` [in] from the upper left corner."""
        return figure.add_axes((x / WIDTH, 1 - (y + height) / total, width / WIDTH, height / total))

    for row, seed in enumerate(seeds):
        for column, body in enumerate(bodies):
            axes = add(margin + column * (wide + gap), head + row * (high + text) + text, wide, high)
            axes.set(xlim=(left, right), ylim=(bottom, top))
            here = {c.condition: c for c in evolved if (c.body, c.seed) == (body, seed)}
            _draw_strip(films.get(here["pressure"].run) if "pressure" in here else None, "pressure", axes)
            numbers = ", ".join(f"{name} {here[name].robust:.2f}" for name in LOOKS if name in here)
            note(axes, numbers, (1, 1), (0, 2), axes.transAxes, ha="right", fontsize=SMALL_TEXT, color=INK)
            if (body, seed) in trapping:
                note(axes, "trapped", (0, 1), (0, 2), axes.transAxes, fontweight="bold", color=INK)
            if row == 0:
                note(axes, body, (0, 1), (0, 14), axes.transAxes, fontsize=8.5, color=INK)
            if column == 0:
                note(axes, f"seed {seed}", (0, 0.5), (-4, 0), axes.transAxes, ha="right", va="center", color=INK)
            axes.tick_params(labelbottom=row == len(seeds) - 1)
            if row == len(seeds) - 1:
                axes.set_xlabel("x [m]", labelpad=1)
    for k, c in enumerate(zoomed):
        y = head + len(seeds) * (high + text) + foot + k // 3 * zoom_row + title
        _draw_zoom(c, films[c.run], add(0.15 + k % 3 * (zoom_wide + zoom_gap), y, zoom_wide, zoom_high))
    caption = (
        "Terrains (grey) and the champions with pressure control, each from its own start: path of the centre of mass "
        f"and outline after {', '.join(map(str, MOMENTS[:-1]))} and {MOMENTS[-1]} s; one scale for all, heights not "
        "exaggerated. Numbers: robust fitness with pressure control and with springs alone [m/s]. Trapped: terrains "
        f"on which both stay below {SLOW:g} m/s. "
    )
    if zoomed:
        enlarged = f"{len(zoomed)} of the {len(stuck)}" if len(stuck) > len(zoomed) else f"the {len(zoomed)}"
        caption += (
            f"Beneath, enlarged: {enlarged} champions below {SLOW:g} m/s, with pressure control (blue) or springs "
            "alone (orange). Shaded: the hollow in which the centre of mass stayed longest, between two crests that a "
            "disc of the body's radius would roll over (or a wall); its depth from the lowest ground to the crest on "
            "the right (dashed), in metres and in the body's diameters, its steepest ground in between, and the median "
            "of the area ratio rho while the body was in it. " + _describe_crossed(seen, films)
        )
    caption += "Source: champions.csv, and recordings of the champions."
    return Drawing("terrains", "Where the champions went", caption, figure)


def _describe_crossed(champions: Sequence[Champion], films: Mapping[str, Recording]) -> str:
    """The deepest hollow that a body left behind: depth alone may hold none."""
    crossed = [
        (hollow.depth / (2 * films[c.run].body.radius), hollow, f"{c.body}, seed {c.seed}, {c.condition}")
        for c in champions
        for hollow in find_hollows(films[c.run])
        if films[c.run].com[-1, 0] > hollow.right
    ]
    if not crossed:
        return ""
    diameters, hollow, name = max(crossed)
    return (
        f"For comparison, the deepest hollow that a champion crossed: {hollow.depth:.1f} m or {diameters:.2f} "
        f"diameters, up to {hollow.slope:.0f} degrees, in {hollow.seconds:.1f} s ({name}). "
    )


def _draw_strip(film: Recording | None, condition: str, axes: Any) -> None:
    """Ground, path and outlines, within the limits of `axes`."""
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.grid(visible=False)
    if film is None:
        axes.text(0.5, 0.5, "no recording", transform=axes.transAxes, ha="center", va="center", color=GREY)
        return
    ground, colour = _profile(film, *axes.get_xlim()), LOOKS[condition].colour
    axes.fill_between(*ground.T, axes.get_ylim()[0], color="#d0d0d0", linewidth=0)
    axes.plot(*ground.T, color=GREY, linewidth=0.7, label="ground")
    for moment, position in _moments(film):
        for loop in film.body.chambers:
            around = position[[*loop, loop[0]]]
            axes.fill(*around.T, facecolor=colour, alpha=0.2, linewidth=0)
            axes.plot(*around.T, color=colour, linewidth=0.8, label=f"{moment} s")
    axes.plot(*film.com[::6].T, color=INK, linewidth=0.7, label="path")


def _draw_zoom(champion: Champion, film: Recording, axes: Any) -> None:
    """The whole way of a stuck body, and the hollow where it stayed longest."""
    hollow = max(find_hollows(film), key=lambda one: one.seconds, default=None)
    corners = film.position.reshape(-1, 2)
    (left, _), (right, high) = corners.min(axis=0) - 3, corners.max(axis=0) + 2
    if hollow is not None:
        left, right = min(left, hollow.left), max(right, hollow.right + 3)
    box = axes.get_window_extent()
    shape = box.width / box.height
    width = max(right - left, shape * (high + FOOT))
    left = (left + right - width) / 2
    axes.set(xlim=(left, left + width), ylim=(-FOOT, width / shape - FOOT))
    _draw_strip(film, champion.condition, axes)
    labels: list[tuple[list[str], np.ndarray]] = []
    for moment, position in _moments(film):
        centre = position.mean(axis=0)
        # one label for bodies that lie on each other
        near = next((texts for texts, there in labels if np.hypot(*(there - centre)) < 0.12 * width), None)
        if near is None:
            labels.append(([str(moment)], centre))
        else:
            near.append(str(moment))
    for moments, (x, y) in labels:
        paper = {"facecolor": "white", "alpha": 0.65, "linewidth": 0, "pad": 0.6}
        axes.text(x, y, f"{', '.join(moments)} s", ha="center", va="center", fontsize=SMALL_TEXT, bbox=paper)
    title = f"{champion.body}, seed {champion.seed}, {champion.condition}: {champion.robust:.2f} m/s"
    if hollow is not None:
        rim, diameters = hollow.floor + hollow.depth, hollow.depth / (2 * film.body.radius)
        line: dict[str, Any] = {"color": INK, "linewidth": 0.8}
        axes.axvspan(hollow.left, hollow.right, color="#F0E442", alpha=0.35, linewidth=0, zorder=0)
        axes.plot([hollow.bottom, hollow.right], [rim, rim], linestyle=(0, (3, 2)), label="rim", **line)
        axes.plot([hollow.bottom] * 2, [hollow.floor, rim], "_-", ms=4, label="depth", **line)
        title += (
            f"\n{hollow.seconds:.0f} s at ρ = {hollow.area_ratio:.2f} in a hollow,"
            f"\n{hollow.depth:.1f} m = {diameters:.2f} ø deep, up to {hollow.slope:.0f}°"
        )
    axes.set_xlabel("x [m]", labelpad=1)
    axes.set_title(title, loc="left", fontsize=7)


def _profile(film: Recording, left: float, right: float) -> np.ndarray:
    """Corners of the ground between x = `left` and `right` [m], shape [corner, 2]."""
    ground = sorted(visible_ground(film.scene, left, right))
    return np.array([*((a, ya) for a, ya, _, _ in ground), *((b, yb) for _, _, b, yb in ground[-1:])]).reshape(-1, 2)


def _moments(film: Recording) -> list[tuple[int, np.ndarray]]:
    """Those of `MOMENTS` that were recorded, and the positions of the masses [m] then."""
    steps = [(moment, round(moment / film.dt)) for moment in MOMENTS]
    return [(moment, film.position[step]) for moment, step in steps if step <= film.steps]
