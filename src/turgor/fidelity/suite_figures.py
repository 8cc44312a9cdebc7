"""The figures of the fidelity suite, from its rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from turgor.experiments.sheets import GREY, INK, PALE, make_sheet, paper_style, save_sheet
from turgor.fidelity.compare import HERE, name_of
from turgor.fidelity.figures import LOOKS
from turgor.fidelity.golden import Growth
from turgor.fidelity.populations import AGAIN, BOX2D, WIDE, Crossed, Ranked

SCENES = {"free": "free flight", "flat": "plane", "hills": "hills", "cage": "cage", "gas": "gas law, plane"}
SMALLEST = 1e-8  # [m], of what is drawn on a logarithmic axis


def draw_growth(rows: Sequence[Growth], path: Path) -> None:
    """How far each engine is from the golden data, over the steps: a panel a scene, a line a case."""
    with paper_style():
        figure = make_sheet(2.7)
        panels = figure.subplots(1, len(SCENES), sharey=True)
        for axes, (scene, title) in zip(panels, SCENES.items(), strict=True):
            mine = [row for row in rows if row.case.split("__")[1] == scene]
            for case in dict.fromkeys(row.case for row in mine):
                for engine in LOOKS:
                    _draw_course([r for r in mine if (r.case, r.engine) == (case, engine)], engine, axes)
                _draw_floor([r for r in mine if (r.case, r.engine) == (case, HERE)], axes)
            axes.set_yscale("log")
            axes.set_ylim(SMALLEST, 30)
            axes.set_title(title, loc="left")
            axes.set_xlabel("step")
        panels[0].set_ylabel("largest error [m]")
        _legend(figure, [e for e in LOOKS if e != BOX2D and any(r.engine == e for r in rows)], floor=True)
        save_sheet(figure, path)


def _draw_course(rows: Sequence[Growth], engine: str, axes: Any) -> None:
    if not rows or engine == BOX2D:  # on the data, to the last bit
        return
    steps, errors = [row.step for row in rows], [max(row.error, SMALLEST) for row in rows]
    width = 0.9 if engine == HERE else 0.6
    axes.plot(steps, errors, color=LOOKS[engine].colour, linewidth=width, alpha=0.9 if engine == HERE else 0.5)


def _draw_floor(rows: Sequence[Growth], axes: Any) -> None:
    axes.plot([r.step for r in rows], [max(r.floor, SMALLEST) for r in rows], color=GREY, linewidth=0.6, alpha=0.6)


def draw_ranks(rows: Sequence[Ranked], path: Path) -> None:
    """Rank correlation of random controllers with Box2D 2.3: a row a cell, a mark an engine."""
    with paper_style():
        figure = make_sheet(2.8)
        panels = figure.subplots(1, 2, sharey=True, sharex=True)
        for axes, task in zip(panels, ("hilly", "escape"), strict=True):
            mine = [row for row in rows if row.task == task]
            cells = list(dict.fromkeys((row.body, row.condition) for row in mine))
            for y, cell in enumerate(reversed(cells)):
                for row in mine:
                    if (row.body, row.condition) != cell or row.rank is None or row.against != BOX2D:
                        continue
                    if row.engine == BOX2D + AGAIN:
                        axes.plot(row.rank, y, "|", color=INK, markersize=13, markeredgewidth=1.6, clip_on=False)
                        continue
                    look, top = LOOKS[row.engine], 3 if row.engine == HERE else 2
                    axes.plot(row.rank, y, look.marker, color=look.colour, markersize=5, zorder=top, clip_on=False)
            axes.set_yticks(range(len(cells)), [f"{body}, {condition}" for body, condition in reversed(cells)])
            axes.set_xlim(0, 1)
            axes.set_title(f"{task}: rank correlation with Box2D 2.3", loc="left")
            axes.set_xlabel("Spearman's ρ of 60 random controllers")
        engines = [e for e in LOOKS if any(r.engine == e and r.against == BOX2D for r in rows)]
        _legend(figure, engines, floor=False, box2d="Box2D 2.3, start moved by 1e-6 m")
        save_sheet(figure, path)


def draw_champions(rows: Sequence[Crossed], path: Path) -> None:
    """Median fitness of each champion in other engines against Box2D 2.3, with quartiles."""
    with paper_style():
        figure = make_sheet(3.6)
        panels = figure.subplots(1, 2)
        for axes, task in zip(panels, ("hilly", "escape"), strict=True):
            mine = [r for r in rows if (r.task, r.moved) == (task, WIDE) and not r.engine.endswith(AGAIN)]
            low, high = (f([v for r in mine for v in (r.box2d, r.median)]) for f in (min, max))
            edge = 0.06 * (high - low)
            axes.plot([low - edge, high + edge], [low - edge, high + edge], color=PALE, zorder=0)
            for row in sorted(mine, key=lambda r: -list(LOOKS).index(r.engine)):
                look = LOOKS[row.engine]
                axes.plot([row.box2d] * 2, [row.lower, row.upper], color=look.colour, linewidth=0.6, alpha=0.5)
                how: dict[str, Any] = {"markeredgewidth": 0.5, "markeredgecolor": "white", "markersize": 4.5}
                axes.plot(row.box2d, row.median, look.marker, color=look.colour, **how)
            axes.set_xlabel("median in Box2D 2.3 [m/s]")
            axes.set_title(task, loc="left")
            axes.set_aspect("equal")
        panels[0].set_ylabel("median in another engine [m/s]")
        _legend(figure, [e for e in LOOKS if any(r.engine == e for r in rows)], floor=False)
        save_sheet(figure, path)


def _legend(figure: Any, engines: Sequence[str], *, floor: bool, box2d: str = "") -> None:
    from matplotlib.lines import Line2D

    handles = []
    for engine in engines:
        look = LOOKS[engine]
        shape: dict[str, Any] = {"linestyle": "-"} if floor else {"linestyle": "", "marker": look.marker}
        handles.append(Line2D([], [], color=look.colour, label=name_of(engine), **shape))
    if floor:
        handles.append(Line2D([], [], color=GREY, label="Box2D 2.3, start moved by 1e-6 m"))
    if box2d:
        handles.append(
            Line2D([], [], color=INK, linestyle="", marker="|", markersize=11, markeredgewidth=1.6, label=box2d)
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=3 if len(handles) > 4 else len(handles))
