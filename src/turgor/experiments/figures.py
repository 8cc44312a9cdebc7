"""Figures of a campaign, drawn from its rows: for each a function that makes it, None where its rows are missing."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from turgor.experiments.plan import STUDY_BODY
from turgor.experiments.rows import Champion, Comparison, CurvePoint, Effect, QuasiStatic, Tables
from turgor.experiments.sheets import (
    GREY,
    INK,
    LOOKS,
    SIZES,
    SMALL_TEXT,
    WIDTH,
    Drawing,
    Figure,
    Look,
    bodies_of,
    make_sheet,
    note,
    of_question,
    paper_style,
    span_of,
    write_drawing,
)
from turgor.experiments.statistics import smallest_p
from turgor.experiments.terrains import draw_terrains
from turgor.recording import Recording

MEASURES = ("best", "robust")
TANGLED = "xxxxx"  # hatch


def draw_figures(tables: Tables, films: Mapping[str, Recording], folder: Path) -> list[Figure]:
    """The figures for which `tables` has rows, written to `folder` as SVG, PDF and PNG.

    `films` are recordings of the RQ1 champions by the name of their run; where one is missing the figure of the
    terrains says so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return [write_drawing(drawing, folder) for drawing in drawings(tables, films)]


def drawings(tables: Tables, films: Mapping[str, Recording]) -> list[Drawing]:
    """The figures for which `tables` has rows."""
    with paper_style():
        made = [
            draw_inflation(tables),
            draw_hilly(tables),
            draw_escape(tables),
            draw_effects(tables),
            draw_terrains(tables, films),
        ]
    return [drawing for drawing in made if drawing is not None]


# --- RQ0: inflation -----------------------------------------------------------------------------------------------


def draw_inflation(tables: Tables) -> Drawing | None:
    """RQ0: the body under the author's protocol, and in balance."""
    if not tables.inflation and not tables.quasistatic:
        return None
    figure = make_sheet(3.1)
    grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1))
    if tables.inflation:
        upper = figure.add_subplot(grid[0, 0])
        _draw_protocol(tables, upper, figure.add_subplot(grid[1, 0], sharex=upper))
    if tables.quasistatic:
        _draw_balance(tables.quasistatic, figure.add_subplot(grid[:, 1]))
    return Drawing(
        "inflation",
        "A body under pressure",
        "Left: area ratio ρ = area / (π r²) and prescribed pressure over time in the author's inflation test, one "
        "body of each size; colour: the amount of gas of the published program; grey, dashed: the 0.1 kg of gas that "
        "the text prints. "
        "Right: area ratio while the pressure rises so slowly that the body stays in balance on the ground under "
        "gravity; thin dotted: a ring without gravity, analytically; vertical line: the pressure n m g / (2 r) that "
        "carries the body's weight on its diameter; markers: p_max of each size. "
        "Source: inflation.csv, quasistatic.csv.",
        figure,
    )


def _draw_protocol(tables: Tables, upper: Any, lower: Any) -> None:
    for gas in ("text", "author"):
        for body in bodies_of(tables.inflation):
            rows = [row for row in tables.inflation if (row.gas, row.body) == (gas, body)]
            look, time = SIZES[body], [row.time for row in rows]
            how: dict[str, Any] = {"color": look.colour, "linestyle": look.line, "label": body}
            if gas == "text":
                how = {"color": GREY, "linestyle": "--", "linewidth": 1.0, "label": f"_{body}, text"}
            upper.plot(time, [row.area_ratio for row in rows], **how)
            lower.plot(time, [row.pressure_ratio for row in rows], **how)
    flat = [row for row in tables.inflation if row.gas == "text"]
    if flat:
        last = max(flat, key=lambda row: (row.time, row.area_ratio))
        at = (last.time, last.area_ratio)
        note(upper, "0.1 kg of gas, as printed", at, (0, 4), upper.transData, ha="right")
    upper.set_ylabel("area ratio ρ [1]")
    upper.set_ylim(0, None)
    upper.tick_params(labelbottom=False)
    upper.set_title("a  author's protocol", loc="left")
    upper.legend(
        loc="lower right", ncols=3, bbox_to_anchor=(1.02, 0.3), handlelength=2.1, columnspacing=0.8, fontsize=7
    )
    lower.set_ylabel("p / p$_\\mathrm{max}$ [1]")
    lower.set_xlabel("time [s]")
    lower.set_xlim(0, max(row.time for row in tables.inflation))


def _draw_balance(rows: Sequence[QuasiStatic], axes: Any) -> None:
    keys: list[Any] = []
    for body in bodies_of(rows):
        mine, look = [row for row in rows if row.body == body], SIZES[body]
        pressure = np.array([row.pressure for row in mine]) / 1000
        rho = [row.area_ratio for row in mine]
        analytic = [np.nan if row.analytic is None else row.analytic for row in mine]
        axes.plot(pressure, analytic, color=look.colour, linestyle=":", linewidth=0.9, label=f"_{body}, analytic")
        full = mine[0].pressure_max / 1000
        line = {"color": look.colour, "linestyle": look.line}
        axes.plot(pressure, rho, **line, label=body)
        mark = {"marker": look.marker, "markersize": 6.5, "markeredgecolor": "white"}
        if pressure[0] <= full <= pressure[-1]:
            axes.plot([full], [np.interp(full, pressure, rho)], **line, **mark, zorder=5, label=f"_{body}, p_max")
        keys += axes.plot([], [], **line, **mark, label=f"{body}, p$_\\mathrm{{max}}$ = {full:.1f} kPa")
    for lift_off in sorted({round(row.lift_off / 1000, 2) for row in rows}):
        axes.axvline(lift_off, color=GREY, linewidth=0.9)
        note(axes, f"lift-off {lift_off:g} kPa", (lift_off, 0.02), (3, 0), axes.get_xaxis_transform())
    axes.set_title("b  quasi-static, pressure rising slowly", loc="left")
    axes.set_xlabel("pressure [kPa]")
    axes.set_ylabel("area ratio ρ [1]")
    axes.set_xlim(0, max(row.pressure for row in rows) / 1000)
    axes.set_ylim(0, None)
    keys += axes.plot([], [], color=INK, linestyle=":", linewidth=0.9, label="without gravity, analytic")
    axes.legend(handles=keys, loc="lower right", bbox_to_anchor=(1, 0.1), handlelength=3.2)


# --- RQ1 and RQ2: curves and champions ----------------------------------------------------------------------------


def draw_hilly(tables: Tables) -> Drawing | None:
    """RQ1: how fitness grows, and what the champions are worth."""
    champions = of_question(tables.champions, "rq1")
    if not champions:
        return None
    bodies = bodies_of(champions)
    figure = make_sheet(4.9)
    axes = figure.subplots(2, len(bodies), sharey="row", squeeze=False, height_ratios=(1, 1.25))
    _draw_courses(tables, "rq1", champions, axes)
    figure.legend(handles=_condition_handles(champions), loc="outside upper center", ncols=3, handlelength=3)
    caption = f"{_describe_courses(champions, tables)} Source: curves.csv, champions.csv, comparisons.csv."
    return Drawing("hilly", "Locomotion on hilly ground", caption, figure)


def draw_escape(tables: Tables) -> Drawing | None:
    """RQ2: how fitness grows, what the champions are worth, and from how many of their starts they escape."""
    champions = of_question(tables.champions, "rq2")
    if not champions:
        return None
    bodies = bodies_of(champions)
    figure = make_sheet(7.6)
    axes = figure.subplots(4, len(bodies), sharey="row", squeeze=False, height_ratios=(1, 1.25, 0.75, 0.6))
    _draw_courses(tables, "rq2", champions, axes[:2])
    times = {c.run: [s.time for s in tables.starts if s.run == c.run and s.solved] for c in champions}
    for column, body in enumerate(bodies):
        _draw_outcomes([c for c in champions if c.body == body], times, axes[2, column], axes[3, column])
    axes[2, 0].set_ylabel("moved starts [1]")
    axes[2, 0].set_ylim(0, max(c.starts for c in champions))
    axes[3, 0].set_ylabel("time to\nescape [s]")
    axes[3, 0].set_ylim(0, max([1.0, *(s.time for s in tables.starts if s.run in times)]))
    figure.legend(handles=_condition_handles(champions), loc="outside upper center", ncols=3, handlelength=3)
    _draw_outcome_keys(axes[2, 0])
    caption = (
        f"{_describe_courses(champions, tables)} "
        f"Third row: from how many of its {champions[0].starts} moved starts each champion, by seed, escapes (filled "
        "bars, from below) and at how many it ends with a wall through one of its springs (hatched, from above); star: "
        "it escapes from its own start. Fourth row: time to escape from each of the moved starts that it escapes from "
        "(points), and the median (line). A passive body does not depend on the seed: one value. "
        "Source: curves.csv, champions.csv, comparisons.csv, starts.csv."
    )
    return Drawing("escape", "Escape from a cage", caption, figure)


def _describe_courses(champions: Sequence[Champion], tables: Tables) -> str:
    cells = {(c.body, c.condition) for c in champions if c.condition != "passive"} or {
        (c.body, c.condition) for c in champions
    }
    tested = [c for c in tables.comparisons if (c.question, c.measure) == (champions[0].question, "robust")]
    # a group that is wholly above another: the least p, paid for as often as there are comparisons
    least = min([1.0, *(len(tested) * smallest_p(c.count_a, c.count_b) for c in tested)])
    least = f" The smallest p that so few champions can give in so many comparisons: {least:.2g}." if tested else ""
    seeds = span_of({sum((c.body, c.condition) == cell for c in champions) for cell in cells})
    return (
        f"Top: best fitness so far, median over seeds (n = {seeds}), band: one sample standard deviation to either "
        "side; passive bodies do not evolve: the median of their fitness. Second row: best fitness of the champions "
        f"(n = {seeds}), and their robust fitness, each the median over {champions[0].starts} starts moved by a "
        "millionth of a metre. Box: quartiles and median; whiskers: the farthest champion within 1.5 box heights; "
        "points: every champion, from left to right by seed, those of one seed joined. Above the boxes: p of two-sided "
        "Mann-Whitney tests of robust fitness, with Holm's correction, and A, Vargha and Delaney's A12: how often a "
        "champion of the left box is better than one of the right." + least
    )


def _draw_courses(tables: Tables, question: str, champions: Sequence[Champion], axes: Any) -> None:
    """A column for each body: curves over boxes."""
    bodies = bodies_of(champions)
    compared = [c for c in tables.comparisons if (c.question, c.measure) == (question, "robust")]
    curves = [p for p in tables.curves if p.question == question]
    values = [getattr(c, measure) for c in champions for measure in MEASURES]
    pad = 0.06 * (max(values) - min(values) or 1.0)
    low, high = min(0.0, *values) - pad, max(values) + pad
    room = 0.1 * max(sum(c.body == body for c in compared) for body in bodies)  # share of the height, for brackets
    for column, (body, upper, lower) in enumerate(zip(bodies, *axes, strict=True)):
        mine = [c for c in champions if c.body == body]
        _draw_curves([p for p in curves if p.body == body], mine, upper)
        upper.set_title(body, loc="left")
        upper.set_xlim(0, max([p.evaluations for p in curves], default=1000) / 1000)
        places = _draw_boxes(mine, lower)
        lower.set_ylim(low, low + (high - low) / (1 - room))
        if column == 0:
            lower.set_yticks([tick for tick in lower.get_yticks() if low <= tick <= high])
        _draw_tests([c for c in compared if c.body == body], places, lower)
    axes[0, 0].set_ylabel("best so far [m/s]")
    axes[1, 0].set_ylabel("fitness [m/s]")


def _draw_curves(curves: Sequence[CurvePoint], champions: Sequence[Champion], axes: Any) -> None:
    for condition, look in LOOKS.items():
        points = [p for p in curves if p.condition == condition]
        if points:
            at = np.array([p.evaluations for p in points]) / 1000
            median, std = np.array([p.median for p in points]), np.array([p.std for p in points])
            axes.fill_between(at, median - std, median + std, color=look.colour, alpha=0.16, linewidth=0)
            for edge in (median - std, median + std):
                axes.plot(at, edge, color=look.colour, linestyle=look.line, linewidth=0.4, label="_edge")
            axes.plot(at, median, color=look.colour, linestyle=look.line, label=condition)
        still = [c.best for c in champions if c.condition == condition == "passive"]
        if still:
            axes.axhline(float(np.median(still)), color=look.colour, linestyle=look.line, label=condition)
    axes.set_xlabel("evaluations [1000]")


def _draw_boxes(champions: Sequence[Champion], axes: Any) -> dict[str, float]:
    """Two groups, best and robust, of a box for every condition; where in the second each condition stands."""
    groups = {condition: [c for c in champions if c.condition == condition] for condition in LOOKS}
    groups = {condition: sorted(group, key=lambda c: c.seed) for condition, group in groups.items() if group}
    seeds = sorted({c.seed for c in champions})
    aside = dict(zip(seeds, np.linspace(-0.24, 0.24, len(seeds)) if len(seeds) > 1 else [0.0], strict=True))
    step = len(groups) + 0.6
    for start, measure in zip((0.0, step), MEASURES, strict=True):
        ways: dict[int, list[tuple[float, float]]] = {}
        for place, (condition, group) in enumerate(groups.items(), 1):
            look, values = LOOKS[condition], [getattr(c, measure) for c in group]
            # one for many seeds: not of any of them
            alone = len(group) == 1 < len(seeds)
            x = [start + place + (0.0 if alone else aside[c.seed]) for c in group]
            if len(group) > 1:
                _draw_box(values, start + place, look, axes)
            how: dict[str, Any] = {"markeredgecolor": "white", "markeredgewidth": 0.4, "zorder": 3}
            size = 3.6 if len(group) <= 8 else 2.8
            axes.plot(x, values, look.marker, color=look.colour, ms=size, label=f"{measure}, {condition}", **how)
            for c, at, value in zip(group, x, values, strict=True):
                if not alone:
                    ways.setdefault(c.seed, []).append((at, value))
        for way in ways.values():
            axes.plot(*zip(*way, strict=True), color="#999999", linewidth=0.5, zorder=2.5, label="_seed")
    middle = (len(groups) + 1) / 2
    axes.set_xticks([middle, step + middle], MEASURES)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(0.4, step + len(groups) + 0.6)
    axes.grid(visible=False, axis="x")
    return {condition: step + place for place, condition in enumerate(groups, 1)}


def _draw_box(values: Sequence[float], place: float, look: Look, axes: Any) -> None:
    from matplotlib.colors import to_rgba

    face, edge = to_rgba(look.colour, 0.13), to_rgba(look.colour, 0.6)
    axes.boxplot(
        values,
        positions=[place],
        widths=0.66,
        showfliers=False,
        showcaps=False,
        manage_ticks=False,
        patch_artist=True,
        boxprops={"facecolor": face, "edgecolor": edge, "hatch": look.hatch, "linewidth": 0.8},
        medianprops={"color": look.colour, "linewidth": 1.8},
        whiskerprops={"color": look.colour, "linewidth": 0.8},
    )


def _draw_tests(compared: Sequence[Comparison], places: Mapping[str, float], axes: Any) -> None:
    """A bracket for every comparison, one above the other, down from the upper edge."""
    where = axes.get_xaxis_transform()
    for k, one in enumerate(reversed(compared)):
        left, right = sorted((places[one.a], places[one.b]))
        y = 0.96 - 0.1 * k
        ends = [left, left, right, right]
        axes.plot(ends, [y - 0.025, y, y, y - 0.025], color=INK, linewidth=0.7, transform=where, label="_test")
        p = "p < 0.001" if one.p_holm < 0.001 else f"p = {one.p_holm:.2g}"
        effect = one.effect if places[one.b] == left else 1 - one.effect
        how = {"ha": "right", "va": "center", "fontsize": SMALL_TEXT, "transform": where}
        axes.text(left - 0.15, y, f"{p}, A = {effect:.2f}", **how)


def _draw_outcomes(champions: Sequence[Champion], times: Mapping[str, Sequence[float]], upper: Any, lower: Any) -> None:
    """How often each champion escapes and ends tangled; beneath, after how long."""
    first, ticks = 0, {}
    for condition, look in LOOKS.items():
        group = sorted((c for c in champions if c.condition == condition), key=lambda c: c.seed)
        for x, c in enumerate(group, first):
            bar: dict[str, Any] = {"width": 0.8, "linewidth": 0.5, "label": c.run}
            upper.bar(x, c.solved_starts or 0, color=look.colour, hatch=look.hatch, edgecolor="white", **bar)
            if c.tangled_starts:
                upper.bar(x, -c.tangled_starts, bottom=c.starts, color="white", hatch=TANGLED, edgecolor=INK, **bar)
            if c.solved:
                upper.plot([x], [1.07 * c.starts], "*", color=INK, ms=5, mew=0, clip_on=False, label=c.run)
            lower.plot([x] * len(times[c.run]), times[c.run], look.marker, color=look.colour, ms=2.6, alpha=0.7)
            if c.escape_time is not None:
                lower.plot([x - 0.45, x + 0.45], [c.escape_time] * 2, color=INK, linewidth=1.2, label=c.run)
            if condition != "passive" and (len(group) <= 10 or (x - first) % 5 == 0):
                ticks[x] = str(c.seed)
        if group:
            middle = first + (len(group) - 1) / 2
            note(lower, condition, (middle, 0), (0, -13), lower.get_xaxis_transform(), ha="center", va="top")
            first += len(group) + 1
    for axes in (upper, lower):
        axes.set_xticks(list(ticks), list(ticks.values()))
        axes.tick_params(axis="x", length=0, pad=2)
        axes.set_xlim(-0.8, first - 0.7)
        axes.grid(visible=False, axis="x")
    upper.tick_params(labelbottom=False)
    upper.set_title(" ", fontsize=8.5)  # room for stars and keys


def _draw_outcome_keys(axes: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    star = Line2D([], [], color=INK, linestyle="", marker="*", ms=5, mew=0, label="escapes from its own start")
    wall = Patch(facecolor="white", edgecolor=INK, hatch=TANGLED, linewidth=0.5, label="moved starts that end tangled")
    escape = Patch(facecolor="#0072B2", label="moved starts that escape")
    keys = axes.legend(
        handles=[escape, wall, star], loc="lower left", bbox_to_anchor=(-0.05, 1.04), ncols=3, fontsize=7
    )
    keys.set_in_layout(False)


def _condition_handles(champions: Sequence[Champion]) -> list[Any]:
    from matplotlib.lines import Line2D

    known = {c.condition for c in champions}
    return [
        Line2D([], [], color=look.colour, linestyle=look.line, marker=look.marker, markersize=4, label=condition)
        for condition, look in LOOKS.items()
        if condition in known
    ]


# --- studies ------------------------------------------------------------------------------------------------------


def draw_effects(tables: Tables) -> Drawing | None:
    """Side studies: what every change does to robust fitness."""
    effects = tables.effects
    if not effects:
        return None
    changes = {e.change: e.says for e in effects}
    place = {change: -k for k, change in enumerate(changes)}
    tasks = [task for task in ("hilly", "escape") if any(e.task == task for e in effects)]
    above, row, below, labels = 0.4, 0.45, 0.42, 2.5  # [in]
    numbers = [1.25 if task == "escape" else 0.85 for task in tasks]
    total = above + row * len(changes) + below
    figure = make_sheet(total, layout=None)
    wide = (WIDTH - labels - sum(numbers)) / len(tasks)
    for k, task in enumerate(tasks):
        left = labels + k * wide + sum(numbers[:k])
        axes = figure.add_axes((left / WIDTH, below / total, wide / WIDTH, row * len(changes) / total))
        _draw_forest([e for e in effects if e.task == task], _pairs(tables.champions, task), place, axes)
        axes.set_ylim(0.5 - len(changes), 0.5)
        note(axes, f"{task}, {STUDY_BODY}", (0, 1), (0, 12), axes.transAxes, fontsize=8.5, color=INK)
        if k == 0:
            for change, y in place.items():
                note(axes, change, (0, y), (-6, 3), axes.get_yaxis_transform(), ha="right", fontsize=8, color=INK)
                says = textwrap.fill(changes[change], 54)
                note(axes, says, (0, y), (-6, 1), axes.get_yaxis_transform(), ha="right", va="top", fontsize=6)
    counts = span_of({n for e in effects for n in (e.count, e.count_paper)})
    least = min(smallest_p(e.count, e.count_paper) for e in effects)
    caption = (
        f"{STUDY_BODY.capitalize()} body with pressure control, n = {counts} seeds with each change and without. "
        "Diamonds and bars: difference of the medians of robust fitness, with - without the change, and its 95 % "
        "bootstrap interval, which is too narrow for less than five seeds (the smallest p that a test can give for so "
        f"few: {least:.2g}). Small points: the difference seed by seed, on hills therefore terrain by terrain. "
        "Numbers: medians with / without, and the share of moved starts that escape with / without. "
        "Source: effects.csv, champions.csv."
    )
    return Drawing("effects", "What the findings rest on", caption, figure)


def _pairs(champions: Sequence[Champion], task: str) -> dict[str, list[float]]:
    """Of every change the differences in robust fitness, seed by seed."""
    here = [c for c in champions if (c.task, c.body, c.condition) == (task, STUDY_BODY, "pressure")]
    paper = {c.seed: c.robust for c in here if not c.change}
    pairs: dict[str, list[float]] = {}
    for c in here:
        if c.change and c.seed in paper:
            pairs.setdefault(c.change, []).append(c.robust - paper[c.seed])
    return pairs


def _draw_forest(
    effects: Sequence[Effect], pairs: Mapping[str, Sequence[float]], place: Mapping[str, int], axes: Any
) -> None:
    colour, escapes = LOOKS["pressure"].colour, any(e.solved_starts is not None for e in effects)
    axes.axvline(0, color=INK, linewidth=0.9)
    for e in effects:
        y, at = place[e.change], pairs.get(e.change, [])
        axes.plot(at, [y - 0.22] * len(at), "o", color=GREY, ms=2.6, label=f"seeds, {e.change}")
        axes.plot([e.low, e.high], [y, y], color=colour, linewidth=1.6, solid_capstyle="butt", label="_interval")
        axes.plot([e.difference], [y], "D", color=colour, ms=5, markeredgecolor="white", label=e.change)
        beside: dict[str, Any] = {"va": "center", "fontsize": SMALL_TEXT, "color": INK}
        note(axes, f"{e.median:.2f} / {e.median_paper:.2f}", (1, y), (6, 0), axes.get_yaxis_transform(), **beside)
        if e.solved_starts is not None and e.solved_starts_paper is not None:
            share = f"{100 * e.solved_starts:.0f} / {100 * e.solved_starts_paper:.0f} %"
            note(axes, share, (1, y), (54, 0), axes.get_yaxis_transform(), **beside)
    note(axes, "with / without\nmedian [m/s]", (1, 1), (6, 2), axes.transAxes, fontsize=SMALL_TEXT)
    if escapes:
        note(axes, "escape", (1, 1), (54, 2), axes.transAxes, fontsize=SMALL_TEXT)
    axes.set_xlabel("difference [m/s]")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.locator_params(axis="x", nbins=5)
