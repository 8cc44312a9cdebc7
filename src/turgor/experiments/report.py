"""The report: one HTML file with claims, figures, tables, films and how they were made, from rows alone.

It loads nothing from elsewhere and needs no JavaScript. Every number in a table carries the text of its CSV cell in
`data-value` and its field in `data-field`. `report.html` holds the prose, which tells no finding: sentences that do are
made from the rows.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from turgor.experiments.analysis import by_cell
from turgor.experiments.claims import AT_REST, SHARE_RELIABLE
from turgor.experiments.page import (
    Cells,
    counted,
    data_uri,
    each_of,
    first_frame,
    folded,
    in_digits,
    in_minutes,
    in_words,
    inline_svg,
    links_to,
    listed,
    make_table,
    prose,
    told_facts,
)
from turgor.experiments.plan import QUESTIONS
from turgor.experiments.rows import KINDS, Champion, Comparison, Tables
from turgor.experiments.statistics import magnitude, smallest_p
from turgor.files import write_whole

if TYPE_CHECKING:
    from turgor.experiments.sheets import Figure

PLACES = {"inflation": "rq0", "hilly": "rq1", "terrains": "rq1", "escape": "rq2", "effects": "studies"}  # of figures


class Film(msgspec.Struct, frozen=True, kw_only=True):
    """A video to embed."""

    run: str  # whose champion it shows
    title: str
    path: Path  # .mp4


class Method(msgspec.Struct, frozen=True, kw_only=True):
    """How the numbers were made, which is not in the tables."""

    settings: dict[str, Any]  # questions, bodies, seeds, evaluations, starts ...
    versions: dict[str, str]
    machine: dict[str, Any]
    seconds: dict[str, float]  # run: wall time [s]
    wall: float  # of the whole command this time [s]
    made: str  # date, ISO


def write_report(path: Path, tables: Tables, figures: Sequence[Figure], films: Sequence[Film], method: Method) -> Path:
    """Path of the report. It links to what lies beside it: tables/NAME.csv, figures and films, where they exist."""
    found = {question: _findings(tables, question) for question in QUESTIONS}
    questions = {champion.run: champion.question for champion in tables.champions}
    for figure in figures:
        found[PLACES.get(figure.name, "studies")] += _figure(figure, path.parent)
    for question in QUESTIONS:
        found[question] += _rows(tables, question)
        shown = [film for film in films if questions.get(film.run, "studies") == question]
        found[question] += _films(shown, tables, path.parent)
    sections = {
        "claims": ("What the paper claims, and what was measured", _claims(tables)),
        "reading": ("How to read the numbers", _reading(tables)),
        **{question: (_title(question), content) for question, content in found.items()},
        "methods": ("How it was made", _methods(method)),
        "files": ("Files", _files(path.parent)),
    }
    sections = {name: section for name, section in sections.items() if section[1]}
    body = "".join(
        f'<section id="{name}">\n<h2>{title}</h2>\n{content}</section>\n' for name, (title, content) in sections.items()
    )
    page = prose(
        "page",
        style=Path(__file__).with_name("report.css").read_text(encoding="utf-8"),
        version=escape(method.versions.get("turgor", "")),
        made=escape(method.made),
        summary=_summary(tables),
        contents="".join(f'<li><a href="#{name}">{title}</a></li>' for name, (title, _) in sections.items()),
        body=body,
    )
    write_whole(path, page.encode())
    return path


def _title(question: str) -> str:
    words = QUESTIONS[question]
    return f"Side studies: {words}" if question == "studies" else f"{question.upper()}: {words}"


# --- findings in words, each made from the rows -------------------------------------------------------------------


def _summary(tables: Tables) -> str:
    words = []
    if evolved := [c for c in tables.champions if c.evaluations]:
        starts = listed(sorted({str(c.starts) for c in evolved}))
        words.append(
            f"{counted(len(evolved), 'evolution')} took {sum(c.evaluations for c in evolved):,} evaluations; every "
            f"champion ran again from {starts} starts moved by a millionth of a metre (robust fitness)."
        )
    if filled := {body: rho for (body, gas), rho in _at_rest(tables).items() if gas == "author"}:
        words.append(f"Under full pressure the area is {each_of(filled)} of the circle's.")
    if locomotion := _by_condition(tables, "rq1"):
        medians = [
            f"{each_of({body: statistics.median(c.robust for c in found) for body, found in bodies.items()})} "
            + _when(condition)
            for condition, bodies in locomotion.items()
        ]
        words.append(f"The median robust fitness on hilly ground in m/s is {'; '.join(medians)}.")
    escapes = [
        f"{sum(bool(c.solved) for c in found)} of {counted(len(found), 'champion')} {_when(condition)} ("
        f"{sum(map(_reliable, found))} from at least half of the moved starts)"
        for condition, bodies in _by_condition(tables, "rq2").items()
        if (found := [c for c in _all(bodies) if c.evaluations])
    ]
    if escapes:
        words.append(f"The cage was left by {listed(escapes)}.")
    if tables.claims:
        kinds = Counter(_kind(claim.verdict) for claim in tables.claims)
        names = {"yes": "holding", "partly": "holding in part", "no": "not holding", "open": "not decided"}
        told = listed(f"{kinds[kind]} {name}" for kind, name in names.items() if kinds[kind])
        words.append(f"{counted(len(tables.claims), 'claim')} of the paper checked: {told}.")
    return " ".join(words) or "Nothing was measured."


def _findings(tables: Tables, question: str) -> str:
    """What the question asks, and findings that its tables do not show at a glance; nothing without rows."""
    if question == "rq0" and (tables.inflation or tables.quasistatic):
        return prose("rq0")
    if question == "studies" and any(c.question == "studies" for c in tables.champions):
        says = told_facts({row.change: row.says for row in tables.effects})
        return prose("studies", least=_least((row.count, row.count_paper) for row in tables.effects)) + says
    found = _by_condition(tables, question)
    if question == "rq1" and found:
        return prose("rq1", findings=" ".join(_ahead_of_passive(found)))
    if question == "rq2" and found:
        tangled = [
            f"{sum(c.tangled_starts for c in champions):,} of {sum(c.starts for c in champions):,} {_when(condition)}"
            for condition, champions in ((condition, _all(bodies)) for condition, bodies in found.items())
        ]
        return prose("rq2", tangled=listed(tangled))
    return ""


def _ahead_of_passive(found: dict[str, dict[str, list[Champion]]]) -> Iterator[str]:
    """Sentences that compare champions with passive bodies, terrain by terrain."""
    passive = {(c.body, c.seed): c.robust for c in _all(found.get("passive", {}))}
    for condition in ("pressure", "springs"):
        pairs = [(c, passive[c.body, c.seed]) for c in _all(found.get(condition, {})) if (c.body, c.seed) in passive]
        if pairs:
            yield (
                f"{_when(condition).capitalize()}, {sum(c.robust > still for c, still in pairs)} of "
                f"{counted(len(pairs), 'champion')} beat the passive body of their terrain (robust fitness)."
            )
    if passive:
        yield f"The best passive body reaches {in_digits(max(passive.values()), '.2f')} m/s."


def _reading(tables: Tables) -> str:
    items, luck = "", []
    for question in ("rq1", "rq2"):
        excess = [c.best - c.robust for c in tables.champions if c.question == question and c.evaluations]
        if excess:
            median, most = in_digits(statistics.median(excess), ".2f"), in_digits(max(excess), ".2f")
            luck.append(f"by {median} m/s for the median champion of {question.upper()} (at most {most})")
    if luck:
        items += prose("luck", luck=listed(luck))
    if tables.comparisons:
        families: dict[tuple[str, str], list[Comparison]] = {}
        for row in tables.comparisons:
            families.setdefault((row.question, row.measure), []).append(row)
        # Holm multiplies the smallest p of k by k
        least = {
            (question, len(rows)): min(1.0, len(rows) * min(smallest_p(row.count_b, row.count_a) for row in rows))
            for (question, _), rows in families.items()
        }
        holm = [f"{p:.2g} for the {count} of {question.upper()}" for (question, count), p in least.items()]
        sizes = [(row.count_b, row.count_a) for row in tables.comparisons]
        items += prose("tests", least=_least(sizes), least_holm=listed(holm))
    return f'<ul class="notes">\n{items}</ul>\n' if items else ""


def _least(sizes: Iterable[tuple[int, int]]) -> str:
    """What the numbers of seeds allow, in a sentence for each."""
    return " ".join(
        f"With {n} against {m} champions the smallest possible p is {smallest_p(n, m):.2g}."
        for n, m in sorted(set(sizes))
    )


def _at_rest(tables: Tables) -> dict[tuple[str, str], float]:
    """Area ratio by body and gas, as in the claim: the mean of the protocol's end."""
    after = max((row.time for row in tables.inflation), default=0) - AT_REST
    ratios: dict[tuple[str, str], list[float]] = {}
    for row in tables.inflation:
        if row.time > after:
            ratios.setdefault((row.body, row.gas), []).append(row.area_ratio)
    return {key: statistics.fmean(values) for key, values in ratios.items()}


def _by_condition(tables: Tables, question: str) -> dict[str, dict[str, list[Champion]]]:
    """Champions of a question by condition and body."""
    found: dict[str, dict[str, list[Champion]]] = {}
    for cell, champions in by_cell(c for c in tables.champions if c.question == question).items():
        found.setdefault(cell.condition, {})[cell.body] = champions
    return found


def _all(bodies: dict[str, list[Champion]]) -> list[Champion]:
    return [champion for champions in bodies.values() for champion in champions]


def _reliable(champion: Champion) -> bool:
    return (champion.solved_starts or 0) >= SHARE_RELIABLE * champion.starts


def _when(condition: str) -> str:
    known = {"pressure": "with pressure control", "springs": "with springs alone", "passive": "for passive bodies"}
    return known.get(condition, escape(condition))


# --- tables -------------------------------------------------------------------------------------------------------


def _claims(tables: Tables) -> str:
    if not tables.claims:
        return ""
    rows = "".join(
        f'<tr><th scope="row" data-head="Question">{escape(row.question.upper())}</th>'
        f'<td data-head="The paper says">{escape(row.claim)}</td><td data-head="Measured">{escape(row.measured)}</td>'
        f'<td data-head="Verdict" class="verdict {_kind(row.verdict)}">{escape(row.verdict)}</td></tr>\n'
        for row in tables.claims
    )
    heads = "".join(f'<th scope="col">{head}</th>' for head in ("Question", "The paper says", "Measured", "Verdict"))
    return f"""<table id="table-claims" class="claims">
<caption><span>Claims of the paper. Each verdict follows from the numbers by a fixed rule.</span></caption>
<thead><tr>{heads}</tr></thead>
<tbody>
{rows}</tbody>
</table>
"""


def _kind(verdict: str) -> str:
    """yes, partly, no or open."""
    if verdict == "holds":
        return "yes"
    if verdict.startswith(("does not hold", "holds for 0 of")):
        return "no"
    return "partly" if verdict.startswith("holds") else "open"


def _rows(tables: Tables, question: str) -> str:
    """The tables of a question."""
    if question == "rq0":
        return _inflation(tables)
    if question == "studies":
        return _effects(tables) + _champions(tables, question)
    each = _terrains(tables) if question == "rq1" else _champions(tables, question)
    return _spread(tables, question) + each + _comparisons(tables, question)


def _inflation(tables: Tables) -> str:
    at_rest, rows = _at_rest(tables), []
    for body in dict.fromkeys(row.body for row in [*tables.quasistatic, *tables.inflation]):
        slow = [row for row in tables.quasistatic if row.body == body]
        full = min(slow, key=lambda row: abs(row.pressure - row.pressure_max), default=None)
        fields = ("pressure_max", "lift_off", "pressure", "area_ratio", "analytic")
        row = {"body": body, "author": at_rest.get((body, "author")), "text": at_rest.get((body, "text"))}
        rows.append(row | {field: getattr(full, field, None) for field in fields})
    return make_table("inflation", rows, heads=1, seconds=f"{AT_REST:.0f}")


def _spread(tables: Tables, question: str) -> str:
    """Every body and condition over its seeds."""
    rows = []
    for cell, found in by_cell(c for c in tables.champions if c.question == question).items():
        row: Cells = {"body": cell.body, "condition": cell.condition, "count": len(found)}
        for measure in ("best", "robust"):
            values = [getattr(c, measure) for c in found]
            row[f"{measure}_median"] = statistics.median(values)
            row[f"{measure}_min"], row[f"{measure}_max"] = min(values), max(values)
        if question == "rq2":
            starts = sum(c.starts for c in found)
            times = [c.escape_time for c in found if c.escape_time is not None]
            row["solved"] = sum(bool(c.solved) for c in found)
            row["reliable"] = sum(map(_reliable, found))
            row["share"] = sum(c.solved_starts or 0 for c in found) / starts
            row["tangled"] = sum(c.tangled_starts for c in found) / starts
            row["escape_time"] = statistics.median(times) if times else None
        rows.append(row)
    return make_table("cells", rows, question)


def _terrains(tables: Tables) -> str:
    """Seed by seed, with the passive body of the same terrain beside the champions."""
    rows: dict[tuple[str, int], Cells] = {}
    for c in sorted(tables.champions, key=lambda c: c.seed):
        if c.question == "rq1":
            row = rows.setdefault((c.body, c.seed), {"body": c.body, "seed": c.seed})
            row |= {f"{c.condition}_best": c.best, f"{c.condition}_robust": c.robust}
    bodies = list(dict.fromkeys(c.body for c in tables.champions))
    return make_table("terrains", sorted(rows.values(), key=lambda row: bodies.index(row["body"])))


def _champions(tables: Tables, question: str) -> str:
    """Seed by seed, with what became of their moved starts."""
    rows = [msgspec.structs.asdict(c) for c in tables.champions if c.question == question]
    first = "change Change\ntask Task" if question == "studies" else "body Body\ncondition Condition"
    return folded("Champions seed by seed", make_table("champions", rows, question, first=first))


def _comparisons(tables: Tables, question: str) -> str:
    found = [row for row in tables.comparisons if row.question == question]
    rows = [msgspec.structs.asdict(row) | {"magnitude": magnitude(row.effect)} for row in found]
    return make_table("comparisons", rows, question)


def _effects(tables: Tables) -> str:
    return make_table("effects", [msgspec.structs.asdict(row) for row in tables.effects])


# --- figures and films --------------------------------------------------------------------------------------------


def _figure(figure: Figure, folder: Path) -> str:
    svg = next(file for file in figure.files if file.suffix == ".svg")
    links = " · ".join(links_to(figure.files, folder))
    return f"""<figure id="figure-{figure.name}">
<div class="card" role="region" tabindex="0" aria-label="{escape(figure.title)}">{inline_svg(svg, figure)}</div>
<figcaption><b>{escape(figure.title)}.</b> {escape(figure.caption)} <span class="links">{links}</span></figcaption>
</figure>
"""


def _films(films: Sequence[Film], tables: Tables, folder: Path) -> str:
    if not films:
        return ""
    champions = {c.run: c for c in tables.champions}
    return f'<div class="films">\n{"".join(_film(f, champions.get(f.run), folder) for f in films)}</div>\n'


def _film(film: Film, champion: Champion | None, folder: Path) -> str:
    poster, width, height = first_frame(film.path)
    words = [escape(film.title)]
    if champion is not None:
        words.append(f"robust {in_digits(champion.robust, '.2f')} m/s")
        if champion.solved_starts is not None:
            words.append(f"escapes from {champion.solved_starts} of {champion.starts} moved starts")
    links = "".join(f' <span class="links">{link}</span>' for link in links_to([film.path], folder))
    return f"""<figure>
<video controls loop muted playsinline preload="none" width="{width}" height="{height}"
 aria-label="Film: {escape(film.title)}" poster="{data_uri("image/jpeg", poster)}"
 src="{data_uri("video/mp4", film.path.read_bytes())}"></video>
<figcaption>{"; ".join(words)}.{links}</figcaption>
</figure>
"""


# --- how it was made ----------------------------------------------------------------------------------------------


def _methods(method: Method) -> str:
    facts = {**method.settings, **method.machine, **method.versions}
    longest = sorted(method.seconds.items(), key=lambda item: -item[1])
    runs = [{"run": run, "seconds": seconds} for run, seconds in longest]
    together = f" Its {counted(len(runs), 'run')} took {in_minutes(sum(method.seconds.values()))} in all, a core each."
    return prose(
        "methods",
        facts=told_facts(facts),
        wall=in_minutes(method.wall),
        together=together if runs else "",
        runs=folded("Wall time of every run", make_table("seconds", runs, heads=1)),
        command=escape(_command(method.settings)),
    )


def _command(settings: dict[str, Any]) -> str:
    """The command line that makes the same numbers."""
    options = {"--only": "questions", "--body": "bodies", "--seeds": "seeds", "--evaluations": "evaluations"}
    words = [f"{option} {in_words(settings[name], ' ')}" for option, name in options.items() if name in settings]
    return " ".join(["turgor reproduce", *words])


def _files(folder: Path) -> str:
    paths = [path for path in (folder / "tables" / f"{name}.csv" for name in KINDS) if path.is_file()]
    items = "".join(f'<li><a href="tables/{path.name}">{path.name}</a></li>\n' for path in paths)
    return prose("files", items=items) if items else ""
