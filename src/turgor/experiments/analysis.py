"""Analysis: from champions to curves, comparisons, effects and the paper's claims. Rows in, rows out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from turgor.experiments.measure import Measured
from turgor.experiments.plan import CHANGES, STUDY_BODY, STUDY_SEEDS
from turgor.experiments.rows import Champion, Comparison, CurvePoint, Effect
from turgor.experiments.statistics import effect_size, holm, mann_whitney, median_difference

CURVE_POINTS = 100
MEASURES = ("best", "robust")
# b against a; a passive cage has one outcome whatever the seed, which is no sample
PAIRS = {
    "rq1": (("springs", "pressure"), ("passive", "pressure"), ("passive", "springs")),
    "rq2": (("springs", "pressure"),),
}


class Cell(NamedTuple):
    """What differs only by its seed."""

    question: str
    task: str
    body: str
    condition: str
    change: str


def cell_of(champion: Champion) -> Cell:
    return Cell(champion.question, champion.task, champion.body, champion.condition, champion.change)


def by_cell(champions: Iterable[Champion]) -> dict[Cell, list[Champion]]:
    """Champions of every cell, by seed; cells in the order in which they come."""
    cells: dict[Cell, list[Champion]] = {}
    for champion in champions:
        cells.setdefault(cell_of(champion), []).append(champion)
    return {cell: sorted(found, key=lambda c: c.seed) for cell, found in cells.items()}


def find_curves(measured: Sequence[Measured]) -> list[CurvePoint]:
    """Median and spread over the seeds of the best fitness so far, for every cell that evolved."""
    cells: dict[Cell, list[Measured]] = {}
    for one in measured:
        if len(one.best):
            cells.setdefault(cell_of(one.champion), []).append(one)
    points = []
    for cell, runs in cells.items():
        budget = max(run.entry.evaluations for run in runs)
        first = max(run.evaluations[0] for run in runs)
        for at in np.unique(np.linspace(budget / CURVE_POINTS, budget, CURVE_POINTS).round().astype(int)):
            if at < first:
                continue
            so_far = [float(run.best[np.searchsorted(run.evaluations, at, side="right") - 1]) for run in runs]
            points.append(
                CurvePoint(
                    **cell._asdict(),
                    evaluations=int(at),
                    seeds=len(runs),
                    median=float(np.median(so_far)),
                    std=float(np.std(so_far, ddof=1)) if len(runs) > 1 else 0.0,
                    low=min(so_far),
                    high=max(so_far),
                )
            )
    return points


def compare(champions: Sequence[Champion]) -> list[Comparison]:
    """Every comparison of rq1 and rq2, best and robust; p is corrected over those of one question and measure."""
    cells = by_cell(champions)
    comparisons: list[Comparison] = []
    for question, pairs in PAIRS.items():
        bodies = list(dict.fromkeys(cell.body for cell in cells if cell.question == question))
        for measure in MEASURES:
            found = []
            for body in bodies:
                for a, b in pairs:
                    groups = [_values(cells, question, body, condition, measure) for condition in (a, b)]
                    if all(groups):
                        found.append(_comparison(question, body, measure, (a, b), *groups))
            comparisons += _corrected(found)
    return comparisons


def find_effects(champions: Sequence[Champion]) -> list[Effect]:
    """What every change of the side studies does to robust fitness, against the same seeds without it."""
    cells = by_cell(champions)
    effects = []
    for cell, changed in cells.items():
        if not cell.change:
            continue
        paper = [
            c
            for c in champions
            if (c.task, c.body, c.condition, c.change) == (cell.task, STUDY_BODY, cell.condition, "")
            and c.seed < STUDY_SEEDS
        ]
        if not paper:
            continue
        a, b = [c.robust for c in paper], [c.robust for c in changed]
        difference, low, high = median_difference(a, b)
        effects.append(
            Effect(
                task=cell.task,
                change=cell.change,
                says=CHANGES[cell.change].says,
                count=len(b),
                count_paper=len(a),
                median=float(np.median(b)),
                median_paper=float(np.median(a)),
                difference=difference,
                low=low,
                high=high,
                effect=effect_size(a, b),
                p=mann_whitney(a, b)[1],
                solved_starts=_share_solved(changed),
                solved_starts_paper=_share_solved(paper),
            )
        )
    return effects


def _values(cells: dict[Cell, list[Champion]], question: str, body: str, condition: str, measure: str) -> list[float]:
    for cell, champions in cells.items():
        if (cell.question, cell.body, cell.condition, cell.change) == (question, body, condition, ""):
            return [getattr(c, measure) for c in champions]
    return []


def _comparison(
    question: str, body: str, measure: str, names: tuple[str, str], a: list[float], b: list[float]
) -> Comparison:
    u, p = mann_whitney(a, b)
    difference, low, high = median_difference(a, b)
    return Comparison(
        question=question,
        task={"rq1": "hilly", "rq2": "escape"}[question],
        body=body,
        measure=measure,
        a=names[0],
        b=names[1],
        count_a=len(a),
        count_b=len(b),
        median_a=float(np.median(a)),
        median_b=float(np.median(b)),
        difference=difference,
        low=low,
        high=high,
        u=u,
        p=p,
        p_holm=p,
        effect=effect_size(a, b),
    )


def _corrected(found: list[Comparison]) -> list[Comparison]:
    corrected = holm([c.p for c in found]).tolist()
    return [msgspec.structs.replace(c, p_holm=p) for c, p in zip(found, corrected, strict=True)]


def _share_solved(champions: Sequence[Champion]) -> float | None:
    if any(c.solved_starts is None for c in champions):
        return None
    return sum(c.solved_starts or 0 for c in champions) / sum(c.starts for c in champions)
