"""Figures of crosschecks, drawn from their records and recordings: an engine has the same colour, line and marker
everywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from turgor.body import SIZES
from turgor.experiments.sheets import GREY, INK, SMALL_TEXT, WIDTH, Drawing, Look, make_sheet, paper_style
from turgor.experiments.sheets import SIZES as BODY_LOOKS
from turgor.fidelity.compare import HERE, HOLDS, name_of
from turgor.fidelity.records import Record, Row, Summary, quartiles
from turgor.recording import Recording
from turgor.scene import Scene
from turgor.view.shapes import visible_ground, wall_shapes

LOOKS = {
    HERE: Look("#0072B2", "-", "o", ""),
    "box2d": Look("#000000", (0, (4, 1.3)), "P", ""),
    "box2d-ccd": Look("#D55E00", (0, (5, 1.2, 1, 1.2)), "v", ""),
    "box2d-fine": Look("#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "^", ""),
    "box2d-v3": Look("#009E73", (0, (1, 1.1)), "s", ""),
}
SOLID = "#d0d0d0"  # ground and walls
MARGIN = 3.0  # [m], around a path
PATH_WIDTH, PATH_HEIGHTS = WIDTH - 0.7, (0.8, 3.2)  # [in], of the panel with the paths
ROOM = 60.0  # [m], what walls that are shown whole span at most, as those of the cage
DEEP = 100.0  # [m], of the ground below the panel


# --- one run ------------------------------------------------------------------------------------------------------


def draw_run(record: Record, scene: Scene, recordings: Mapping[str, Recording]) -> Drawing:
    """Fitness from moved starts, ranks of controllers, and the trajectories from the task's start in every engine.
    `recordings` are those of the champion, by engine."""
    paths = {engine: recording.com for engine, recording in recordings.items()}
    rows = len(record.samples)
    heights = [0.45 + 0.42 * rows, 1.5, _limits(paths, scene)[2]]
    if record.samples[0].ranked:
        heights[0] = max(heights[0], 2.0)
    with paper_style():
        figure = make_sheet(sum(heights) + 1.2 + 0.15 * rows)
        figure.get_layout_engine().set(w_pad=0.08)  # [in]: text is wider in some formats than where it is laid out
        grid = figure.add_gridspec(3, 2, height_ratios=heights, width_ratios=(1.9, 1))
        if record.samples[0].ranked:
            _draw_fitness(record, figure.add_subplot(grid[0, 0]))
            _draw_ranks(record, figure.add_subplot(grid[0, 1]))
        else:
            _draw_fitness(record, figure.add_subplot(grid[0, :]))
        _draw_course(record, recordings, figure.add_subplot(grid[1, :]))
        _draw_paths(record, scene, paths, figure.add_subplot(grid[2, :]))
        says = [f"{name_of(c.engine)}: {c.says}" for c in record.comparisons]
        figure.suptitle("\n".join([record.subject.title, *says]), x=0.01, ha="left", fontsize=8.5)
    caption = (
        f"Top left: fitness from {record.settings.repeats} starts moved by {record.settings.moved:g} m (points, "
        "from top to bottom the same "
        "starts), quartiles and median (box, line), and from the task's own start (diamond). Top right: fitness of "
        f"{len(record.samples[0].ranked)} random controllers. Middle: the centre of mass over time from the task's own "
        "start; vertical: from there on a mass is 1 cm apart. Bottom: its path; one scale for both axes."
    )
    return Drawing("crosscheck", f"{record.subject.title} in {rows} engines", caption, figure)


def _unit(record: Record) -> str:
    return f" [{record.subject.unit.strip()}]" if record.subject.unit else ""


def _draw_fitness(record: Record, axes: Any) -> None:
    """A row for every engine: each start, the quartiles, the median."""
    for k, sample in enumerate(record.samples):
        look, y = LOOKS[sample.engine], -k
        lower, upper = quartiles(sample)
        median = float(np.median(sample.fitness))
        box: dict[str, Any] = {"facecolor": look.colour, "alpha": 0.18, "linewidth": 0}
        axes.barh(y, upper - lower, left=lower, height=0.7, label=f"{sample.engine}, quartiles", **box)
        axes.plot([median] * 2, [y - 0.35, y + 0.35], color=look.colour, linewidth=2, label=f"{sample.engine}, median")
        aside = np.linspace(0.28, -0.28, len(sample.fitness))
        dots: dict[str, Any] = {"color": look.colour, "ms": 3, "alpha": 0.75, "mew": 0}
        axes.plot(sample.fitness, y + aside, look.marker, label=f"{sample.engine}, starts", **dots)
        own: dict[str, Any] = {"mfc": "white", "mec": INK, "mew": 0.9, "ms": 5}
        axes.plot([sample.own], [y], "D", label=f"{sample.engine}, own start", **own)
    names = [name_of(sample.engine).replace(" with", "\nwith") for sample in record.samples]
    worth = [f"{np.median(sample.fitness):.3f}{record.subject.unit}" for sample in record.samples]
    axes.set_yticks([-k for k in range(len(names))], [f"{n}\n{w}" for n, w in zip(names, worth, strict=True)])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(0.5 - len(names), 0.5)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel(f"fitness{_unit(record)}")
    axes.set_title(f"from {record.settings.repeats} moved starts; diamond: own start", loc="left")


def _draw_ranks(record: Record, axes: Any) -> None:
    """Every random controller's fitness there against here."""
    here, ranks = record.samples[0].ranked, {c.engine: c.rank for c in record.comparisons}
    for sample in record.samples[1:]:
        look, rank = LOOKS[sample.engine], ranks[sample.engine]
        label = f"{name_of(sample.engine)}: {'-' if rank is None else f'{rank:.2f}'}"
        axes.plot(here, sample.ranked, look.marker, color=look.colour, ms=3, alpha=0.75, mew=0, label=label)
    _add_diagonal(axes, [f for sample in record.samples for f in sample.ranked])
    floor = record.comparisons[0].rank_floor
    axes.set_title(f"ranks of {len(here)} controllers", loc="left")
    paper: dict[str, Any] = {"frameon": True, "framealpha": 0.8, "edgecolor": "none"}
    axes.legend(loc="upper left", fontsize=SMALL_TEXT, handletextpad=0.2, borderaxespad=0.1, **paper)
    axes.locator_params(nbins=4)
    if floor is not None:
        how: dict[str, Any] = {"ha": "right", "va": "bottom", "fontsize": SMALL_TEXT, "color": INK}
        axes.text(0.98, 0.02, f"turgor with itself: {floor:.2f}", transform=axes.transAxes, **how)
    axes.set_xlabel(f"turgor{_unit(record)}")
    axes.set_ylabel(f"there{_unit(record)}")


def _add_diagonal(axes: Any, values: Sequence[float]) -> None:
    """Square limits around `values`, and the line on which both are the same."""
    pad = 0.05 * (max(values) - min(values)) or 0.1
    ends = min(values) - pad, max(values) + pad
    axes.plot(ends, ends, color=GREY, linewidth=0.8, zorder=1, label="_the same")
    axes.set(xlim=ends, ylim=ends)


def _draw_course(record: Record, recordings: Mapping[str, Recording], axes: Any) -> None:
    """The centre of mass over time, and where it parts from that of this engine."""
    dt, floor = record.subject.dt, record.comparisons[0].parts_floor
    parts = {HERE: floor} | {c.engine: c.parts for c in record.comparisons}
    for engine, recording in recordings.items():
        look, step = LOOKS[engine], parts[engine]
        line: dict[str, Any] = {"color": look.colour, "linestyle": look.line}
        when = "never" if step is None else f"after {step * dt:.2f} s"
        name = f"{name_of(engine)}, 1 cm from {'itself, start moved,' if engine == HERE else HERE} {when}"
        axes.plot(recording.time, recording.com[:, 0], label=name, **line)
        if step is not None:
            axes.axvline(step * dt, linewidth=0.9, zorder=1, label="_1 cm apart", **line)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=2, fontsize=SMALL_TEXT + 0.5, borderaxespad=0.1)
    axes.set_xlim(0, max(recording.time[-1] for recording in recordings.values()))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("x of the centre [m]")


def _limits(paths: Mapping[str, np.ndarray], scene: Scene) -> tuple[np.ndarray, np.ndarray, float]:
    """Lower left and upper right corner [m] of what the panel with the paths shows, and how high it is [in], so that
    one scale serves both axes."""
    corners, walls = np.concatenate(list(paths.values())), scene.segments[scene.depth == 0].reshape(-1, 2)
    if len(walls) and (np.ptp(walls, axis=0) < ROOM).all():
        corners = np.concatenate([corners, walls])
    low, high = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
    per_inch = (high[0] - low[0]) / PATH_WIDTH
    missing = max(PATH_HEIGHTS[0] * per_inch - (high[1] - low[1]), 0.0) / 2
    low[1], high[1] = low[1] - missing, high[1] + missing
    return low, high, min((high[1] - low[1]) / per_inch, PATH_HEIGHTS[1])


def _draw_paths(record: Record, scene: Scene, paths: Mapping[str, np.ndarray], axes: Any) -> None:
    """The paths of the centre of mass over the ground and within the walls."""
    low, high, _ = _limits(paths, scene)
    parts = {c.engine: c.parts for c in record.comparisons}
    for engine, path in paths.items():
        look = LOOKS[engine]
        axes.plot(*path.T, color=look.colour, linestyle=look.line, linewidth=1.1, label=name_of(engine))
        end: dict[str, Any] = {"color": look.colour, "ms": 5, "mec": "white", "mew": 0.5, "zorder": 3}
        axes.plot(*path[-1], look.marker, label=f"{engine}, end", **end)
        if parts.get(engine) is not None:
            axes.plot(*path[parts[engine]], "x", color=look.colour, ms=6, mew=1.6, zorder=3, label=f"{engine}, parts")
    _draw_scene(scene, low, high, axes)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", anchor="W")
    axes.grid(visible=False)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title("path of the centre of mass; cross: 1 cm apart from there on; marker: its end", loc="left")


def _draw_scene(scene: Scene, low: np.ndarray, high: np.ndarray, axes: Any) -> None:
    """Ground and walls between two corners [m]."""
    how: dict[str, Any] = {"facecolor": SOLID, "edgecolor": SOLID, "linewidth": 0.3, "zorder": 0}
    for a, ya, b, yb in visible_ground(scene, low[0], high[0]):
        axes.fill([a, b, b, a], [ya, yb, low[1] - DEEP, low[1] - DEEP], label="_ground", **how)
    for _, corners in wall_shapes(scene):
        axes.fill(*corners.T, label="_wall", **how)


# --- a campaign ---------------------------------------------------------------------------------------------------


def draw_campaign(rows: Sequence[Row], summaries: Sequence[Summary]) -> Drawing:
    """Every champion's median there against here, with quartiles: a column for each task, a row for each engine."""
    tasks, engines = (sorted({getattr(row, name) for row in rows}) for name in ("task", "engine"))
    wide = (WIDTH - 0.3) / max(len(tasks), 2)
    with paper_style():
        figure = make_sheet((wide + 0.5) * len(engines) + 0.3)
        panels = figure.subplots(len(engines), max(len(tasks), 2), squeeze=False)
        for axes in panels[:, len(tasks) :].flat:
            axes.set_axis_off()
        for line, engine in zip(panels, engines, strict=True):
            for axes, task in zip(line, tasks, strict=False):
                mine = [row for row in rows if (row.task, row.engine) == (task, engine)]
                summary = next(s for s in summaries if (s.task, s.engine) == (task, engine))
                _draw_medians(mine, summary, axes)
            line[0].set_ylabel(f"median in {name_of(engine)}")
        for axes in panels[-1, : len(tasks)]:
            axes.set_xlabel("median in turgor")
        _add_bodies(rows, figure)
    caption = (
        f"Every champion's median fitness over {rows[0].repeats} moved starts, there against here, with its "
        "quartiles (bars). Filled: it is worth as much there (the same, close or stronger); hollow: it is not. "
        "Source: rows.csv, summary.csv."
    )
    return Drawing("crosscheck", "The champions in other engines", caption, figure)


def _draw_medians(rows: Sequence[Row], summary: Summary, axes: Any) -> None:
    if not rows:
        axes.set_axis_off()
        return
    for row in rows:
        x, y, colour = row.median_here, row.median, LOOKS[row.engine].colour
        line: dict[str, Any] = {"color": colour, "linewidth": 0.6, "alpha": 0.4, "label": f"_{row.run}"}
        axes.plot([row.lower_here, row.upper_here], [y, y], **line)
        axes.plot([x, x], [row.lower, row.upper], **line)
        edge, face = ("white", colour) if row.verdict in HOLDS else (colour, "white")
        dot: dict[str, Any] = {"mec": edge, "mfc": face, "mew": 0.5 if face == colour else 0.9, "ms": 4.2, "zorder": 3}
        axes.plot([x], [y], _body_look(row.body).marker, label=row.run, **dot)
    _add_diagonal(axes, [v for r in rows for v in (r.lower_here, r.upper_here, r.lower, r.upper)])
    axes.set_aspect("equal")
    rank = "" if summary.rank is None else f", ranks {summary.rank:.2f}"
    axes.set_title(f"{summary.task}\n{summary.hold} of {summary.champions} hold{rank}", loc="left")


def _body_look(body: str) -> Look:
    return BODY_LOOKS.get(body, Look(INK, "-", "D", ""))


def _add_bodies(rows: Sequence[Row], figure: Any) -> None:
    """The key to the markers."""
    from matplotlib.lines import Line2D

    bodies = sorted({row.body for row in rows}, key=[*SIZES, "custom"].index)
    how: dict[str, Any] = {"linestyle": "", "mec": INK, "mew": 0.9, "ms": 4.2}
    keys = [Line2D([], [], marker=_body_look(body).marker, mfc=INK, label=body, **how) for body in bodies]
    keys.append(Line2D([], [], marker="o", mfc="white", label="hollow: does not hold, or differs", **how))
    figure.legend(handles=keys, loc="outside lower center", ncols=len(keys))
