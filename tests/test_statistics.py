"""Ranks, effect sizes, intervals and corrections: against published examples, counts by hand and every split."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from math import comb, erfc, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turgor.errors import InvalidInput
from turgor.experiments.statistics import (
    EXACT_PAIRS,
    effect_size,
    holm,
    magnitude,
    mann_whitney,
    median_difference,
    smallest_p,
)

many = settings(derandomize=True, deadline=None, max_examples=100, database=None)
tied = st.lists(st.integers(0, 4).map(float), min_size=1, max_size=5)
untied = st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=10, unique=True)


def numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def pairs_won(a: list[float], b: list[float]) -> Fraction:
    """U of b, pair by pair."""
    return sum((Fraction((y > x) - (y < x) + 1, 2) for x, y in itertools.product(a, b)), Fraction())


def split_by_split(a: list[float], b: list[float]) -> float:
    """The two-sided p by going through every split of the values."""
    values, middle = a + b, Fraction(len(a) * len(b), 2)
    observed = abs(pairs_won(a, b) - middle)
    as_far = 0
    for chosen in itertools.combinations(range(len(values)), len(b)):
        rest = [v for i, v in enumerate(values) if i not in chosen]
        as_far += abs(pairs_won(rest, [values[i] for i in chosen]) - middle) >= observed
    return as_far / comb(len(values), len(b))


# --- Mann and Whitney's test: published examples ------------------------------------------------------------

# Absence and presence of oral explanations of illness in 39 societies, by their oral socialisation anxiety.
ABSENT = numbers("13 12 12 10 10 10 10 9 8 8 7 7 7 7 7 6")
PRESENT = numbers("17 16 15 15 15 14 14 14 13 13 13 12 12 12 12 11 11 10 10 10 8 8 6")

PUBLISHED = {
    # Shier, Statistics 2.3: The Mann-Whitney U Test (2004), the example in scipy's documentation: U = 17 and 3, p = 1/9
    "diabetes": ([19, 22, 16, 29, 24], [20, 11, 17, 12], 3, 0.1111111),
    # Hollander and Wolfe, Nonparametric Statistical Methods (1973), p. 69, the example of R's wilcox.test: W = 35,
    # one-sided p = 0.1272; SAS prints 0.2544 for both sides
    "chorioamnion": (
        numbers("1.15 0.88 0.90 0.74 1.21"),
        numbers("0.80 0.83 1.89 1.04 1.45 1.38 1.91 1.64 0.73 1.46"),
        35,
        0.2544,
    ),
    # Siegel, Nonparametric Statistics (1956), chapter 6: trials to criterion of rats, U = 9, one-sided p = 0.452
    "rats": ([78, 64, 75, 45, 82], [110, 70, 53, 51], 9, 2 * 0.4524),
    # With ties. SAS/STAT User's Guide, NPAR1WAY, Exact Wilcoxon Two-Sample Test: rank sum 79.5, so that
    # U = 79.5 - 6 * 7 / 2; exact Pr >= |S - mean| = 0.1054
    "stimulants": (
        numbers("1.94 1.94 2.92 2.92 2.92 2.92 3.27 3.27 3.27 3.27 3.70 3.70 3.74"),
        numbers("3.27 3.27 3.27 3.70 3.70 3.74"),
        58.5,
        0.1054,
    ),
    # With a ceiling, and 2.7 million splits. Bergmann, Ludbrook and Spooren, The American Statistician 54 (2000), who
    # find eleven programs to differ; data and p as in R's coin: exact p = 0.0373 = 2 C(12, 5) / C(24, 5); asymptotic
    # 0.0147
    "rotating rod": ([300] * 12, [22, 300, 75, 271, 300, 18, 300, 300, 163, 300, 300, 300], 42, 0.03727),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_examples(name: str) -> None:
    a, b, u, p = PUBLISHED[name]
    assert mann_whitney(a, b) == (u, pytest.approx(p, abs=5e-5))


def test_large_groups_get_the_normal_approximation(monkeypatch: pytest.MonkeyPatch) -> None:
    # Siegel (1956), chapter 6: U = 64 and 304, z = 3.45 with the variance corrected for t values that tie:
    # n m / (N (N - 1)) ((N³ - N) / 12 - Σ (t³ - t) / 12). The continuity correction of 1/2 is not in his z.
    n, m, N = 16, 23, 39
    ties = sum(t**3 - t for t in Counter(ABSENT + PRESENT).values())
    deviation = sqrt(n * m / (N * (N - 1)) * (N**3 - N - ties) / 12)
    assert (304 - n * m / 2) / deviation == pytest.approx(3.45, abs=0.005)
    z = (304 - n * m / 2 - 0.5) / deviation
    monkeypatch.setattr("turgor.experiments.statistics.EXACT_PAIRS", n * m - 1)
    assert mann_whitney(ABSENT, PRESENT) == (304, pytest.approx(erfc(z / sqrt(2)), rel=1e-9))


@pytest.mark.parametrize("digits", [1, 9])  # with many ties and without
def test_exact_p_of_the_largest_groups_is_close_to_the_normal_one(digits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(7)
    a, b = (rng.normal(mean, size=100).round(digits) for mean in (0, 0.3))
    assert a.size * b.size == EXACT_PAIRS
    exact = mann_whitney(a, b)[1]
    monkeypatch.setattr("turgor.experiments.statistics.EXACT_PAIRS", EXACT_PAIRS - 1)
    normal = mann_whitney(a, b)[1]
    assert exact != normal
    assert exact == pytest.approx(normal, rel=0.05)


# --- Mann and Whitney's test: everything counted -------------------------------------------------------------


def test_five_against_five_for_every_u() -> None:
    # With U = u there are as many of the 252 splits as partitions of u into at most 5 parts of at most 5.
    splits = Counter(sum(parts) for parts in itertools.combinations_with_replacement(range(6), 5))
    assert splits.total() == 252
    rest = 10.0 * np.arange(5)
    for u in range(13):
        below = [min(5, max(0, u - 5 * i)) for i in range(5)]  # of the rest, below each of b: u in all
        b = [10.0 * k - 5 + 0.1 * i for i, k in enumerate(below)]
        p = 2 * sum(splits[v] for v in range(u + 1)) / 252
        assert mann_whitney(rest, b) == (u, pytest.approx(p, abs=1e-15)), u
    assert mann_whitney([1, 2, 3, 4, 5], [6, 7, 8, 9, 10]) == (25, pytest.approx(2 / 252, abs=1e-15))


@many
@given(tied, tied)
def test_ties_agree_with_every_split(a: list[float], b: list[float]) -> None:
    assert mann_whitney(a, b) == (pairs_won(a, b), pytest.approx(split_by_split(a, b), abs=1e-14))


@many
@given(untied, st.data())
def test_different_values_agree_with_every_split(values: list[float], data: st.DataObject) -> None:
    cut = data.draw(st.integers(1, len(values) - 1))
    a, b = values[:cut], values[cut:]
    assert mann_whitney(a, b) == (pairs_won(a, b), pytest.approx(split_by_split(a, b), abs=1e-14))


def test_groups_below_a_ceiling_by_hand() -> None:
    # Of all values 5 lie below the rest, all of them in b. How far U is from n m / 2 goes with how far the number of
    # them in b is from its mean, 5 m / (n + m). 20 against 20: mean 2.5, none is as far as five. 20 against 12: mean
    # 1.875, none is closer than five, and twice the smaller tail would be wrong.
    for m, p in ((20, 2 * comb(20, 5) / comb(40, 5)), (12, comb(12, 5) / comb(32, 5))):
        b = [0.0] * 5 + [1.0] * (m - 5)
        assert mann_whitney([1.0] * 20, b) == (10 * (m - 5), pytest.approx(p, rel=1e-12))
        assert mann_whitney(b, [1.0] * 20)[1] == pytest.approx(p, rel=1e-12)


@pytest.mark.parametrize("count", [1, 5, 20, 101])
def test_equal_values_tell_nothing(count: int) -> None:
    assert mann_whitney([0.3] * count, [0.3] * count) == (count * count / 2, 1)
    assert effect_size([0.3] * count, [0.3] * count) == 0.5


@many
@given(tied, tied)
def test_swapped_groups_mirror_the_result(a: list[float], b: list[float]) -> None:
    (u, p), (swapped_u, swapped_p) = mann_whitney(a, b), mann_whitney(b, a)
    assert swapped_u == len(a) * len(b) - u
    assert swapped_p == pytest.approx(p, abs=1e-14)
    assert effect_size(b, a) == pytest.approx(1 - effect_size(a, b), abs=1e-15)


def test_infinite_values_have_ranks() -> None:
    assert (
        mann_whitney([-np.inf, -np.inf, 1], [2, np.inf]) == mann_whitney([0, 0, 1], [2, 3]) == (6, pytest.approx(0.2))
    )


# --- the smallest p ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 2), (2, 2), (3, 3), (3, 7), (5, 5), (20, 20)])
def test_complete_separation_has_the_smallest_p(n: int, m: int) -> None:
    values = np.arange(n + m)
    assert mann_whitney(values[:n], values[n:]) == (n * m, pytest.approx(smallest_p(n, m), rel=1e-12))


def test_smallest_p_by_hand() -> None:
    assert [smallest_p(n, n) for n in (1, 2, 3, 5)] == [1, 2 / 6, 2 / 20, 2 / 252]
    assert smallest_p(1, 4) == 2 / 5
    assert smallest_p(1000, 1000) == 0  # 1e-600


# --- effect size ---------------------------------------------------------------------------------------------


def test_effect_size_by_hand() -> None:
    # 1 beats none, 2 ties one, 3 beats one and ties one: 0 + 1/2 + 3/2 of 3 x 2.
    assert effect_size([2, 3], [1, 2, 3]) == pytest.approx(2 / 6)
    assert effect_size([1, 2], [3, 4]) == 1
    assert effect_size([3, 4], [1, 2]) == 0


def test_effect_size_of_a_published_example() -> None:
    # Hogarty and Kromrey, Using SAS to Calculate Tests of Cliff's Delta (1999), the example of R's effsize:
    # delta = -0.25. A12 = (delta + 1) / 2, Vargha and Delaney (2000).
    treatment, control = numbers("10 10 20 20 20 30 30 30 40 50"), numbers("10 20 30 40 40 50")
    assert effect_size(control, treatment) == (-0.25 + 1) / 2


def test_magnitudes_are_those_of_vargha_and_delaney_in_both_directions() -> None:
    names = {0.5: "negligible", 0.559: "negligible", 0.56: "small", 0.639: "small", 0.64: "medium", 0.709: "medium"}
    for effect, name in (names | {0.71: "large", 1.0: "large"}).items():
        assert magnitude(effect) == name
    for pairs in (25, 100, 400):  # 5 against 5 to 20 against 20: the thresholds are met exactly
        for twice_u in range(2 * pairs + 1):
            percent = Fraction(100 * max(twice_u, 2 * pairs - twice_u), 2 * pairs)
            name = ["negligible", "small", "medium", "large"][sum(percent >= t for t in (56, 64, 71))]
            assert magnitude(twice_u / 2 / pairs) == name, (twice_u, pairs)


# --- difference of medians -----------------------------------------------------------------------------------


def test_the_interval_of_two_values_by_hand() -> None:
    # Resampled, 0 and 8 have the medians 0, 4, 8 with the chances 1/4, 1/2, 1/4; against a fixed 1 the differences are
    # -1, 3, 7. An interval of 95 % reaches from end to end, one of 40 % (from 0.3 to 0.7) is the middle alone.
    assert median_difference([1], [0, 8]) == (3, -1, 7)
    assert median_difference([1], [0, 8], level=0.4) == (3, 3, 3)
    assert median_difference([0, 8], [1]) == (-3, -7, 1)


def test_the_interval_of_five_values_by_hand() -> None:
    # The median of a resample of 1..5 is 1 with the chance P(Bin(5, 1/5) >= 3) = 0.058, at most 2 with the chance
    # P(Bin(5, 2/5) >= 3) = 0.317: an interval of 95 % reaches from 1 to 5, one of 80 % from 2 to 4, one of 30 % is the
    # median alone.
    five = np.arange(1.0, 6)
    for level, low, high in ((0.95, 1, 5), (0.8, 2, 4), (0.3, 3, 3)):
        assert median_difference([0.0], five, level=level) == (3, low, high)


def test_groups_are_resampled_independently() -> None:
    # Two coins: the medians of {0, 1} twice differ by 1 with the chance 1/16 = 0.0625 and by 0 with 6/16; were both
    # resampled by the same draw they would never differ.
    assert median_difference([0, 1], [0, 1], level=0.95) == (0, -1, 1)
    assert median_difference([0, 1], [0, 1], level=0.8) == (0, -0.5, 0.5)  # P(difference <= -0.5) = 5/16


@many
@given(untied, untied)
def test_the_interval_holds_the_estimate_within_the_range(a: list[float], b: list[float]) -> None:
    difference, low, high = median_difference(a, b, resamples=500)
    assert difference == np.median(b) - np.median(a)
    assert low <= difference <= high
    assert min(b) - max(a) <= low
    assert high <= max(b) - min(a)


def test_a_seed_gives_the_same_bits() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=12), rng.normal(size=9)
    first = median_difference(a, b)
    assert median_difference(list(a), list(b)) == first == median_difference(a, b, seed=0)
    assert median_difference(a, b, seed=1)[1:] != first[1:]


def test_degenerate_groups_have_an_interval_of_no_width() -> None:
    assert median_difference([0.1], [0.3]) == (0.3 - 0.1,) * 3
    assert median_difference([0.1] * 5, [0.3] * 5) == (0.3 - 0.1,) * 3


def coverage(draw: Callable[[int], np.ndarray], count: int) -> float:
    """How often the interval of two groups from the same distribution holds 0."""
    trials = [median_difference(draw(count), draw(count), resamples=500, seed=i)[1:] for i in range(400)]
    return float(np.mean([low <= 0 <= high for low, high in trials]))


def test_coverage_is_what_the_docstring_says() -> None:
    # Two standard errors of 400 trials are 0.02 at 0.96 and 0.03 at 0.9.
    rng = np.random.default_rng(5)
    assert coverage(lambda n: rng.normal(size=n), 5) == pytest.approx(0.965, abs=0.02)
    assert coverage(lambda n: rng.exponential(size=n), 5) == pytest.approx(0.965, abs=0.02)
    assert coverage(lambda n: rng.normal(size=n), 3) == pytest.approx(0.9, abs=0.03)


# --- several questions at once -------------------------------------------------------------------------------


def test_holm_of_published_examples() -> None:
    # The example of pingouin.multicomp, checked there against R's p.adjust.
    found = holm([0.50, 0.003, 0.32, 0.054, 0.0003])
    np.testing.assert_allclose(found, [0.64, 0.012, 0.64, 0.162, 0.0015], rtol=1e-12)
    # The example of stdlib's padjust.
    found = holm([0.319, 0.201, 0.4, 0.374, 0.113])
    np.testing.assert_allclose(found, [0.957, 0.804, 0.957, 0.957, 0.565], rtol=1e-12)
    # "Holm-Bonferroni method", Wikipedia: of four hypotheses the first and the fourth are rejected at 5 %.
    found = holm([0.01, 0.03, 0.04, 0.005])
    np.testing.assert_allclose(found, [0.03, 0.06, 0.06, 0.02], rtol=1e-12)


def rejected_step_by_step(p: list[float], level: float) -> set[int]:
    """Holm's procedure as he states it: the smallest p against level / k, the next against level / (k - 1) ..."""
    rejected: set[int] = set()
    for i in sorted(range(len(p)), key=lambda i: p[i]):
        if p[i] * (len(p) - len(rejected)) > level:
            break
        rejected.add(i)
    return rejected


@many
@given(st.lists(st.floats(0, 1), max_size=8), st.floats(0, 0.999))
def test_holm_rejects_what_the_procedure_rejects(p: list[float], level: float) -> None:
    adjusted = holm(p)
    assert set(np.flatnonzero(adjusted <= level)) == rejected_step_by_step(p, level)
    assert (adjusted >= p).all()
    assert (adjusted <= 1).all()
    assert (np.diff(adjusted[np.argsort(p)]) >= 0).all()


def test_holm_of_none_and_of_one() -> None:
    assert holm([]).shape == (0,)
    assert holm([0.2]).tolist() == [0.2]


def test_holm_leaves_its_argument_alone() -> None:
    p = np.array([0.5, 0.01])
    assert holm(p).tolist() == [0.5, 0.02]
    assert p.tolist() == [0.5, 0.01]


# --- what is refused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("function", [mann_whitney, effect_size, median_difference])
@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ([], "expected one value or more; got none"),
        ([1, np.nan], "expected numbers; got NaN"),
        (["fast"], r"expected numbers; got \['fast'\]"),
        ([[1.0, 2.0]], r"expected a list of numbers; got shape \[1, 2\]"),
    ],
)
def test_bad_groups_are_refused_by_name(function: Callable[..., Any], bad: list[Any], message: str) -> None:
    with pytest.raises(InvalidInput, match="a: " + message):
        function(bad, [1, 2])
    with pytest.raises(InvalidInput, match="b: " + message):
        function([1, 2], bad)


REFUSED: list[tuple[Callable[[], object], str]] = [
    (lambda: median_difference([1], [np.inf]), "b: expected finite numbers; got infinity"),
    (lambda: median_difference([1], [2], level=95), "level: expected a number between 0 and 1; got 95"),
    (lambda: median_difference([1], [2], resamples=0), "resamples: expected a whole number, 1 or more; got 0"),
    (lambda: smallest_p(0, 5), "n: expected a whole number, 1 or more; got 0"),
    (lambda: smallest_p(5, -1), "m: expected a whole number, 1 or more; got -1"),
    (lambda: magnitude(1.1), "effect: expected a number, 0 to 1; got 1.1"),
    (lambda: magnitude(float("nan")), "effect: expected a number, 0 to 1; got nan"),
    (lambda: holm([0.1, 1.5]), r"p: expected numbers, 0 to 1; got \[0.1, 1.5\]"),
    (lambda: holm([0.1, np.nan]), "p: expected numbers; got NaN"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_impossible_numbers_are_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        call()
