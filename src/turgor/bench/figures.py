"""The figures of the benchmarks' page, from the rows alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from turgor.bench.report import Row, rows_of
from turgor.experiments.sheets import GREY, SIZES, make_sheet, paper_style, save_sheet

SHAPES = {  # of the bodies whose masses vary: Okabe and Ito's colours, a line and a marker each
    "inflated": ("#0072B2", "-", "o"),
    "inflated, passive": ("#56B4E9", (0, (1, 1.2)), "^"),
    "collapsed": ("#D55E00", "-", "s"),
    "collapsed, points": ("#CC79A7", (0, (4, 1.3)), "D"),
}
PARTS = {  # of an evolution's time
    "simulation": ("simulation", "#0072B2", ""),
    "strategy": ("CMA-ES", "#E69F00", "////"),
    "python": ("Python, start included", "#999999", "...."),
    "disk": ("disk", "#D55E00", ""),
}
RATE = "million agent-steps/s"
COST = "µs per agent-step"


def draw_scaling(rows: Sequence[Row], path: Path) -> None:
    """Speed and cost over the batch, the masses, the segments and the threads: a panel each."""
    with paper_style():
        figure = make_sheet(5.6)
        panels = figure.subplots(2, 2)
        draw_batches(rows_of(rows, "scaling.batch"), panels[0, 0])
        draw_masses(rows_of(rows, "scaling.masses"), panels[0, 1])
        draw_segments(rows_of(rows, "scaling.segments"), panels[1, 0])
        draw_threads(rows_of(rows, "scaling.threads"), panels[1, 1])
        save_sheet(figure, path)


def draw_batches(rows: Sequence[Row], axes: Any) -> None:
    """Speed over agents at once, a line a body and a number of threads."""
    most = max(row.threads or 1 for row in rows)
    for body, threads in dict.fromkeys((row.body, row.threads) for row in rows):
        mine, look = rows_of(rows, "scaling.batch", body=body, threads=threads), SIZES[body]
        line = "-" if threads == 1 else (0, (4, 1.3))
        label = f"{body}, {threads} thread" + "s" * (threads != 1)
        filled = look.colour if threads == most else "white"
        how: dict[str, Any] = {
            "color": look.colour,
            "marker": look.marker,
            "markersize": 3.5,
            "markerfacecolor": filled,
        }
        axes.plot([row.batch for row in mine], [row.value for row in mine], linestyle=line, label=label, **how)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    label_axes(axes, "a  batch", "agents at once", RATE)
    axes.legend(loc="lower right", handlelength=3)


def draw_masses(rows: Sequence[Row], axes: Any) -> None:
    """Cost of a step over the body's masses, a line a shape."""
    for shape in dict.fromkeys(row.controllers for row in rows):
        mine, (colour, line, marker) = rows_of(rows, "scaling.masses", controllers=shape), SHAPES[shape]
        cost = [1 / row.value for row in mine]
        axes.plot(
            [row.size for row in mine], cost, color=colour, linestyle=line, marker=marker, markersize=3.5, label=shape
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = [10, 20, 40, 80, 160]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    label_axes(axes, "b  masses of the body, one thread", "masses", COST)
    axes.legend(loc="upper left", handlelength=3)


def draw_segments(rows: Sequence[Row], axes: Any) -> None:
    """Cost of a step over the terrain's segments."""
    look = SIZES["small"]
    axes.plot(
        [row.size for row in rows],
        [1 / row.value for row in rows],
        color=look.colour,
        marker=look.marker,
        markersize=3.5,
    )
    axes.set_xscale("log")
    axes.set_ylim(0, 1.5 * max(1 / row.value for row in rows))
    label_axes(axes, "c  length of the terrain, small body, one thread", "segments", COST)


def draw_threads(rows: Sequence[Row], axes: Any) -> None:
    """How many times as fast more threads are, a line a body; dotted: as many times as there are threads."""
    counts = sorted({row.threads or 1 for row in rows})
    for body in dict.fromkeys(row.body for row in rows):
        mine, look = rows_of(rows, "scaling.threads", body=body), SIZES[body]
        how: dict[str, Any] = {"color": look.colour, "linestyle": look.line, "marker": look.marker, "markersize": 4}
        axes.plot([row.threads for row in mine], [row.value / mine[0].value for row in mine], label=body, **how)
    axes.plot(counts, counts, ":", color=GREY, linewidth=0.9, zorder=0, label="as many times as threads")
    axes.set_xscale("log", base=2)
    axes.set_yscale("log", base=2)
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.set_yticks(counts, [str(count) for count in counts])
    axes.set_ylim(0.6, None)  # room for the legend
    label_axes(axes, "d  threads", "threads", "times as fast as one thread")
    axes.legend(loc="lower right", handlelength=3)


def draw_evolution(rows: Sequence[Row], path: Path) -> None:
    """Where the time of whole evolutions goes: a bar a body."""
    with paper_style():
        figure = make_sheet(2.0)
        axes = figure.subplots()
        bodies = list(dict.fromkeys(row.body for row in rows_of(rows, "evolution.wall")))
        for y, body in enumerate(reversed(bodies)):
            left = 0.0
            for part, (label, colour, hatch) in PARTS.items():
                (row,) = rows_of(rows, f"evolution.{part}", body=body)
                how: dict[str, Any] = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.5}
                axes.barh(y, row.value, left=left, height=0.6, label=label if y == 0 else None, **how)
                left += row.value
        axes.set_yticks(range(len(bodies)), list(reversed(bodies)))
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("time [s]")
        figure.legend(loc="outside upper center", ncols=len(PARTS), handlelength=1.6)
        save_sheet(figure, path)


def label_axes(axes: Any, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
