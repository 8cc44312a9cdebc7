"""Sheets: how the figures of a campaign look, and how they are written.

Made for paper: 7 inches wide, vectors, text that stays text. Colours are Okabe and Ito's; line styles, markers and
hatches tell apart in grey what they tell apart in colour. No display is needed, and the same rows give the same bytes.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from turgor.experiments.plan import BODIES
from turgor.experiments.rows import Champion
from turgor.files import whole, write_whole

WIDTH = 7.0  # [in]
FORMATS = ("svg", "pdf", "png")
DATES = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}  # none: the same bytes every day
INK, GREY, PALE = "#222222", "#777777", "#dddddd"
STYLE: Any = {
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "hatch.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "svg.fonttype": "none",
    "svg.hashsalt": "turgor",
    "pdf.fonttype": 42,
}
SMALL_TEXT = 6.5  # [pt]


class Look(NamedTuple):
    colour: str
    line: Any
    marker: str
    hatch: str


LOOKS = {
    "pressure": Look("#0072B2", "-", "o", ""),
    "springs": Look("#D55E00", (0, (4, 1.3)), "s", "/////"),
    "passive": Look("#555555", (0, (1, 1.2)), "^", ""),
}
SIZES = {
    "small": Look("#E69F00", "-", "o", ""),
    "medium": Look("#009E73", (0, (5, 1.2)), "s", ""),
    "large": Look("#000000", (0, (5, 1.2, 1, 1.2)), "^", ""),
}


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """A figure and its files."""

    name: str
    title: str
    caption: str
    files: list[Path]  # NAME.svg, NAME.pdf, NAME.png


class Drawing(NamedTuple):
    """A figure that is not written yet."""

    name: str
    title: str
    caption: str
    figure: Any  # matplotlib's


@contextlib.contextmanager
def paper_style() -> Generator[None, None, None]:
    """matplotlib as it comes, whatever the user's settings, but for `STYLE`; its backend stays what it was."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def write_drawing(drawing: Drawing, folder: Path) -> Figure:
    files = [folder / f"{drawing.name}.{suffix}" for suffix in FORMATS]
    with paper_style():
        drawing.figure.draw_without_rendering()
        drawing.figure.set_layout_engine("none")  # laid out once for all formats
        for file, suffix in zip(files, FORMATS, strict=True):
            data = io.BytesIO()
            metadata = {"Title": drawing.title, **DATES[suffix]}
            drawing.figure.savefig(data, format=suffix, metadata=metadata, dpi=200)
            write_whole(file, data.getvalue())
    return Figure(name=drawing.name, title=drawing.title, caption=drawing.caption, files=files)


def make_sheet(height: float, layout: Any = "constrained") -> Any:
    """An empty figure, `height` inches high."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Sheet

    figure = Sheet(figsize=(WIDTH, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_sheet(figure: Any, path: Path) -> None:
    """Writes a figure as the picture of a page."""
    with whole(path) as partial:
        figure.savefig(partial, dpi=200)


def note(axes: Any, text: str, at: tuple[float, float], aside: tuple[float, float], where: Any, **how: Any) -> None:
    """Small text `aside` [pt] from the point `at` in the coordinates `where`."""
    how = {"fontsize": 7, "color": "#555555", **how}
    axes.annotate(text, at, xycoords=where, xytext=aside, textcoords="offset points", annotation_clip=False, **how)


def of_question(champions: Sequence[Champion], question: str) -> list[Champion]:
    return [c for c in champions if c.question == question]


def bodies_of(rows: Sequence[Any]) -> list[str]:
    """Sizes of `rows`, from small to large."""
    found = {row.body for row in rows}
    return [body for body in BODIES if body in found]


def span_of(counts: set[int]) -> str:
    return " to ".join(str(n) for n in sorted({min(counts), max(counts)}))
