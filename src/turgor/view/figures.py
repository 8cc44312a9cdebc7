"""Figures of runs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.files import whole

BEST, MEDIAN, SIGMA = "#0072B2", "#D55E00", "#555555"  # Okabe and Ito's colours: told apart by everyone


def fitness_figure(
    history: Mapping[str, Any], path: str | os.PathLike[str], *, unit: str = "m/s", title: str = ""
) -> Path:
    """Path of the figure: best and median fitness, and sigma beneath, against evaluations.

    `history` holds arrays `evaluations`, `best`, `median`, `sigma`, one number a generation each. `unit` is
    the fitness's. The suffix of `path` chooses the format (.png, .pdf, .svg). Raises `InvalidInput`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    path = Path(path)
    columns = _columns(history)
    figure = Figure(figsize=(6.4, 4.4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    _draw_fitness(upper, columns, unit, title)
    _draw_sigma(lower, columns)
    for axes in (upper, lower):
        axes.grid(color="#dddddd", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    with whole(path) as partial:
        figure.savefig(partial)
    return path


def _columns(history: Mapping[str, Any]) -> dict[str, np.ndarray]:
    names = ("evaluations", "best", "median", "sigma")
    missing = [name for name in names if name not in history]
    if missing:
        raise InvalidInput(f"history: expected {', '.join(names)}", f"no {', '.join(missing)}")
    columns = {name: np.asarray(history[name], dtype=np.float64) for name in names}
    shapes = {column.shape for column in columns.values()}
    if len(shapes) != 1 or columns["best"].ndim != 1 or not columns["best"].size:
        raise InvalidInput("history: expected one number a generation in every column", describe(shapes))
    return columns


def _draw_fitness(axes: Any, columns: dict[str, np.ndarray], unit: str, title: str) -> None:
    evaluations = columns["evaluations"]
    marker = "o" if len(evaluations) < 3 else None
    axes.plot(evaluations, columns["best"], color=BEST, linewidth=1.8, marker=marker, label="best")
    axes.plot(evaluations, columns["median"], "--", color=MEDIAN, linewidth=1.4, marker=marker, label="median")
    axes.set_ylabel(f"fitness [{unit}]" if unit else "fitness")
    axes.set_title(title, loc="left", fontsize="medium")
    axes.legend(frameon=False, loc="best")


def _draw_sigma(axes: Any, columns: dict[str, np.ndarray]) -> None:
    marker = "o" if len(columns["sigma"]) < 3 else None
    axes.plot(columns["evaluations"], columns["sigma"], color=SIGMA, linewidth=1.2, marker=marker)
    if (columns["sigma"] > 0).all() and np.ptp(np.log10(columns["sigma"])) > 1:
        axes.set_yscale("log")
    axes.set_xlabel("evaluations")
    axes.set_ylabel("sigma [1]")
