"""The report: a whole and accessible page that loads nothing, whose numbers are those of the CSV files."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from turgor.cli import COMMANDS
from turgor.cli.command import Parser
from turgor.experiments.analysis import by_cell, compare, find_effects
from turgor.experiments.claims import check_claims
from turgor.experiments.plan import make_plan
from turgor.experiments.report import Film, Method, write_report
from turgor.experiments.rows import Champion, Inflated, QuasiStatic, Tables, write_tables

VOID = {"meta", "br", "hr", "img", "input", "link", "source", "wbr"}
HOSTILE = '<script>alert("&")</script>'
FIGURES = {"inflation": "rq0", "hilly": "rq1", "terrains": "rq1", "escape": "rq2", "effects": "studies"}
SVG = """<?xml version="1.0" encoding="utf-8" standalone="no"?>
<!DOCTYPE svg PUBLIC "-//W3C//DTD SVG 1.1//EN" "http://www.w3.org/Graphics/SVG/1.1/DTD/svg11.dtd">
<svg xmlns:xlink="http://www.w3.org/1999/xlink" width="72pt" height="36pt" viewBox="0 0 72 36"
 xmlns="http://www.w3.org/2000/svg" version="1.1">
 <metadata><a href="https://matplotlib.org/">Matplotlib</a></metadata>
 <defs><style type="text/css">*{stroke-linejoin: round}</style>
  <path id="mark" d="M 0 0 L 3 3"/><clipPath id="clip"><rect width="9" height="9"/></clipPath></defs>
 <g id="axes" clip-path="url(#clip)" style="filter: url('#clip')"><use xlink:href="#mark" x="1"/></g>
</svg>
"""


# --- a campaign of random numbers ---------------------------------------------------------------------------------


def champions(questions: Sequence[str], bodies: Sequence[str], seeds: int) -> list[Champion]:
    rng = np.random.default_rng(0)
    found = []
    for entry in make_plan(questions, bodies, seeds):
        low, robust, high, best = np.sort(rng.uniform(-0.5, 7, 4)).tolist()
        cage = entry.task == "escape"
        escapes = int(rng.integers(31)) if cage and entry.evaluations else 0
        found.append(
            Champion(
                run=entry.name,
                question=entry.question,
                task=entry.task,
                body=entry.body,
                condition=entry.condition,
                change=entry.change,
                seed=entry.seed,
                evaluations=entry.evaluations,
                generation=7 if entry.evaluations else None,
                best=best,
                robust=robust,
                robust_low=low,
                robust_high=high,
                starts=30,
                solved=bool(rng.integers(2)) if cage else None,
                solved_starts=escapes if cage else None,
                escape_time=float(rng.uniform(5, 30)) if escapes else None,
                tangled_starts=int(rng.integers(31)),
                tangled_steps=int(rng.integers(1800)),
                steps=1800,
            )
        )
    return found


def make_tables(
    questions: Sequence[str] = ("rq0", "rq1", "rq2", "studies"),
    bodies: Sequence[str] = ("small", "medium", "large"),
    seeds: int = 5,
) -> Tables:
    inflated, slow = [], []
    if "rq0" in questions:
        for k, body in enumerate(bodies):
            for gas, rho in (("author", 0.9 + k / 100), ("text", 0.2 - k / 100)):
                for t in (5.0, 25.0, 30.0):
                    ratio = rho + t / 1e4
                    inflated.append(
                        Inflated(body=body, gas=gas, time=t, pressure_ratio=1.0, area_ratio=ratio, height=9.0)
                    )
            for p in (20e3, 26e3, 30e3):
                slow.append(
                    QuasiStatic(
                        body=body,
                        pressure=p,
                        lift_off=25e3,
                        pressure_max=26.7e3,
                        area_ratio=p / 30e3,
                        analytic=None if k else 1.0,
                    )
                )
    found = champions([q for q in questions if q != "rq0"], bodies, seeds)
    comparisons = compare(found)
    return Tables(
        inflation=inflated,
        quasistatic=slow,
        champions=found,
        comparisons=comparisons,
        effects=find_effects(found),
        claims=check_claims(inflated, found, comparisons),
    )


def make_figures(folder: Path, names: Sequence[str], caption: str = "What it shows.") -> list[Any]:
    """Stand-ins for `turgor.experiments.figures.Figure`."""
    folder.mkdir(exist_ok=True)
    for name in names:
        for suffix in (".svg", ".pdf", ".png"):
            (folder / name).with_suffix(suffix).write_text(SVG)
    suffixes = (".svg", ".pdf", ".png")
    return [
        SimpleNamespace(name=n, title=f"Figure of {n}", caption=caption, files=[folder / f"{n}{s}" for s in suffixes])
        for n in names
    ]


def make_film(path: Path, run: str, title: str = "a film") -> Film:
    import av

    path.parent.mkdir(exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 64, 36, "yuv420p"
        for shade in (0, 90, 180):
            frame = av.VideoFrame.from_ndarray(np.full((36, 64, 3), shade, np.uint8), "rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return Film(run=run, title=title, path=path)


def make_method(**changes: Any) -> Method:
    settings = {"questions": ["rq1", "rq2"], "bodies": ["small"], "seeds": 5, "evaluations": 10_000, "starts": 30}
    method = Method(
        settings=settings,
        versions={"turgor": "9.8.7", "numpy": "2.0"},
        machine={"cpu": "a processor", "cores": 2},
        seconds={"run-a": 12.34, "run-b": 61.5},
        wall=90.0,
        made="2030-01-02",
    )
    return msgspec.structs.replace(method, **changes)


# --- reading the page ---------------------------------------------------------------------------------------------


class Element(msgspec.Struct):
    tag: str
    attributes: dict[str, str | None]
    parents: list[Element]
    text: str = ""  # of its descendants too

    def inside(self, tag: str, **attributes: str) -> bool:
        return any(p.tag == tag and attributes.items() <= p.attributes.items() for p in self.parents)


class Page(HTMLParser):
    """The elements of a page; an assertion fails where its tags are not balanced."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.source = text
        self.elements: list[Element] = []
        self.open: list[Element] = []
        self.feed(text)
        self.close()
        assert not self.open, [e.tag for e in self.open]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len(dict(attrs)) == len(attrs), attrs
        element = Element(tag, dict(attrs), list(self.open))
        self.elements.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert any(e.tag == "svg" for e in self.open), f"<{tag}/> outside of SVG"
        self.elements.append(Element(tag, dict(attrs), list(self.open)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, tag
        assert self.open.pop().tag == tag

    def handle_data(self, data: str) -> None:
        for element in self.open:
            element.text += data

    def all(self, *tags: str) -> list[Element]:
        return [e for e in self.elements if e.tag in tags]

    def values(self, name: str) -> list[str]:
        return [value for e in self.elements if (value := e.attributes.get(name)) is not None]

    def sections(self) -> list[str]:
        return [str(e.attributes["id"]) for e in self.all("section")]

    def table(self, name: str) -> list[dict[str, str]]:
        """Raw values of a table's rows by field."""
        rows: dict[int, dict[str, str]] = {}
        for e in self.all("td", "th"):
            if "data-field" in e.attributes and e.inside("table", id=f"table-{name}"):
                rows.setdefault(id(e.parents[-1]), {})[e.attributes["data-field"]] = e.attributes["data-value"]
        return list(rows.values())

    def text(self, tag: str, **attributes: str) -> str:
        found = [e for e in self.all(tag) if attributes.items() <= e.attributes.items()]
        assert found, (tag, attributes)
        return " ".join(" ".join(e.text.split()) for e in found)


@pytest.fixture(scope="module")
def tables() -> Tables:
    return make_tables()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, tables: Tables) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    write_tables(folder / "tables", tables)
    figures = make_figures(folder / "figures", list(FIGURES))
    runs = [tables.champions[0].run, next(c.run for c in tables.champions if c.question == "rq2")]
    films = [make_film(folder / "videos" / f"{run}.mp4", run) for run in runs]
    path = write_report(folder / "report.html", tables, figures, films, make_method())
    assert path == folder / "report.html"
    return folder


@pytest.fixture(scope="module")
def page(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def report(folder: Path, tables: Tables, **changes: Any) -> Page:
    """A report without figures and films."""
    return Page(write_report(folder / "report.html", tables, [], [], make_method(**changes)).read_text("utf-8"))


# --- the page -----------------------------------------------------------------------------------------------------


def test_all_sections_come_in_order(page: Page) -> None:
    assert page.sections() == ["claims", "reading", "rq0", "rq1", "rq2", "studies", "methods", "files"]
    links = [e.attributes["href"] for e in page.all("a") if e.inside("nav")]
    assert links == [f"#{name}" for name in page.sections()]
    for name, question in FIGURES.items():
        (figure,) = [e for e in page.all("figure") if e.attributes.get("id") == f"figure-{name}"]
        assert figure.inside("section", id=question)


def test_ids_are_unique_and_references_resolve(page: Page) -> None:
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    assert set(page.values("aria-labelledby")) <= set(ids)
    local = [href[1:] for href in page.values("href") + page.values("xlink:href") if href.startswith("#")]
    assert local
    assert set(local) <= set(ids)
    urls = re.findall(r"url\(['\"]?#([^)'\"]+)", page.source)
    assert len(urls) == 2 * len(FIGURES)
    assert set(urls) == {f"{name}-clip" for name in FIGURES}
    assert "escape-clip" in ids
    for e in page.all("use"):  # a figure uses its own marks
        assert e.inside("figure", id=f"figure-{str(e.attributes['xlink:href'])[1:].removesuffix('-mark')}")


def test_styles_of_figures_stay_inside(page: Page) -> None:
    styles = [e.text for e in page.all("style") if e.inside("svg")]
    assert len(styles) == len(FIGURES)
    assert all(re.fullmatch(r"\s*#figure-\w+ svg \*\s*\{stroke-linejoin: round\}\s*", style) for style in styles)
    assert not page.all("metadata")


def test_it_loads_nothing_from_elsewhere(page: Page) -> None:
    assert not page.all("script", "link", "iframe", "object", "embed", "img", "base")
    assert all(value.startswith("data:") for name in ("src", "poster") for value in page.values(name))
    assert "@import" not in page.source
    assert not re.findall(r"url\((?!['\"]?#)", page.source)
    outside = [e.attributes["href"] for e in page.all("a") if ":" in str(e.attributes["href"])]
    assert outside == ["https://arxiv.org/abs/2205.00467"]
    assert all(
        str(e.attributes["href"]).startswith("#") for e in page.elements if e.tag != "a" and "href" in e.attributes
    )


def test_links_lead_to_files_beside_it(page: Page, folder: Path) -> None:
    links = {str(e.attributes["href"]) for e in page.all("a")}
    files = {link for link in links if not link.startswith(("#", "https:"))}
    assert all((folder / file).is_file() for file in files)
    there = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file() and p.name != "report.html"]
    assert files == set(there)


def test_it_can_be_read_without_eyes(page: Page) -> None:
    assert page.all("html")[0].attributes["lang"] == "en"
    levels = [int(e.tag[1]) for e in page.all("h1", "h2", "h3", "h4")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b <= a + 1 for a, b in itertools.pairwise(levels))
    for svg in page.all("svg"):
        assert svg.attributes["role"] == "img"
        assert svg.attributes["aria-label"]
    assert len(page.all("figcaption")) == len(page.all("figure")) == len(FIGURES) + 2
    assert len(page.all("caption")) == len(page.all("table"))
    for table in page.all("table"):
        assert any(c.text.strip() and table in c.parents for c in page.all("caption"))
    assert {e.attributes["scope"] for e in page.all("th")} == {"col", "colgroup", "row"}
    for scroll in (e for e in page.elements if e.attributes.get("class") in ("scroll", "card")):
        assert scroll.attributes["tabindex"] == "0"


def test_heads_are_as_wide_as_rows(page: Page) -> None:
    for table in page.all("table"):
        rows: dict[int, list[Element]] = {}
        for e in page.all("td", "th"):
            if table in e.parents:
                rows.setdefault(id(e.parents[-1]), []).append(e)
        heads = [row for row in rows.values() if row[0].inside("thead")]
        widths = {len(row) for row in rows.values() if row[0].inside("tbody")}
        below = sum(len(row) for row in heads[1:])
        groups = [int(e.attributes["colspan"] or 0) for e in heads[0] if "colspan" in e.attributes]
        assert widths == {len(heads[0]) - len(groups) + below}
        assert sum(groups) == below


def test_films_are_inside(page: Page) -> None:
    for video, question in zip(page.all("video"), ("rq1", "rq2"), strict=True):
        assert video.inside("section", id=question)
        assert {"controls", "loop", "muted", "playsinline"} <= video.attributes.keys()
        assert video.attributes["preload"] in ("none", "metadata")
        assert video.attributes["aria-label"] == "Film: a film"
        assert (video.attributes["width"], video.attributes["height"]) == ("64", "36")
        assert str(video.attributes["src"]).startswith("data:video/mp4;base64,")
        assert str(video.attributes["poster"]).startswith("data:image/jpeg;base64,/9j/")  # what every JPEG begins with


def test_a_figure_of_matplotlib(tmp_path: Path, tables: Tables) -> None:
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(3, 2))
    drawing.subplots().plot([1, 2, 3], marker="o")
    figures = make_figures(tmp_path, ["hilly", "escape"])
    for figure in figures:
        drawing.savefig(figure.files[0])
    page = Page(write_report(tmp_path / "report.html", tables, figures, [], make_method()).read_text("utf-8"))
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    local = [href[1:] for href in page.values("href") + page.values("xlink:href") if href.startswith("#")]
    assert set(local) | set(re.findall(r"url\(#([^)]+)", page.source)) <= set(ids)
    assert all("viewbox" in svg.attributes and "width" not in svg.attributes for svg in page.all("svg"))


# --- the numbers --------------------------------------------------------------------------------------------------


def read(folder: Path, table: str) -> list[dict[str, str]]:
    with open(folder / "tables" / f"{table}.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("name", "file", "question", "own"),
    [
        ("rq2-champions", "champions", "rq2", set()),
        ("studies-champions", "champions", "studies", set()),
        ("rq1-comparisons", "comparisons", "rq1", {"magnitude"}),
        ("rq2-comparisons", "comparisons", "rq2", {"magnitude"}),
        ("effects", "effects", None, set()),
    ],
)
def test_tables_equal_the_files(page: Page, folder: Path, name: str, file: str, question: str | None, own: set) -> None:
    found = page.table(name)
    rows = [row for row in read(folder, file) if question is None or row["question"] == question]
    fields = set(found[0])
    assert own <= fields
    assert found
    assert [{k: row[k] for k in fields - own} for row in found] == [{k: row[k] for k in fields - own} for row in rows]


def test_champions_of_each_terrain(page: Page, tables: Tables) -> None:
    best = {(c.body, c.seed, c.condition): c for c in tables.champions if c.question == "rq1"}
    rows = page.table("terrains")
    assert [(row["body"], row["seed"]) for row in rows] == [
        (body, str(seed)) for body in ("small", "medium", "large") for seed in range(5)
    ]
    for row in rows:
        for condition in ("pressure", "springs", "passive"):
            champion = best[row["body"], int(row["seed"]), condition]
            assert row[f"{condition}_best"] == str(champion.best)
            assert row[f"{condition}_robust"] == str(champion.robust)


@pytest.mark.parametrize("question", ["rq1", "rq2"])
def test_spread_over_the_seeds(page: Page, tables: Tables, question: str) -> None:
    cells = by_cell(c for c in tables.champions if c.question == question)
    rows = page.table(f"{question}-cells")
    assert len(rows) == len(cells)
    for row, (cell, found) in zip(rows, cells.items(), strict=True):
        assert (row["body"], row["condition"], row["count"]) == (cell.body, cell.condition, str(len(found)))
        for measure in ("best", "robust"):
            values = [getattr(c, measure) for c in found]
            for name, function in (("min", np.min), ("median", np.median), ("max", np.max)):
                assert float(row[f"{measure}_{name}"]) == pytest.approx(function(values), rel=1e-12)
        assert ("share" in row) == (question == "rq2")
        if question == "rq2":
            assert int(row["solved"]) == sum(c.solved for c in found)
            assert int(row["reliable"]) == sum(c.solved_starts >= 15 for c in found)
            assert float(row["share"]) == pytest.approx(np.mean([c.solved_starts / 30 for c in found]))
            assert float(row["tangled"]) == pytest.approx(np.mean([c.tangled_starts / 30 for c in found]))
            times = [c.escape_time for c in found if c.escape_time]
            assert row["escape_time"] == (str(float(np.median(times))) if times else "")


def test_inflation(page: Page) -> None:
    rows = page.table("inflation")
    assert [row["body"] for row in rows] == ["small", "medium", "large"]
    assert {(row["pressure_max"], row["lift_off"]) for row in rows} == {("26700.0", "25000.0")}
    assert {row["pressure"] for row in rows} == {"26000.0"}  # of the row nearest to p_max
    assert {float(row["area_ratio"]) for row in rows} == {26 / 30}
    assert [row["analytic"] for row in rows] == ["1.0", "", ""]
    # the last 10 s alone: t = 25 and 30
    assert [float(row["author"]) for row in rows] == pytest.approx([0.90275, 0.91275, 0.92275])
    assert [float(row["text"]) for row in rows] == pytest.approx([0.20275, 0.19275, 0.18275])


def test_claims_and_times(page: Page, tables: Tables) -> None:
    cells = [e.text for e in page.all("td", "th") if e.inside("tbody") and e.inside("table", id="table-claims")]
    expected = [[c.question.upper(), c.claim, c.measured, c.verdict] for c in tables.claims]
    assert cells == [text for row in expected for text in row]
    assert page.table("seconds") == [{"run": "run-b", "seconds": "61.5"}, {"run": "run-a", "seconds": "12.34"}]


def test_what_is_shown_is_the_raw_value_rounded(page: Page) -> None:
    numbers = [
        e for e in page.all("td", "th") if e.attributes.get("class") == "number" and "data-value" in e.attributes
    ]
    assert len(numbers) > 500
    for e in numbers:
        raw, shown = e.attributes["data-value"], e.text
        if raw == "":
            assert shown == "–"
        elif shown == "< 0.0001":
            assert float(raw or 0) < 0.0001
        else:
            assert "-" not in shown
            value = float(shown.replace("−", "-").replace(",", ""))
            decimals = len(shown.partition(".")[2])
            assert abs(value - float(raw or 0)) <= 0.5000001 * 10**-decimals
    # the decimals of a column are fixed
    for table in page.all("table"):
        fields: dict[str, set[int]] = {}
        for e in numbers:
            if table in e.parents and e.text[0] not in "–<":
                fields.setdefault(str(e.attributes["data-field"]), set()).add(len(e.text.partition(".")[2]))
        assert all(len(decimals) == 1 for decimals in fields.values())


def test_statistics_are_told_for_these_counts(page: Page, tmp_path: Path) -> None:
    words = page.text("section", id="reading")
    assert "With 5 against 5 champions the smallest possible p is 0.0079." in words
    assert "0.071 for the 9 of RQ1 and 0.024 for the 3 of RQ2" in words
    assert "two-sided Mann-Whitney U test" in words
    assert "bootstrap" in words
    assert "every logged generation as if it were an independent sample" in words
    assert "With 3 against 3 champions the smallest possible p is 0.1." in page.text("section", id="studies")
    three = report(tmp_path, make_tables(["rq2"], ["small"], 3)).text("section", id="reading")
    assert "With 3 against 3 champions the smallest possible p is 0.1." in three
    assert "the smallest possible one is 0.1 for the 1 of RQ2" in three
    assert "0.0079" not in three


def test_findings_follow_the_numbers(page: Page, tables: Tables, tmp_path: Path) -> None:
    escape = [c for c in tables.champions if c.question == "rq2" and c.condition == "pressure"]
    once = sum(bool(c.solved) for c in escape)
    assert f"{once} of 15 champions with pressure control" in page.text("p", **{"class": "summary"})
    medians = {
        c.body: c.median_b for c in tables.comparisons if (c.question, c.measure, c.b) == ("rq1", "robust", "pressure")
    }
    told = f"{medians['small']:.2f} (small), {medians['medium']:.2f} (medium) and {medians['large']:.2f} (large)"
    assert f"{told} with pressure control" in page.text("p", **{"class": "summary"})
    replace = msgspec.structs.replace
    none = [
        replace(c, solved=False, solved_starts=0, tangled_starts=3) if c.task == "escape" else c
        for c in tables.champions
    ]
    changed = report(tmp_path, replace(tables, champions=none))
    assert "left by 0 of 15 champions with pressure control (0 from" in changed.text("p", **{"class": "summary"})
    assert "45 of 450 with pressure control" in changed.text("section", id="rq2")
    slow = [replace(c, robust=-1.0) if c.condition == "pressure" else c for c in tables.champions]
    assert "With pressure control, 0 of 15 champions beat the passive body" in report(
        tmp_path, replace(tables, champions=slow)
    ).text("section", id="rq1")


def test_how_it_was_made(page: Page) -> None:
    words = page.text("section", id="methods")
    for fact in (
        "a processor",
        "9.8.7",
        "10000",
        "1.5 min for this report",
        "2 runs took 1.2 min",
        "docs/replication.md",
    ):
        assert fact in words
    assert "2030-01-02" in page.text("header")
    command = page.text("pre")
    assert command == "turgor reproduce --only rq1 rq2 --body small --seeds 5 --evaluations 10000"
    parser = Parser("turgor reproduce", "", "")
    COMMANDS["reproduce"].options(parser)
    options = parser.parse(command.split()[2:])
    assert (options.only, options.body, options.seeds, options.evaluations) == (["rq1", "rq2"], ["small"], 5, 10_000)


# --- parts of a campaign ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("questions", "sections"),
    [
        (["rq0"], ["claims", "rq0", "methods"]),
        (["rq1"], ["claims", "reading", "rq1", "methods"]),
        (["rq2"], ["claims", "reading", "rq2", "methods"]),
        # with the runs that the changed ones are compared with
        (["studies"], ["claims", "reading", "rq1", "rq2", "studies", "methods"]),
    ],
)
def test_sections_without_rows_are_absent(tmp_path: Path, questions: list[str], sections: list[str]) -> None:
    page = report(tmp_path, make_tables(questions))
    assert page.sections() == sections
    assert not page.all("figure", "video")
    assert [e for e in page.all("a") if e.inside("nav") and e.attributes["href"] == "#rq0"] == [] or "rq0" in questions


def test_columns_without_numbers_are_absent(tmp_path: Path) -> None:
    rows = report(tmp_path, make_tables(["studies"])).table("terrains")
    assert set(rows[0]) == {"body", "seed", "pressure_best", "pressure_robust"}


def test_an_empty_campaign(tmp_path: Path) -> None:
    empty = Method(settings={}, versions={}, machine={}, seconds={}, wall=0.1, made="2030-01-02")
    page = Page(write_report(tmp_path / "report.html", Tables(), [], [], empty).read_text("utf-8"))
    assert page.sections() == ["methods"]
    assert page.text("p", **{"class": "summary"}) == "Nothing was measured."
    assert not page.all("table", "figure", "video", "details", "dl")


def test_one_seed(tmp_path: Path) -> None:
    page = report(tmp_path, make_tables(["rq1", "rq2"], ["medium"], 1))
    assert "With 1 against 1 champions the smallest possible p is 1." in page.text("section", id="reading")
    assert {row["p"] for row in page.table("rq1-comparisons")} == {"1.0"}
    assert len(page.table("terrains")) == 1


def test_text_is_escaped(tmp_path: Path, tables: Tables) -> None:
    replace = msgspec.structs.replace
    claims = [replace(c, claim=HOSTILE, measured=HOSTILE, verdict=HOSTILE) for c in tables.claims]
    champions = [replace(c, body=HOSTILE) if c.body == "large" else c for c in tables.champions]
    hostile = replace(
        tables,
        claims=claims,
        champions=champions,
        inflation=[replace(row, body=HOSTILE) for row in tables.inflation],
        effects=[replace(row, says=HOSTILE, change=HOSTILE) for row in tables.effects],
    )
    figures = make_figures(tmp_path, ["hilly"], caption=HOSTILE)
    figures[0].title = HOSTILE
    films = [make_film(tmp_path / "a & b.mp4", tables.champions[0].run, title=HOSTILE)]
    method = make_method(settings={HOSTILE: HOSTILE}, machine={"cpu": HOSTILE}, versions={"turgor": HOSTILE})
    method = msgspec.structs.replace(method, seconds={HOSTILE: 1.0}, made=HOSTILE)
    page = Page(write_report(tmp_path / "report.html", hostile, figures, films, method).read_text("utf-8"))
    assert not page.all("script")
    assert page.source.count("<script") == 0
    assert HOSTILE in page.text("figcaption")
    assert page.all("video")[0].attributes["aria-label"] == f"Film: {HOSTILE}"
    assert page.all("svg")[0].attributes["aria-label"] == HOSTILE
    assert "a%20%26%20b.mp4" in page.values("href")


def test_files_elsewhere_are_not_linked(tmp_path: Path, tables: Tables) -> None:
    """A link that leaves the campaign's folder breaks when that is moved, as does one to a file that is gone."""
    (tmp_path / "out").mkdir()
    figures = make_figures(tmp_path / "figures", ["hilly"])
    films = [make_film(tmp_path / "film.mp4", tables.champions[0].run)]
    page = Page(
        write_report(tmp_path / "out" / "report.html", tables, figures, films, make_method()).read_text("utf-8")
    )
    assert {href for href in page.values("href") if not href.startswith("#")} == {"https://arxiv.org/abs/2205.00467"}
    assert page.all("video")
    assert page.all("svg")
    figures[0].files[1].unlink()
    page = Page(write_report(tmp_path / "report.html", tables, figures, films, make_method()).read_text("utf-8"))
    assert {"figures/hilly.svg", "figures/hilly.png", "film.mp4"} <= set(page.values("href"))
    assert "figures/hilly.pdf" not in page.values("href")
