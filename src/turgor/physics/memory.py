"""Memory for lanes: one aligned buffer per block, laid out from the annotations of a NamedTuple.

    class State(NamedTuple):
        x: Annotated[Floats, "mass"]    # [m]

How compiled code sees it is in `views.py`; nothing here needs Numba.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, get_args, get_type_hints

import numpy as np

from turgor.errors import InvalidInput

MOST_BYTES = 256_000_000  # of one piece of memory; what would take more is refused
MOST_TRACE_BYTES = 4_000_000_000  # the same of a recording, which grows with the steps
LINE = 64  # [byte], a cache line and the widest vector
BYTES = 4  # of a float32 and an int32


# Annotations of the fields of a NamedTuple of views.


class Floats:
    """Rows of float32, one number a lane."""


class Ints:
    """Rows of int32, one number a lane."""


class FloatTable:
    """float32 numbers that all lanes share."""


class IntTable:
    """int32 numbers that all lanes share."""


FIELD: dict[Any, tuple[str, bool]] = {
    Floats: ("float", True),
    Ints: ("int", True),
    FloatTable: ("float", False),
    IntTable: ("int", False),
}


def check_memory(expected: str, size: int, most: int = MOST_BYTES) -> None:
    """Raises `InvalidInput` where `size` bytes are more than a single piece of memory may have."""
    if size > most:
        raise InvalidInput(f"{expected}, in at most {most / 1e6:.0f} MB", f"{size / 1e6:.0f} MB")


@cache
def fields(views: type) -> dict[str, tuple[type, str]]:
    """{field: (annotation, name of its length)} of a NamedTuple of views."""
    hints = get_type_hints(views, include_extras=True)
    return {name: get_args(hints[name]) for name in views._fields}  # ty: ignore[missing-attribute]


def layout(views: type, lengths: Mapping[str, int], width: int, copies: int = 1) -> np.ndarray:
    """Offsets of the fields in a buffer of float32 [4 byte], and at the end its size; each on a cache line.

    Rows are `width` numbers wide. Of every number of a table there are `copies`, side by side: one for all lanes, or
    one for each value of lanes.
    """
    offsets, at = [], 0
    for annotation, length in fields(views).values():
        offsets.append(at)
        size = lengths[length] * (width if FIELD[annotation][1] else copies)
        at += -(-size // (LINE // BYTES)) * (LINE // BYTES)
    return np.array([*offsets, at], dtype=np.int64)


def aligned(count: int, size: int) -> np.ndarray:
    """Zeros, float32 [count, size], each row on a cache line; `size` as given by `layout`."""
    raw = np.zeros(count * size * BYTES + LINE, dtype=np.uint8)
    start = -raw.ctypes.data % LINE
    return raw[start : start + count * size * BYTES].view(np.float32).reshape(count, size)


def field_of(
    buffer: np.ndarray, views: type, offsets: np.ndarray, name: str, lengths: Mapping[str, int], width: int
) -> np.ndarray:
    """A field of one `buffer` [size] as a writable array: [length, width] for rows, [length] for tables."""
    annotation, length = fields(views)[name]
    kind, in_lanes = FIELD[annotation]
    at = offsets[list(fields(views)).index(name)]
    flat = buffer[at : at + lengths[length] * (width if in_lanes else 1)]
    flat = flat.view(np.int32) if kind == "int" else flat
    return flat.reshape(-1, width) if in_lanes else flat
