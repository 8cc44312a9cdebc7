"""Numbers from outside: what is taken for an array of them, and how large they may be."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from turgor.errors import InvalidInput, describe

LARGEST_COORDINATE = 1e6  # [m]: beyond it float32 cannot tell 6 cm apart
SMALLEST, LARGEST = 1e-9, 1e9  # what a positive number of a body or a scene may be, in its unit


def as_numbers(name: str, value: ArrayLike, dtype: Any = np.float64) -> np.ndarray:
    """`value` as an array of `dtype` (None: its own), whatever its shape; what is too large for it is infinite. Raises
    `InvalidInput` for text, objects and rows of unequal length."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biufO":  # text that looks like a number is none
            raise TypeError
        with np.errstate(over="ignore"):
            return array if dtype is None else array.astype(dtype, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInput(f"{name}: expected numbers", describe(value)) from None
