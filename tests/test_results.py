"""The published results say what the analysis says of their champions."""

import re
from pathlib import Path

import pytest

from turgor.experiments.analysis import compare, find_effects
from turgor.experiments.claims import check_claims
from turgor.experiments.inflation import author_protocol
from turgor.experiments.plan import make_plan
from turgor.experiments.rows import Champion, Claim, Comparison, read_rows, read_tables
from turgor.experiments.sheets import FORMATS

PAPER = Path(__file__).parents[1] / "results" / "paper"


@pytest.fixture(scope="module")
def tables():
    return read_tables(PAPER / "tables")


def test_every_entry_of_the_plan_is_there_with_its_starts(tables):
    plan = make_plan(["rq1", "rq2", "studies"])
    assert [c.run for c in tables.champions] == [entry.name for entry in plan]
    assert [(c.seed, c.change) for c in tables.champions] == [(entry.seed, entry.change) for entry in plan]
    assert len(tables.starts) == sum(c.starts for c in tables.champions)


def test_comparisons_effects_and_claims_follow_from_the_champions(tables):
    for found, published in (
        (compare(tables.champions), tables.comparisons),
        (find_effects(tables.champions), tables.effects),
    ):
        assert len(found) == len(published)
        for one, other in zip(found, published, strict=True):
            for name in one.__struct_fields__:
                value = getattr(other, name)
                assert getattr(one, name) == (pytest.approx(value) if isinstance(value, float) else value), name
    assert check_claims(tables.inflation, tables.champions, tables.comparisons) == tables.claims


def test_inflation_is_what_the_engine_does(tables):
    """The same bits on every processor: no optimizer is in it."""
    assert author_protocol(["small"]) == [row for row in tables.inflation if row.body == "small"]


@pytest.mark.parametrize("name", ["inflation", "hilly", "escape", "effects", "terrains"])
def test_figures_are_there(name):
    for suffix in FORMATS:
        assert (PAPER / "figures" / f"{name}.{suffix}").stat().st_size > 1000


def test_twenty_seeds_begin_with_the_five_and_follow_from_their_champions(tables):
    folder = PAPER.parent / "twenty-seeds" / "tables"
    champions = read_rows(folder / "champions.csv", Champion)
    assert [c.run for c in champions] == [entry.name for entry in make_plan(["rq1", "rq2"], seeds=20)]
    five = [c for c in tables.champions if not c.change]
    assert [c for c in champions if c.seed < 5] == five
    found, published = compare(champions), read_rows(folder / "comparisons.csv", Comparison)
    assert [(c.body, c.measure, c.a, c.b, c.u) for c in found] == [
        (c.body, c.measure, c.a, c.b, c.u) for c in published
    ]
    assert [c.p_holm for c in found] == pytest.approx([c.p_holm for c in published])
    claims = read_rows(folder / "claims.csv", Claim)
    assert check_claims(tables.inflation, champions, published) == claims


PAGES = ["README.md", "docs/replication.md", "results/paper/README.md", "results/twenty-seeds/README.md"]


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_links_to_exists(page):
    here = PAPER.parents[1] / page
    links = re.findall(r"\]\(([^)#:]+)\)", here.read_text(encoding="utf-8"))
    assert links
    for link in links:
        assert (here.parent / link).exists(), link
