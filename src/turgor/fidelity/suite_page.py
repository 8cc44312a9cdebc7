"""The page of the fidelity suite: every number on it is computed from the rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from turgor.experiments.plan import BODIES
from turgor.experiments.rows import markdown_table
from turgor.experiments.statistics import holm
from turgor.fidelity.compare import HERE, SURE, rank_correlation
from turgor.fidelity.golden import STEPS
from turgor.fidelity.populations import AGAIN, BOX2D, NEEDLE, STARTS, WIDE, Crossed, Ranked
from turgor.fidelity.suite import Suite
from turgor.fidelity.suite_figures import draw_champions, draw_growth, draw_ranks
from turgor.files import write_whole

NEAR = 0.02  # [1], of a champion's median in Box2D 2.3: the goal on hills
FAST = 1.0  # [m/s]: what a champion keeps is told where it had something
RANK = 0.9  # rank correlation of random controllers on hills: the goal

HEAD = """# Fidelity: does it hold in Box2D?

The paper's physics engine is Box2D, and a champion that works in ours alone would be an artefact. This page
compares turgor with the real Box2D, on everything from a single square to the champions of the whole campaign.
`turgor crosscheck --suite` makes it, from nothing but measurements: the tables behind it are in
[fidelity/](fidelity/). For a run of your own, `turgor crosscheck RUN` does the same:
[crosscheck.md](crosscheck.md), which also tells what was found about the differences that remain.

Two faithful engines part from each other, as Box2D parts from itself when a start is moved by a millionth of a
metre: contacts are chaotic. That is the **floor**, and nothing can agree better. So trajectories are compared while
they can be, and from then on distributions: of fitness from 30 moved starts, and of 60 random controllers and their
order.
"""


def write_page(out: Path, suite: Suite) -> Path:
    """Path of FOLDER/fidelity.md, with its figures in FOLDER/images."""
    images = out / "images"
    images.mkdir(exist_ok=True)
    draw_growth(suite.growth, images / "fidelity-growth.png")
    draw_ranks(suite.random, images / "fidelity-ranks.png")
    draw_champions(suite.champions, images / "fidelity-champions.png")
    write_whole(out / "fidelity.md", page_text(suite).encode())
    return out / "fidelity.md"


def page_text(suite: Suite) -> str:
    """The page as Markdown."""
    parts = [
        HEAD,
        _engines(suite),
        "## In short\n\n" + _short(suite),
        "## Trajectories: the golden data\n\n" + _golden(suite),
        "## Contacts with a known answer\n\n" + _contacts(suite),
        "## Random controllers\n\n" + _random(suite),
        "## Champions\n\n" + _champions(suite),
    ]
    return "\n".join(parts)


# --- text and tables ----------------------------------------------------------------------------------------------


def _names(suite: Suite) -> dict[str, str]:
    return {v.engine: v.says for v in suite.versions}


def _others(suite: Suite) -> list[str]:
    """All engines but Box2D 2.3, which the others are compared with."""
    return [v.engine for v in suite.versions if v.engine != BOX2D]


def _engines(suite: Suite) -> str:
    versions = dict.fromkeys(f"{v.says} ({v.version})" for v in suite.versions)
    return f"Compared were {', '.join(versions)}.\n"


def _metres(value: float) -> str:
    return "0" if value == 0 else f"{value:.0e}"


# --- in short -----------------------------------------------------------------------------------------------------


def _short(suite: Suite) -> str:
    lines = [
        _short_trajectories(suite),
        _short_contacts(suite),
        _short_ranks(suite),
        *(_short_medians(suite, moved) for moved in (NEEDLE, WIDE)),
        _short_random(suite),
        *(_short_distributions(suite, task, moved) for moved in (NEEDLE, WIDE) for task in ("hilly", "escape")),
        *(_short_engine(suite, engine) for engine in _others(suite)[1:]),
    ]
    told = (
        f"Champions are told twice: from starts moved by {NEEDLE:g} m, and by {WIDE:g} m. From the former most starts "
        "meet the same accident (one contact found or missed by rounding, for all of them together), so that a small p "
        "may count one accident many times; from the latter each meets its own. Significant is "
        f"p < {SURE} of a Kolmogorov-Smirnov test, by Holm's correction for all that are compared."
    )
    return markdown_table(["what", "goal", "measured", ""], lines) + f"\n{told}\n"


def _short_ranks(suite: Suite) -> tuple[str, str, str, str]:
    hilly, floor = _ranks(suite, HERE, "hilly"), _ranks(suite, BOX2D + AGAIN, "hilly")
    return (
        "Random controllers on hills: their order",
        f"rank correlation at least {RANK}",
        f"{min(hilly):.3f} to {max(hilly):.3f}; Box2D with itself {min(floor):.3f} to {max(floor):.3f}",
        _yes(min(hilly) >= RANK),
    )


def _short_random(suite: Suite) -> tuple[str, str, str, str]:
    cells = [row for row in suite.random if (row.task, row.engine, row.against) == ("escape", HERE, BOX2D)]
    p = holm([row.ks_p for row in cells])
    told = f"{int((p < SURE).sum())} of {len(cells)} sets differ; KS distance at most {max(r.ks for r in cells):.2f}"
    return "Random controllers in the cage", "no significant difference", told, _yes(bool((p >= SURE).all()))


def _short_medians(suite: Suite, moved: float) -> tuple[str, str, str, str]:
    mine, again = (_of(suite.champions, engine, "hilly", moved) for engine in (HERE, BOX2D + AGAIN))
    near, floor = (sum(abs(row.median / row.box2d - 1) <= NEAR for row in rows) for rows in (mine, again))
    middle = float(np.median([abs(row.median / row.box2d - 1) for row in mine]))
    told = f"{near} of {len(mine)} (Box2D again: {floor}), median difference {middle:.1%}; {_inside(mine)}"
    met = _yes(near == len(mine) and all(row.inside for row in mine))
    return (
        f"Champions on hills, starts moved by {moved:g} m: medians",
        f"within {NEAR:.0%}, inside the floor",
        told,
        met,
    )


def _short_distributions(suite: Suite, task: str, moved: float) -> tuple[str, str, str, str]:
    mine = _of(suite.champions, HERE, task, moved)
    where = "on hills" if task == "hilly" else "in the cage"
    different = _significant(mine)
    told = f"{len(different)} of {len(mine)} differ; {_inside(mine)}"
    what = f"Champions {where}, starts moved by {moved:g} m: distributions"
    return what, "no significant difference", told, _yes(not different)


def _inside(rows: Sequence[Crossed]) -> str:
    return f"{sum(row.inside for row in rows)} inside the floor, {0.95 * len(rows):.1f} by chance"


def _short_engine(suite: Suite, engine: str) -> tuple[str, str, str, str]:
    kept = [row.median / row.box2d for row in _of(suite.champions, engine, "hilly", WIDE) if row.box2d > FAST]
    told = f"{np.median(kept):.0%} ({min(kept):.0%} to {max(kept):.0%})" if kept else "none is as fast"
    return f"Champions faster than {FAST:g} m/s on hills: what they keep in {_names(suite)[engine]}", "told", told, ""


def _yes(met: bool) -> str:
    return "met" if met else "**not met**"


def _short_trajectories(suite: Suite) -> tuple[str, str, str, str]:
    calm = [r for r in suite.growth if r.engine == HERE and r.case.endswith(("ramp", "rest")) and r.step <= 60]
    return (
        "Trajectories of inflating bodies, first second",
        "1e-4 m, large on hills 2e-3 m",
        f"at most {_metres(max(r.error for r in calm))} m",
        _yes(all(r.error <= (2e-3 if r.case.startswith("large__hills") else 1e-4) for r in calm)),
    )


def _short_contacts(suite: Suite) -> tuple[str, str, str, str]:
    value = {(c.case, c.engine): c.value for c in suite.contacts}
    squares = [row for row in suite.squares if row.engine == HERE]
    worst = max(squares, key=lambda row: row.position)
    single = [row for row in squares if row.case != "squeeze"]
    slip = "slope on which a square begins to slip"
    return (
        f"Squares: {len(squares)} golden cases; slip angle",
        "1e-5 m (`squeeze` 1e-3 m); as in Box2D",
        f"at most {_metres(max(r.position for r in single))} m ({worst.case} {_metres(worst.position)} m); "
        f"{value[slip, HERE]:.2f} and {value[slip, BOX2D]:.2f} degrees",
        _yes(max(r.position for r in single) <= 1e-5 and abs(value[slip, HERE] - value[slip, BOX2D]) < 0.1),
    )


def _ranks(suite: Suite, engine: str, task: str) -> list[float]:
    rows = [row for row in suite.random if (row.engine, row.task, row.against) == (engine, task, BOX2D)]
    return [row.rank for row in rows if row.rank is not None]


def _of(rows: Sequence[Crossed], engine: str, task: str, moved: float) -> list[Crossed]:
    return [row for row in rows if (row.engine, row.task, row.moved) == (engine, task, moved)]


def _significant(rows: Sequence[Crossed]) -> list[Crossed]:
    """Rows whose distribution differs from Box2D 2.3's, by Holm's correction for all of them."""
    return [row for row, p in zip(rows, holm([row.ks_p for row in rows]), strict=True) if p < SURE]


# --- golden data --------------------------------------------------------------------------------------------------


def _golden(suite: Suite) -> str:
    names = _names(suite)
    cases = list(dict.fromkeys(row.case for row in suite.growth))
    exact = [r for r in suite.growth if r.engine == BOX2D and r.error == 0]
    total = [r for r in suite.growth if r.engine == BOX2D]
    text = (
        f"{len(cases)} courses of springs and pressure (free flight, plane, hills, cage; three sizes) and "
        f"{len({r.case for r in suite.squares})} of single squares were recorded with the C++ sources of Box2D "
        f"2.3.2. Box2D 2.3 through "
        f"its Python package, driven by turgor, gives the same numbers: {len(exact)} of {len(total)} compared frames "
        f"are equal to the last bit. "
        "Beside the errors stands the floor.\n\n![error growth](images/fidelity-growth.png)\n\n"
    )
    at = {(row.case, row.engine, row.step): row for row in suite.growth}
    engines = _others(suite)
    heads = ["case", *(f"{names[e]}: step {' / '.join(map(str, STEPS))} [m]" for e in engines), "floor [m]"]

    def course(case: str, engine: str, value: Callable[..., float]) -> str:
        found = [at.get((case, engine, step)) for step in STEPS]
        return " / ".join("-" if row is None else _metres(value(row)) for row in found)

    lines = [
        [
            case.replace("__", " "),
            *(course(case, engine, lambda row: row.error) for engine in engines),
            course(case, HERE, lambda row: row.floor),
        ]
        for case in cases
    ]
    text += _details(f"All {len(cases)} courses", markdown_table(heads, lines))
    errors = {(row.case, row.engine): row for row in suite.squares}
    squares = dict.fromkeys((row.case, row.says) for row in suite.squares)
    heads = ["case", "", *(f"{names[e]}: position [m], velocity [m/s]" for e in engines)]
    lines = [
        [
            case,
            says,
            *(f"{_metres(errors[case, e].position)}, {_metres(errors[case, e].velocity)}" for e in engines),
        ]
        for case, says in squares
    ]
    text += "\n" + _details(f"All {len(lines)} cases of squares: largest errors", markdown_table(heads, lines))
    lines = [
        [
            body,
            *(
                f"{row.worst:.4f}, {row.median:.4f}"
                for e in engines
                for row in suite.inflation
                if (row.engine, row.body) == (e, body)
            ),
        ]
        for body in BODIES
    ]
    told = "The inflation test (RQ0), 30 s on a plane: error of the area ratio in windows of 1 s, worst and median"
    return f"{text}\n{told}.\n\n" + markdown_table(["body", *(names[e] for e in engines)], lines)


def _details(summary: str, text: str) -> str:
    return f"<details><summary>{summary}</summary>\n\n{text}\n</details>\n"


# --- contacts -----------------------------------------------------------------------------------------------------


def _contacts(suite: Suite) -> str:
    value = {(c.case, c.engine): c.value for c in suite.contacts}
    questions = dict.fromkeys((c.case, c.unit, c.theory) for c in suite.contacts)
    lines = [
        [
            f"{case} [{unit}]",
            "" if theory is None else f"{theory:.3f}",
            *(f"{value[case, v.engine]:.3f}" for v in suite.versions),
        ]
        for case, unit, theory in questions
    ]
    note = "Box2D v3 has no skin around its squares, so that they rest 1.5 cm lower.\n"
    return markdown_table(["case", "theory", *(v.says for v in suite.versions)], lines) + "\n" + note


# --- random controllers -------------------------------------------------------------------------------------------


def _random(suite: Suite) -> str:
    names = _names(suite) | {BOX2D + AGAIN: "Box2D 2.3 again", HERE + AGAIN: "turgor again"}
    text = (
        '60 controllers with weights uniform in [-1, 1], from the task\'s start ("again": the start moved by 1e-6 m): '
        "rank correlation, "
        "Kolmogorov-Smirnov distance and its p, difference of the means and of the medians with its 95 % interval "
        "[m/s].\n\n"
        "![ranks](images/fidelity-ranks.png)\n\n"
    )
    heads = ["task, body, condition", "engine", "against", "ranks", "KS, p", "means", "medians"]
    return text + markdown_table(heads, [_random_line(row, names) for row in suite.random])


def _random_line(row: Ranked, names: dict[str, str]) -> list[str]:
    return [
        f"{row.task}, {row.body}, {row.condition}",
        names[row.engine],
        names[row.against],
        "" if row.rank is None else f"{row.rank:.3f}",
        f"{row.ks:.2f}, {row.ks_p:.2g}",
        f"{row.mean:+.4f} (sd {row.sd:.2f})",
        f"{row.median:+.4f} ({row.low:+.4f} to {row.high:+.4f})",
    ]


# --- champions ----------------------------------------------------------------------------------------------------


def _champions(suite: Suite) -> str:
    names = _names(suite) | {BOX2D + AGAIN: "Box2D 2.3 again"}
    text = (
        f"The champions of the campaign (`turgor reproduce`), evolved in turgor, from {STARTS} moved starts in every "
        f"engine. The floor comes from {STARTS} other starts in Box2D 2.3: the interval that holds 95 % of the "
        f"differences of two medians of {STARTS} starts there.\n\n"
        "![champions](images/fidelity-champions.png)\n\n"
    )
    heads = [
        "task, body, moved",
        "engine",
        "ratio of medians (range)",
        "inside the floor",
        "differ (KS, Holm)",
        "ranks",
    ]
    lines = []
    for task, moved in product(("hilly", "escape"), (NEEDLE, WIDE)):
        for body, engine in product(BODIES, [BOX2D + AGAIN, *_others(suite)]):
            rows = [row for row in _of(suite.champions, engine, task, moved) if row.body == body]
            if rows:
                lines.append([f"{task}, {body}, {moved:g} m", names[engine], *_summary(rows)])
    text += markdown_table(heads, lines) + "\n"
    for task, moved in product(("hilly", "escape"), (NEEDLE, WIDE)):
        rows = [r for r in suite.champions if (r.task, r.moved) == (task, moved) and r.engine != BOX2D + AGAIN]
        text += _details(f"All champions: {task}, starts moved by {moved:g} m", _champion_table(rows, names)) + "\n"
    return text


def _summary(rows: Sequence[Crossed]) -> list[str]:
    ratios = [row.median / row.box2d for row in rows]
    rank = rank_correlation([row.box2d for row in rows], [row.median for row in rows])
    return [
        f"{np.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})",
        f"{sum(row.inside for row in rows)} of {len(rows)}",
        f"{len(_significant(rows))} of {len(rows)}",
        "" if rank is None else f"{rank:.2f}",
    ]


def _champion_table(rows: Sequence[Crossed], names: dict[str, str]) -> str:
    heads = [
        "champion",
        "engine",
        "median (quartiles)",
        "in Box2D 2.3",
        "difference (95 %)",
        "floor",
        "KS, p",
        "solved",
    ]
    lines = [
        [
            f"{row.body}, {row.condition}, seed {row.seed}",
            names[row.engine],
            f"{row.median:.3f} ({row.lower:.3f} to {row.upper:.3f})",
            f"{row.box2d:.3f}",
            f"{row.difference:+.3f} ({row.low:+.3f} to {row.high:+.3f})",
            f"{row.floor_low:+.3f} to {row.floor_high:+.3f}",
            f"{row.ks:.2f}, {row.ks_p:.1g}",
            "" if row.solved is None else f"{row.solved}, in Box2D {row.solved_box2d} of {STARTS}",
        ]
        for row in rows
    ]
    return markdown_table(heads, lines)
