"""Eigenvectors in three steps of LAPACK's."""

from __future__ import annotations

import numpy as np
import pytest

from turgor.evolution.eigen import SMALL, _call, eigenvectors
from turgor.evolution.strategy import numerics


def covariance(n: int, seed: int = 0) -> np.ndarray:
    sample = np.random.default_rng(seed).standard_normal((n, n))
    return sample @ sample.T / n + np.eye(n)


@pytest.mark.parametrize("n", [1, 2, 61, SMALL - 1, SMALL, SMALL + 1, 784])
def test_eigenvectors_of_a_covariance(n: int) -> None:
    matrix = covariance(n)
    values, vectors = eigenvectors(matrix)
    assert (np.diff(values) >= 0).all()
    assert np.abs(vectors.T @ vectors - np.eye(n)).max() < 1e-12
    assert np.abs((vectors * values) @ vectors.T - matrix).max() < 1e-12
    assert np.array_equal(matrix, covariance(n))  # left as it was


def test_only_the_lower_triangle_is_read() -> None:
    matrix = covariance(SMALL)
    for kept, same in ((np.tril(matrix), True), (np.triu(matrix), False)):
        found = eigenvectors(kept)[1]
        assert np.array_equal(found, eigenvectors(matrix)[1]) == same


@pytest.mark.parametrize("n", [SMALL, SMALL + 73])
def test_threads_change_no_bit(n: int) -> None:
    matrix = covariance(n, seed=1)
    with numerics():
        one, two, many = (eigenvectors(matrix, threads) for threads in (1, 2, 3))
    for other in (two, many):
        assert all(map(np.array_equal, one, other))


def test_what_lapack_refuses_is_an_error() -> None:
    with pytest.raises(np.linalg.LinAlgError, match=r"dsytrd of LAPACK ended with -2"):
        _call("dsytrd", b"L", -1, np.zeros(4), 4, *[np.zeros(4)] * 4, 4)
