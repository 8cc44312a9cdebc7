"""Eigenvectors of a symmetric matrix: LAPACK's divide and conquer (dsyevd) in its three steps, so that the longest of
them can run on several threads.

    A = Q T Q'  (dsytrd),   T = Z diag(w) Z'  (dstedc),   eigenvectors Q Z  (dormtr)

The columns of Q Z do not depend on each other. They are always cut into the same parts, whatever the threads, so that
BLAS does the same with each.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np

PARTS = 2  # of the columns: more have cost more than they brought; ...
TILE = 16  # ... cut at multiples of it: BLAS takes some columns at once, and what is left over in another way
SMALL = 512  # below, nothing is gained
BLOCK = 64  # columns that LAPACK takes at once, at most: it tells how much room it needs


def eigenvectors(matrix: np.ndarray, threads: int = PARTS) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues [n], ascending, and eigenvectors [n, n], one a column, of a symmetric float64 `matrix` [n, n], of
    which the lower triangle is read. The number of `threads` changes no bit. Raises `LinAlgError` where LAPACK gives
    up."""
    from scipy.linalg import eigh

    n = len(matrix)
    if n < SMALL:
        return eigh(matrix, driver="evd", check_finite=False)
    reflectors = np.array(matrix, dtype=np.float64, order="F")
    values, beside, scales = np.empty(n), np.empty(n - 1), np.empty(n - 1)
    room = np.empty(BLOCK * n)
    _call("dsytrd", b"L", n, reflectors, n, values, beside, scales, room, len(room))
    vectors = np.empty((n, n), order="F")
    room, whole = np.empty(1 + 4 * n + n * n), np.empty(3 + 5 * n, dtype=np.intc)
    _call("dstedc", b"I", n, values, beside, vectors, n, room, len(room), whole, len(whole))

    def turn(columns: np.ndarray) -> None:
        count = columns.shape[1]
        room = np.empty(BLOCK * count + (BLOCK + 1) * BLOCK)
        _call("dormtr", b"L", b"L", b"N", n, count, reflectors, n, scales, columns, n, room, len(room))

    cuts = [k * n // PARTS // TILE * TILE for k in range(1, PARTS)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(turn, np.split(vectors, cuts, axis=1)))
    return values, vectors


def _call(name: str, *given: Any) -> None:
    """Calls LAPACK's routine: characters, whole numbers, and arrays in Fortran's order. Other threads run meanwhile."""
    info = ctypes.c_int()
    kinds = {bytes: ctypes.c_char, int: ctypes.c_int}
    held = [value if isinstance(value, np.ndarray) else kinds[type(value)](value) for value in given]
    places = [value.ctypes.data if isinstance(value, np.ndarray) else ctypes.addressof(value) for value in held]
    _routine(name, len(given) + 1)(*places, ctypes.addressof(info))
    if info.value:
        raise np.linalg.LinAlgError(f"{name} of LAPACK ended with {info.value}")


@cache
def _routine(name: str, arguments: int) -> Callable[..., None]:
    """LAPACK's routine as SciPy hands it out: all arguments are addresses."""
    from scipy.linalg import cython_lapack  # ty: ignore[missing-module-member]

    capsule = cython_lapack.__pyx_capi__[name]
    called = ctypes.pythonapi.PyCapsule_GetName
    called.restype, called.argtypes = ctypes.c_char_p, [ctypes.py_object]
    place = ctypes.pythonapi.PyCapsule_GetPointer
    place.restype, place.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(place(capsule, called(capsule)))
