"""Analysis and claims: from champions to comparisons, effects and verdicts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turgor.errors import InvalidInput
from turgor.experiments import rows
from turgor.experiments.analysis import by_cell, compare, find_effects
from turgor.experiments.claims import check_claims
from turgor.experiments.rows import Champion, Inflated, Start, Tables, read_rows, read_tables, write_rows, write_tables

SPEEDS = {
    "pressure": [5.0, 6.0, 7.0, 8.0, 9.0],
    "springs": [1.0, 2.0, 3.0, 4.0, 5.5],
    "passive": [0.1, 0.2, 0.3, 0.4, 0.5],
}


def champion(condition="pressure", seed=0, robust=1.0, **fields):
    row = {
        "run": f"{condition}-{seed}",
        "question": "rq1",
        "task": "hilly",
        "body": "small",
        "condition": condition,
        "change": "",
        "seed": seed,
        "evaluations": 1000,
        "generation": 3,
        "best": robust + 0.5,
        "robust": robust,
        "robust_low": robust,
        "robust_high": robust,
        "starts": 30,
        "solved": None,
        "solved_starts": None,
        "escape_time": None,
        "tangled_starts": 0,
        "tangled_steps": 0,
        "steps": 1800,
    }
    return Champion(**{**row, **fields})


def hilly(speeds=SPEEDS, **fields):
    return [champion(c, seed, v, **fields) for c, values in speeds.items() for seed, v in enumerate(values)]


def escapes(condition, solved, starts, robust):
    fields = {"question": "rq2", "task": "escape", "solved": solved}
    return [
        champion(condition, seed, v, **fields, solved_starts=n)
        for seed, (n, v) in enumerate(zip(starts, robust, strict=True))
    ]


# --- comparisons --------------------------------------------------------------------------------------------------


def test_comparisons_by_hand():
    found = {(c.measure, c.a, c.b): c for c in compare(hilly())}
    assert len(found) == 6
    one = found["robust", "springs", "pressure"]
    # of 25 pairs, 5 > 1, 2, 3, 4 (4), and 6 to 9 beat all (20)
    assert (one.u, one.effect) == (24.0, 24 / 25)
    assert one.p == pytest.approx(4 / 252)  # U of 24 and 25, on either side
    assert (one.median_a, one.median_b, one.difference) == (3.0, 7.0, 4.0)
    assert one.low <= one.difference <= one.high
    # complete separation: 2/252, and Holm's factors 3 and 2 and 1 of three comparisons
    assert found["robust", "passive", "pressure"].p == pytest.approx(2 / 252)
    assert found["robust", "passive", "pressure"].p_holm == pytest.approx(3 * 2 / 252)
    assert one.p_holm == pytest.approx(max(4 / 252, 2 * 3 * 1 / 252))


def test_holm_corrects_over_all_bodies_of_a_question():
    both = hilly() + hilly(body="medium")
    smallest = min(c.p_holm for c in compare(both) if c.measure == "robust")
    assert smallest == pytest.approx(6 * 2 / 252)


def test_side_studies_stay_out_of_the_comparisons():
    changed = hilly({"pressure": [0.0] * 5}, question="studies", change="window=15")
    assert compare(hilly() + changed) == compare(hilly())


def test_a_condition_that_is_missing_is_not_compared():
    assert [(c.a, c.b) for c in compare(hilly({"pressure": [1.0, 2.0], "passive": [0.0, 0.1]}))] == [
        ("passive", "pressure")
    ] * 2
    assert compare([]) == []


def test_effects_compare_the_same_seeds_of_the_same_body():
    paper = hilly({"pressure": [5.0, 6.0, 7.0, 100.0, 100.0]}, body="medium") + hilly()
    changed = hilly({"pressure": [6.0, 7.0, 8.0]}, body="medium", question="studies", change="window=15")
    (effect,) = find_effects(paper + changed)
    assert (effect.median_paper, effect.median, effect.difference, effect.count_paper) == (6.0, 7.0, 1.0, 3)
    assert effect.effect == (1 + 2 + 3 + 2 * 0.5) / 9  # 6: 5, half of 6; 7: 5, 6, half of 7; 8: all
    assert effect.solved_starts is None


def test_effects_tell_the_share_of_starts_that_escape():
    fields = {"body": "medium", "task": "escape", "solved": True}
    paper = [champion(seed=s, solved_starts=n, question="rq2", **fields) for s, n in enumerate((0, 3, 6))]
    changed = [
        champion(seed=s, solved_starts=n, question="studies", change="fitness=elapsed", **fields)
        for s, n in enumerate((30, 15, 0))
    ]
    (effect,) = find_effects(paper + changed)
    assert (effect.solved_starts_paper, effect.solved_starts) == (9 / 90, 45 / 90)


def test_cells_keep_seeds_in_order():
    (found,) = by_cell([champion(seed=2), champion(seed=0), champion(seed=1)]).values()
    assert [c.seed for c in found] == [0, 1, 2]


# --- claims -------------------------------------------------------------------------------------------------------


def verdicts(champions, inflated=()):
    return {c.claim.split()[0]: c.verdict for c in check_claims(inflated, champions, compare(champions))}


def test_locomotion_holds_where_agents_move_on_most_terrains():
    assert verdicts(hilly())["The"] == "holds"
    slow = hilly({**SPEEDS, "pressure": [1.0, 1.1, 1.2, 5.0, 6.0]}, body="large")
    assert verdicts(hilly() + slow)["The"] == "holds only for small"
    assert verdicts(slow)["The"] == "does not hold"
    rolls = hilly({**SPEEDS, "passive": [0.1, 0.2, 0.3, 0.4, 9.5]})
    assert verdicts(rolls)["The"] == "does not hold"


@pytest.mark.parametrize(
    ("starts", "words"),
    [
        ((30, 20, 15, 0, 0), "holds"),
        ((30, 20, 14, 0, 0), "holds for the best evaluation, not from moved starts"),
    ],
)
def test_escape_asks_for_moved_starts(starts, words):
    assert verdicts(escapes("pressure", True, starts, [1.0] * 5))["The"] == words
    assert verdicts(escapes("pressure", False, [0] * 5, [1.0] * 5))["The"] == "does not hold"


def test_pressure_is_fundamental_where_it_is_significantly_better():
    with_it = escapes("pressure", True, [20] * 5, [5.0, 6.0, 7.0, 8.0, 9.0])
    without = escapes("springs", False, [0] * 5, [1.0, 2.0, 3.0, 4.0, 4.5])
    assert verdicts(with_it + without)["Controlling"] == "holds"
    alike = escapes("springs", False, [0] * 5, [5.1, 6.1, 6.9, 8.1, 8.9])
    assert verdicts(with_it + alike)["Controlling"] == "does not hold"


def test_two_seeds_decide_nothing():
    few = escapes("pressure", True, [30] * 2, [5.0, 6.0]) + escapes("springs", False, [0] * 2, [1.0, 2.0])
    assert verdicts(few)["Controlling"].startswith("not decided")


def test_five_seeds_cannot_give_a_p_below_a_thousandth_and_twenty_can():
    assert verdicts(hilly())["Differences"] == "cannot hold for this number of seeds"
    many = hilly({"pressure": np.arange(20) + 50.0, "springs": np.arange(20) * 1.0, "passive": np.arange(20) - 50.0})
    assert verdicts(many)["Differences"] == "holds for 6 of 6 comparisons"


def test_structure_holds_for_bodies_that_stand_at_the_end():
    def course(gas, last):
        return [
            Inflated(body="small", gas=gas, time=t, pressure_ratio=1.0, area_ratio=rho, height=1.0)
            for t, rho in ((5.0, 0.1), (25.0, last), (30.0, last + 0.02))
        ]

    assert verdicts([], course("author", 0.9) + course("text", 0.1))["Pressure"].startswith("holds with the program's")
    assert verdicts([], course("author", 0.5) + course("text", 0.1))["Pressure"] == "does not hold"


def test_nothing_measured_claims_nothing():
    assert check_claims([], [], []) == []


# --- tables -------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(
    fitness=st.floats(allow_nan=False, allow_infinity=False),
    solved=st.sampled_from([True, False, None]),
    run=st.text("abc-,\"' é", min_size=0),
)
def test_rows_come_back_as_they_were(tmp_path_factory, fitness, solved, run):
    path = tmp_path_factory.mktemp("rows") / "starts.csv"
    written = [Start(run=run, start=3, fitness=fitness, solved=solved, time=30.0, tangled=False)]
    write_rows(path, Start, written)
    assert read_rows(path, Start) == written


def test_tables_come_back_as_they_were(tmp_path):
    champions = hilly()
    tables = Tables(champions=champions, comparisons=compare(champions))
    paths = write_tables(tmp_path / "tables", tables)
    assert [path.stem for path in paths] == list(rows.KINDS)
    assert read_tables(tmp_path / "tables") == tables


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("run,start\na,1\n", "expected rows of run, start, fitness, solved, time, tangled"),
        ("run,start,fitness,solved,time,tangled\na,1,fast,,30.0,False\n", "could not convert string to float: 'fast'"),
        ("run,start,fitness,solved,time,tangled\na,1,1.0,maybe,30.0,False\n", "'maybe' for a bool"),
        ("run,start,fitness,solved,time,tangled\na,,1.0,,30.0,False\n", "an empty cell"),
    ],
)
def test_broken_tables_are_refused(tmp_path, text, words):
    (tmp_path / "starts.csv").write_text(text)
    with pytest.raises(InvalidInput, match=words) as error:
        read_rows(tmp_path / "starts.csv", Start)
    assert "starts.csv" in str(error.value)


def test_a_missing_table_is_told(tmp_path):
    with pytest.raises(InvalidInput, match="expected a table"):
        read_tables(tmp_path)
