"""The statistics of a campaign: are the champions of group b better than those of group a, by how much, how surely?

Groups are small (5 champions against 5, up to 20 against 20) and fitness is far from normally distributed: ranks, exact
p-values and resampling. Several questions asked at once are paid for with Holm's correction.
"""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import ArrayLike

from turgor.errors import InvalidInput, describe

EXACT_PAIRS = 10_000  # up to so many pairs of values p is exact: 0.5 s for 100 against 100, 1 ms for 20 against 20


def mann_whitney(a: ArrayLike, b: ArrayLike) -> tuple[float, float]:
    """U of `b` and its two-sided p: how often a random split of the values has a U at least as far from n m / 2.

    U counts the pairs of a value of `a` and a larger one of `b`, and half of the pairs that tie. p is exact, with ties
    too, up to `EXACT_PAIRS` pairs; from there on it is the normal distribution's, corrected for ties and continuity.

    Mann and Whitney, Ann. Math. Statist. 18 (1947).
    """
    from scipy.stats import mannwhitneyu

    a, b = _group("a", a), _group("b", b)
    if (a == a[0]).all() and (b == a[0]).all():
        p = 1.0  # equal values tell nothing; some versions of SciPy say NaN
    elif a.size * b.size > EXACT_PAIRS:
        p = mannwhitneyu(b, a, method="asymptotic").pvalue
    elif _tied(a, b):
        p = _exact_p(a, b)
    else:
        p = mannwhitneyu(b, a, method="exact").pvalue
    return _u(a, b), float(p)


def smallest_p(n: int, m: int) -> float:
    """The smallest two-sided p of `mann_whitney` for `n` values against `m` different ones: of two splits in all.

    0.0079 for 5 against 5; 0.1 for 3 against 3, which can therefore never tell anything at the 5 % level.
    """
    for name, count in (("n", n), ("m", m)):
        if count < 1:
            raise InvalidInput(f"{name}: expected a whole number, 1 or more", describe(count))
    return 2 / comb(n + m, n)


def effect_size(a: ArrayLike, b: ArrayLike) -> float:
    """How often a value of `b` is larger than one of `a`, ties counted half: 0 to 1, 0.5 where there is no effect.

    A12 = P(b > a) + P(b = a) / 2 = U / (n m). Vargha and Delaney, J. Educ. Behav. Stat. 25 (2000).
    """
    a, b = _group("a", a), _group("b", b)
    return _u(a, b) / (a.size * b.size)


def magnitude(effect: float) -> str:
    """What an `effect_size` is called, whichever group is ahead: "negligible", "small", "medium" or "large".

    Small is from 0.56 on, medium from 0.64, large from 0.71. Vargha and Delaney, J. Educ. Behav. Stat. 25 (2000).
    """
    if not 0 <= effect <= 1:
        raise InvalidInput("effect: expected a number, 0 to 1", describe(effect))
    effect = max(effect, 1 - effect)
    if effect >= 0.71:
        return "large"
    if effect >= 0.64:
        return "medium"
    return "small" if effect >= 0.56 else "negligible"


def median_difference(
    a: ArrayLike, b: ArrayLike, *, level: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> tuple[float, float, float]:
    """median(b) - median(a) and the ends of its percentile bootstrap interval, low and high.

    Each group is resampled by itself; a `seed` gives the same bits every time. Efron and Tibshirani, An Introduction to
    the Bootstrap (1993), chapter 13; chapter 14 tells why percentile intervals tend to be too narrow for small samples.

    Take it as coarse for five values against five: the median of a resample is one of the five, so that the ends jump
    from one difference of two values to another. At a level of 95 % such intervals held the true difference in 95 to
    97 % of simulated cases; with four values in 93 %, with three in 90 %, and there they are too narrow.
    """
    a, b = _finite("a", a), _finite("b", b)
    if not 0 < level < 1:
        raise InvalidInput("level: expected a number between 0 and 1", describe(level))
    if resamples < 1:
        raise InvalidInput("resamples: expected a whole number, 1 or more", describe(resamples))
    rng = np.random.default_rng(seed)
    median_a, median_b = (np.median(rng.choice(group, (resamples, group.size)), axis=1) for group in (a, b))
    low, high = np.quantile(median_b - median_a, [(1 - level) / 2, (1 + level) / 2])
    return float(np.median(b) - np.median(a)), float(low), float(high)


def holm(p: ArrayLike) -> np.ndarray:
    """Each p-value corrected for being one of k, in the given order: at most 1, and ordered as the p-values are.

    With the p-values in ascending order: p'_i = max over j <= i of (k - j + 1) p_j. Rejecting where p' is at most alpha
    keeps the chance of any false rejection at most alpha, however the tests depend on each other. Holm, Scand. J. Stat.
    6 (1979); as adjusted p-values: Wright, Biometrics 48 (1992).
    """
    p = _numbers("p", p)
    if not ((p >= 0) & (p <= 1)).all():
        raise InvalidInput("p: expected numbers, 0 to 1", describe(p.tolist()))
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1, np.maximum.accumulate(np.arange(p.size, 0, -1) * p[order]))
    return adjusted


def _u(a: np.ndarray, b: np.ndarray) -> float:
    return float((b[:, None] > a).sum() + (b[:, None] == a).sum() / 2)


def _tied(a: np.ndarray, b: np.ndarray) -> bool:
    return np.unique(np.concatenate([a, b])).size < a.size + b.size


def _exact_p(a: np.ndarray, b: np.ndarray) -> float:
    """The two-sided p over all splits of the values, ties and all, without going through the splits one by one.

    The shift algorithm: Streitberg and Röhmel, Statistical Software Newsletter 12 (1986). What scipy has instead is
    exact without ties alone; or goes through the splits and doubles the smaller tail, which ties make another number.
    """
    from scipy.stats import rankdata

    few, many = sorted((a, b), key=len)
    ranks = np.rint(2 * rankdata(np.concatenate([few, many]))).astype(np.int64)  # doubled: midranks are halves
    expected = few.size * (ranks.size + 1)  # s - expected = 2 (U - n m / 2)
    # ways[k, s]: of choosing k of the values seen so far so that their doubled ranks sum to s
    ways = np.zeros((few.size + 1, np.sort(ranks)[-few.size :].sum() + 1))
    ways[0, 0] = 1
    for rank in ranks:
        ways[1:, rank:] += ways[:-1, :-rank]
    distance = np.abs(np.arange(ways.shape[1]) - expected)
    as_far = distance >= abs(ranks[: few.size].sum() - expected)
    return min(1.0, ways[-1, as_far].sum() / ways[-1].sum())


def _numbers(name: str, values: ArrayLike) -> np.ndarray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidInput(f"{name}: expected numbers", describe(values)) from None
    if array.ndim != 1:
        raise InvalidInput(f"{name}: expected a list of numbers", f"shape {list(array.shape)}")
    if np.isnan(array).any():
        raise InvalidInput(f"{name}: expected numbers", "NaN")
    return array


def _group(name: str, values: ArrayLike) -> np.ndarray:
    array = _numbers(name, values)
    if not array.size:
        raise InvalidInput(f"{name}: expected one value or more", "none")
    return array


def _finite(name: str, values: ArrayLike) -> np.ndarray:
    array = _group(name, values)
    if np.isinf(array).any():
        raise InvalidInput(f"{name}: expected finite numbers", "infinity")
    return array
