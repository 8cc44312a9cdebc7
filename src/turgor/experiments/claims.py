"""Claims: what the paper says, what was measured, and whether it holds.

The claims are those of its abstract, and the significance that its analysis reports. A verdict follows from the numbers
by the rules below, so that it changes with them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from turgor.experiments.rows import Champion, Claim, Comparison, Inflated
from turgor.experiments.statistics import smallest_p

SIGNIFICANT = 0.05
ROUND = 0.8  # area ratio of a body that stands
MOVES = 2.0  # [m/s], robust fitness of an agent that no hollow holds
AT_REST = 10.0  # [s], over which what swings is averaged
UNDECIDED = "not decided: too few seeds for any difference to be significant"
SHARE_RELIABLE = 0.5  # of the moved starts from which a champion escapes


def check_claims(
    inflated: Sequence[Inflated], champions: Sequence[Champion], comparisons: Sequence[Comparison]
) -> list[Claim]:
    """The claims that the given rows say anything about."""
    claims = [_structure(inflated), _locomotion(champions, comparisons), _escape(champions)]
    claims += [_fundamental(champions, comparisons), _significance(comparisons)]
    return [claim for claim in claims if claim is not None]


def _structure(inflated: Sequence[Inflated]) -> Claim | None:
    """Holds where the area ratio, averaged over the last `AT_REST` seconds, is at least `ROUND`."""
    if not inflated:
        return None
    after = max(row.time for row in inflated) - AT_REST
    ratio: dict[tuple[str, str], list[float]] = {}
    for row in inflated:
        if row.time > after:
            ratio.setdefault((row.gas, row.body), []).append(row.area_ratio)
    last = {key: float(np.mean(values)) for key, values in ratio.items()}
    stands = {gas: [b for (g, b), rho in last.items() if g == gas and rho >= ROUND] for gas in ("author", "text")}
    bodies = list(dict.fromkeys(body for _, body in last))
    ratios = {g: ", ".join(f"{last[g, b]:.2f} ({b})" for b in bodies if (g, b) in last) for g in ("author", "text")}
    return Claim(
        question="rq0",
        claim="Pressure endows the agents with structure: a body inflates to a disc.",
        measured=f"Mean area ratio of the last {AT_REST:.0f} s: {ratios['author']}; with the printed 0.1 kg of gas "
        f"{ratios['text']}.",
        verdict=_verdict(stands["author"], bodies, "the program's amount of gas, not with the printed one"),
    )


def _locomotion(champions: Sequence[Champion], comparisons: Sequence[Comparison]) -> Claim | None:
    """Holds for a size whose champions outrun the passive body on every terrain and reach `MOVES` on most of them, in
    the median of their moved starts."""
    robust = {(c.condition, c.body, c.seed): c.robust for c in champions if c.question == "rq1"}
    bodies = list(dict.fromkeys(body for condition, body, _ in robust if condition == "pressure"))
    works, words = [], []
    for body in bodies:
        speed = {seed: v for (condition, b, seed), v in robust.items() if (condition, b) == ("pressure", body)}
        passive = {seed: robust["passive", body, seed] for seed in speed if ("passive", body, seed) in robust}
        moves, faster = sum(v >= MOVES for v in speed.values()), sum(speed[seed] > v for seed, v in passive.items())
        p = [c.p_holm for c in comparisons if _is(c, "rq1", "robust", "passive", "pressure") and c.body == body]
        words.append(
            f"{body}: median {np.median(list(speed.values())):.2f} m/s, {MOVES:g} m/s or more on {moves} of "
            f"{len(speed)} terrains, faster than the passive body on {faster}" + (f" (p = {p[0]:.2g})" if p else "")
        )
        if 2 * moves > len(speed) and faster == len(speed):
            works.append(body)
    if not bodies:
        return None
    return Claim(
        question="rq1",
        claim="The agents are effective at locomotion on hilly terrain.",
        measured="; ".join(words) + ".",
        verdict=_verdict(works, bodies),
    )


def _escape(champions: Sequence[Champion]) -> Claim | None:
    """Holds for a size of whose champions most escape: once, or from most of their moved starts."""
    cells = _escaping(champions, "pressure")
    if not cells:
        return None
    once, reliable, words = [], [], []
    for body, found in cells.items():
        own = sum(bool(c.solved) for c in found)
        moved = sum((c.solved_starts or 0) >= SHARE_RELIABLE * c.starts for c in found)
        words.append(
            f"{body}: {own} of {len(found)} champions escape, {moved} from at least half of their moved starts"
        )
        if 2 * own > len(found):
            once.append(body)
        if 2 * moved > len(found):
            reliable.append(body)
    return Claim(
        question="rq2",
        claim="The agents are effective at escaping from a cage through a small aperture.",
        measured="; ".join(words) + ".",
        verdict=_verdict_of_two(once, reliable, list(cells)),
    )


def _fundamental(champions: Sequence[Champion], comparisons: Sequence[Comparison]) -> Claim | None:
    """Holds for a size whose escape is significantly better with pressure control than with springs alone."""
    found = {
        measure: [
            c for c in comparisons if (c.question, c.measure, c.a, c.b) == ("rq2", measure, "springs", "pressure")
        ]
        for measure in ("best", "robust")
    }
    if not found["best"]:
        return None
    works = {
        measure: [c.body for c in pairs if c.p_holm < SIGNIFICANT and c.difference > 0]
        for measure, pairs in found.items()
    }
    words = [f"{measure} fitness: {'; '.join(map(_against, pairs))}" for measure, pairs in found.items()]
    escapes = [
        f"{sum(bool(c.solved) for group in cells.values() for c in group)} of {sum(map(len, cells.values()))} {how}"
        for cells, how in (
            (_escaping(champions, "pressure"), "champions escape with pressure control"),
            (_escaping(champions, "springs"), "with springs alone"),
        )
    ]
    return Claim(
        question="rq2",
        claim="Controlling pressure is fundamental for shape change: without it agents do not escape.",
        measured=f"{', '.join(escapes)}. Medians [m/s], {', '.join(words)}.",
        verdict=UNDECIDED
        if _least(found["best"]) >= SIGNIFICANT
        else _verdict_of_two(works["best"], works["robust"], [c.body for c in found["best"]]),
    )


def _least(comparisons: Sequence[Comparison]) -> float:
    """The smallest corrected p that complete separation in one of the comparisons could give."""
    return len(comparisons) * min(smallest_p(c.count_a, c.count_b) for c in comparisons)


def _is(c: Comparison, question: str, measure: str, a: str, b: str) -> bool:
    return (c.question, c.measure, c.a, c.b) == (question, measure, a, b)


def _against(c: Comparison) -> str:
    return f"{c.body} {c.median_b:.2f} against {c.median_a:.2f} (p = {c.p_holm:.2g})"


def _escaping(champions: Sequence[Champion], condition: str) -> dict[str, list[Champion]]:
    cells: dict[str, list[Champion]] = {}
    for c in champions:
        if (c.question, c.condition) == ("rq2", condition):
            cells.setdefault(c.body, []).append(c)
    return cells


def _significance(comparisons: Sequence[Comparison]) -> Claim | None:
    """Cannot hold where even complete separation of the champions gives a larger p."""
    if not comparisons:
        return None
    sizes = (max(c.count_a for c in comparisons), max(c.count_b for c in comparisons))
    least = smallest_p(*sizes)
    return Claim(
        question="rq1, rq2",
        claim="Differences between conditions are significant at p < 0.001.",
        measured=f"Smallest p that {sizes[0]} against {sizes[1]} champions can give: {least:.2g}; smallest found: "
        f"{min(c.p for c in comparisons):.2g}. The paper's analysis notebook tests every logged generation as if it "
        "were an independent sample, which is how p < 0.001 can arise from few runs.",
        verdict="cannot hold for this number of seeds" if least >= 0.001 else _of_p(comparisons),
    )


def _of_p(comparisons: Sequence[Comparison]) -> str:
    smaller = sum(c.p_holm < 0.001 for c in comparisons)
    return f"holds for {smaller} of {len(comparisons)} comparisons"


def _verdict(works: Sequence[str], asked: Sequence[str], condition: str = "") -> str:
    """In words, for which of the sizes asked about it holds."""
    if not works:
        return "does not hold"
    if len(works) == len(asked):
        return f"holds with {condition}" if condition else "holds"
    return f"holds only for {', '.join(works)}" + (f", with {condition}" if condition else "")


def _verdict_of_two(best: Sequence[str], robust: Sequence[str], asked: Sequence[str]) -> str:
    """The verdict where the best evaluation and what is left of it from moved starts may differ."""
    if list(best) == list(robust):
        return _verdict(best, asked)
    first = "for the best evaluation" if len(best) == len(asked) else f"for the best evaluation of {', '.join(best)}"
    if not best:
        return f"holds only from moved starts, for {', '.join(robust)}"
    second = f"from moved starts for {', '.join(robust)}" if robust else "not from moved starts"
    return f"holds {first}, {second}"
