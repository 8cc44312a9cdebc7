"""The fidelity suite: its parts on little, and the published page against its tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("Box2D", reason="needs Box2D 2.3, of the extra box2d")

import turgor
from turgor.cli import main
from turgor.errors import InvalidInput
from turgor.fidelity import populations, suite_page
from turgor.fidelity.compare import HERE
from turgor.fidelity.contacts import FRICTION, REST, SEAM, SLIP, STOP, contact_rows, slide
from turgor.fidelity.engines import installed
from turgor.fidelity.golden import FOLDER, growth_rows, inflation_rows, open_loop_cases, square_rows
from turgor.fidelity.populations import AGAIN, BOX2D, NEEDLE, WIDE, Crossed, floor_of
from turgor.fidelity.suite import TABLES, read_suite, write_suite_tables

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def published():
    return read_suite(DOCS / "fidelity")


# --- the published page -------------------------------------------------------------------------------------------


def test_the_published_page_says_what_its_tables_say(published) -> None:
    assert (DOCS / "fidelity.md").read_text(encoding="utf-8") == suite_page.page_text(published)


def test_the_published_tables_are_whole(published, tmp_path: Path) -> None:
    engines = [v.engine for v in published.versions]
    assert engines == [HERE, "box2d", "box2d-ccd", "box2d-fine", "box2d-v3"]
    cases = len(list(open_loop_cases(FOLDER)))
    assert len({row.case for row in published.growth}) == cases == 42
    assert {row.engine for row in published.growth} == set(engines)
    cells = {(row.task, row.body, row.condition) for row in published.random}
    assert len(cells) == 12
    champions = {(row.task, row.body, row.condition, row.seed) for row in published.champions}
    assert len(champions) == 60
    here = [row for row in published.champions if row.engine == HERE]
    assert len(here) == 2 * 60
    assert {row.moved for row in here} == {NEEDLE, WIDE}
    write_suite_tables(tmp_path / "again", published)
    for name in TABLES:
        again, there = (folder / f"{name}.csv" for folder in (tmp_path / "again", DOCS / "fidelity"))
        assert again.read_bytes() == there.read_bytes()


def test_the_published_errors_are_those_of_this_engine(published) -> None:
    """Up to where chaos takes over, whatever the processor."""
    mine = {(r.case, r.step): r.error for r in growth_rows(HERE, FOLDER)}
    told = {(r.case, r.step): r for r in published.growth if r.engine == HERE}
    assert mine.keys() == told.keys()
    for key, row in told.items():
        if row.floor < 1e-4 and row.error < 1e-4:
            assert mine[key] == pytest.approx(row.error, abs=1e-6), key


# --- its parts ----------------------------------------------------------------------------------------------------


def test_box2d_repeats_the_golden_positions_bit_by_bit() -> None:
    assert {row.error for row in growth_rows(BOX2D, FOLDER)} == {0.0}
    squares = square_rows(BOX2D, FOLDER)
    assert len(squares) > 60
    assert {row.position for row in squares} == {0.0}
    assert max(row.velocity for row in squares) < 1e-8  # [m/s]: of speeds near 0, rounding of other compilers


def test_inflation_is_within_the_golden_demand() -> None:
    for engine in (HERE, BOX2D):
        assert all(row.worst <= 0.03 and row.median <= 0.01 for row in inflation_rows(engine, FOLDER))


@pytest.mark.parametrize("engine", [HERE, *installed()])
def test_contacts_have_their_known_answers(engine: str) -> None:
    value = {row.case: row.value for row in contact_rows(engine)}
    skin = 0.0 if engine == "box2d-v3" else 0.015
    assert value[REST.case] == pytest.approx(0.5 + skin, abs=1e-3)
    assert value[SLIP.case] == pytest.approx(np.degrees(np.arctan(FRICTION)), abs=0.05)
    assert value[STOP.case] == pytest.approx(STOP.theory, rel=0.04)  # another length of step, another sum
    assert value[SEAM.case] == pytest.approx(0, abs=1e-3)


def test_a_square_slides_on_a_steep_slope_alone() -> None:
    assert slide(HERE, 40.0) < 1e-3
    assert slide(HERE, 60.0) > 1


def test_the_floor_holds_95_percent_of_an_engine_s_differences_from_itself() -> None:
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(300):
        fitness = rng.normal(5, 1, 60)
        low, high = floor_of(fitness)
        difference = np.median(rng.normal(5, 1, 30)) - np.median(rng.normal(5, 1, 30))
        inside.append(low <= difference <= high)
    assert 0.9 <= np.mean(inside) <= 0.99


def test_missing_golden_data_is_told() -> None:
    with pytest.raises(InvalidInput, match="golden data"):
        growth_rows(HERE, Path("nowhere"))


# --- all of it, on little -----------------------------------------------------------------------------------------


def test_suite_from_a_small_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    campaign, out = tmp_path / "campaign", tmp_path / "out"
    campaign.mkdir()
    for task in ("hilly", "escape"):
        turgor.evolve(
            turgor.make_task(task), 21, out=campaign / f"{task}-small-pressure-s0", recipe={"name": task, "seed": 0}
        )
    (campaign / "hilly-small-pressure-s1").mkdir()  # not a run
    monkeypatch.setattr(populations, "CONTROLLERS", 3)
    monkeypatch.setattr(populations, "STARTS", 3)
    monkeypatch.setattr(
        populations, "random_cells", lambda: [(task, "small", "pressure") for task in ("hilly", "escape")]
    )
    assert main(["crosscheck", "--suite", "--campaign", str(campaign), "--out", str(out), "--threads", "1"]) == 0
    assert str(out / "fidelity.md") in capsys.readouterr().out
    suite = read_suite(out / "fidelity")
    assert {row.body for row in suite.champions} == {"small"}
    engines = {row.engine for row in suite.champions}
    assert engines == {HERE, BOX2D + AGAIN, *installed()} - {BOX2D}
    page = (out / "fidelity.md").read_text(encoding="utf-8")
    assert page == suite_page.page_text(suite)
    for name in ("growth", "ranks", "champions"):
        assert (out / "images" / f"fidelity-{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"images/fidelity-{name}.png" in page


def test_suite_wants_a_campaign(tmp_path: Path, capsys) -> None:
    assert main(["crosscheck", "--suite", "--campaign", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "turgor reproduce makes one" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_difference_is_inside_the_floor_or_not() -> None:
    row = {name: 0.0 for name in Crossed.__struct_fields__} | {"floor_low": -0.1, "floor_high": 0.2}
    assert Crossed(**row | {"difference": 0.2}).inside
    assert not Crossed(**row | {"difference": -0.11}).inside
