"""The lane type by itself: every operation against NumPy float32, bit for bit, at every width."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
import pytest
from numba import njit, typeof

from turgor.physics.lanes import any_lane, highest, lane_bits, lowest_bit, select, select_mask
from turgor.physics.memory import (
    BYTES,
    FIELD,
    LINE,
    Floats,
    FloatTable,
    Ints,
    IntTable,
    aligned,
    field_of,
    fields,
    layout,
)
from turgor.physics.views import Width, fill, lane_count, numbers, views

WIDTHS = [1, 2, 4, 8, 16, 32]
F = np.float32
compiled = njit(error_model="numpy", boundscheck=False)


class Memory(NamedTuple):
    a: Annotated[Floats, "row"]
    b: Annotated[Floats, "row"]
    c: Annotated[Floats, "row"]
    i: Annotated[Ints, "row"]
    k: Annotated[Ints, "row"]
    numbers: Annotated[FloatTable, "number"]
    counts: Annotated[IntTable, "number"]
    out: Annotated[Floats, "result"]
    whole: Annotated[Ints, "result"]
    bits: Annotated[IntTable, "result"]


ROWS, NUMBERS, RESULTS = 40, 7, 2000
LENGTHS = {"row": ROWS, "number": NUMBERS, "result": RESULTS}


class Arrays:
    """A buffer of `Memory`, each field seen as an array."""

    def __init__(self, width: int) -> None:
        self.width = Width(width)
        self.offsets = layout(Memory, LENGTHS, width)
        self.buffer = aligned(1, self.offsets[-1])[0]

    def __getattr__(self, name: str) -> np.ndarray:
        return field_of(self.buffer, Memory, self.offsets, name, LENGTHS, self.width)

    def run(self, function: object) -> Arrays:
        function(self.buffer, self.offsets, self.width)
        return self


def ordinary(shape: tuple[int, int], seed: int) -> np.ndarray:
    """Float32 of many magnitudes and both signs."""
    rng = np.random.default_rng(seed)
    return (rng.choice([-1, 1], shape) * 10 ** rng.uniform(-6, 6, shape)).astype(F)


def with_specials(shape: tuple[int, int], seed: int) -> np.ndarray:
    """The same, a third of it zeros, infinities, NaN, denormals and the largest numbers."""
    rng = np.random.default_rng(seed)
    specials = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1e-40, -1e-45, 3.4e38, -3.4e38, 1.0], F)
    return np.where(rng.random(shape) < 0.35, rng.choice(specials, shape), ordinary(shape, seed + 1))


@pytest.fixture(params=WIDTHS)
def memory(request: pytest.FixtureRequest) -> Arrays:
    arrays = Arrays(request.param)
    shape = (ROWS, request.param)
    arrays.a[:], arrays.b[:], arrays.c[:] = (with_specials(shape, seed) for seed in (1, 2, 3))
    rng = np.random.default_rng(4)
    arrays.i[:], arrays.k[:] = rng.integers(-(10**4), 10**4, (2, *shape))
    arrays.numbers[:] = [0.1, -2.5, 3.0, 0.0, 1e10, np.inf, -7.25]
    arrays.counts[:] = [3, -1, 0, 100, 7, -50, 2]
    return arrays


def same_bits(mine: np.ndarray, expected: np.ndarray) -> None:
    """Equal bit for bit; any NaN equals any other, whose payload IEEE 754 leaves open."""
    assert expected.dtype == F
    both = np.isnan(mine) & np.isnan(expected)
    np.testing.assert_array_equal(np.where(both, 0, mine.view(np.int32)), np.where(both, 0, expected.view(np.int32)))


# --- arithmetic ---------------------------------------------------------------------------------------------


@compiled
def arithmetic(buffer, offsets, width):
    m = views(Memory, buffer, offsets, width)
    for r in range(ROWS):
        a = m.a[r]
        b = m.b[r]
        at = 13 * r
        m.out[at] = a + b
        m.out[at + 1] = a - b
        m.out[at + 2] = a * b
        m.out[at + 3] = a / b
        m.out[at + 4] = -a
        m.out[at + 5] = math.sqrt(a)
        m.out[at + 6] = abs(a)
        m.out[at + 7] = min(a, b)
        m.out[at + 8] = max(a, b)
        x = a
        x += b
        x *= a
        x -= b
        x /= a
        m.out[at + 9] = x
        m.out[at + 10] = (a + b) * (a - b) / (a * a)
        m.out[at + 11] = a * b + m.c[r]
        m.out[at + 12] = m.c[r] - a * b
        m.whole[3 * r] = m.i[r] + m.k[r]
        m.whole[3 * r + 1] = m.i[r] - m.k[r]
        m.whole[3 * r + 2] = m.i[r] * m.k[r]


@np.errstate(all="ignore")
def test_arithmetic_is_float32_as_numpy_has_it(memory: Arrays) -> None:
    a, b, c = memory.a.copy(), memory.b.copy(), memory.c.copy()
    memory.run(arithmetic)
    expected = [
        a + b,
        a - b,
        a * b,
        a / b,
        -a,
        np.sqrt(a),
        np.abs(a),
        np.where(a < b, a, b),
        np.where(a > b, a, b),
        (((a + b) * a) - b) / a,
        (a + b) * (a - b) / (a * a),
        a * b + c,
        c - a * b,
    ]
    for k, values in enumerate(expected):
        same_bits(memory.out[k : 13 * ROWS : 13], values)
    i, k = memory.i, memory.k
    np.testing.assert_array_equal(memory.whole[: 3 * ROWS].reshape(ROWS, 3, -1), np.stack([i + k, i - k, i * k], 1))


@pytest.mark.parametrize("width", WIDTHS)
def test_the_second_operand_of_min_and_max_wins_over_nan(width: int) -> None:
    memory, nan = Arrays(width), np.nan
    memory.a[:4], memory.b[:4] = np.array([[nan], [1], [0.0], [-0.0]]), np.array([[1], [nan], [-0.0], [0.0]])
    memory.run(arithmetic)
    for k in (7, 8):
        same_bits(memory.out[k : 4 * 13 : 13], np.broadcast_to(memory.b[:4], (4, width)))


@pytest.mark.parametrize("width", WIDTHS)
def test_a_product_is_rounded_before_it_is_added_to(width: int) -> None:
    """A fused multiply-add would leave 2^-24 of (1 + 2^-12)^2 - (1 + 2^-11), and differ often at random."""
    memory = Arrays(width)
    memory.a[:], memory.b[:] = np.abs(ordinary((2, ROWS, width), 7)) ** F(0.1)
    memory.c[:] = -(memory.a * memory.b) * (1 + np.arange(ROWS)[:, None] % 3 * F(0.3))
    memory.a[0] = memory.b[0] = 1 + 2**-12
    memory.c[0] = -(1 + 2**-11)
    a, b, c = memory.a.copy(), memory.b.copy(), memory.c.copy()
    memory.run(arithmetic)
    assert (memory.out[11] == 0).all()
    same_bits(memory.out[11 : 13 * ROWS : 13], a * b + c)
    same_bits(memory.out[12 : 13 * ROWS : 13], c - a * b)
    # float64 holds the product exactly, and here nearly all of the sum: what a fused operation would return
    fused = (a.astype(np.float64) * b + c).astype(F)
    assert (fused != a * b + c).mean() > 0.25


@compiled
def mixing(buffer, offsets, width):
    m = views(Memory, buffer, offsets, width)
    for r in range(ROWS):
        a = m.a[r]
        at = 14 * r
        m.out[at] = a * 2
        m.out[at + 1] = 2 * a
        m.out[at + 2] = a + 0.1
        m.out[at + 3] = 0.1 - a
        m.out[at + 4] = 1.0 / a
        m.out[at + 5] = a / 3.0
        m.out[at + 6] = max(a, 0.3)
        m.out[at + 7] = min(0.3, a)
        m.out[at + 8] = a * m.numbers[r % NUMBERS]
        m.out[at + 9] = m.numbers[r % NUMBERS] - a
        m.out[at + 10] = a * m.counts[r % NUMBERS]
        m.out[at + 11] = a * r
        m.out[at + 12] = 0.1
        m.out[at + 13] = fill(m.out, 7) - a
        m.whole[2 * r] = m.i[r] + 1
        m.whole[2 * r + 1] = 3 * m.i[r]


@np.errstate(all="ignore")
def test_numbers_beside_lanes_are_rounded_to_float32_first(memory: Arrays) -> None:
    a, r = memory.a.copy(), np.arange(ROWS)
    number = memory.numbers[r % NUMBERS, None].copy()
    count = memory.counts[r % NUMBERS, None].astype(F)
    memory.run(mixing)
    expected = [
        a * F(2),
        F(2) * a,
        a + F(0.1),
        F(0.1) - a,
        F(1) / a,
        a / F(3),
        np.where(a > F(0.3), a, F(0.3)),
        np.where(F(0.3) < a, F(0.3), a),
        a * number,
        number - a,
        a * count,
        a * r[:, None].astype(F),
        np.full_like(a, F(0.1)),
        F(7) - a,
    ]
    for k, values in enumerate(expected):
        same_bits(memory.out[k : 14 * ROWS : 14], values)
    np.testing.assert_array_equal(memory.whole[0 : 2 * ROWS : 2], memory.i + 1)
    np.testing.assert_array_equal(memory.whole[1 : 2 * ROWS : 2], memory.i * 3)


# --- masks --------------------------------------------------------------------------------------------------


@compiled
def masks(buffer, offsets, width):
    m = views(Memory, buffer, offsets, width)
    for r in range(ROWS):
        a = m.a[r]
        b = m.b[r]
        at = 16 * r
        m.bits[at] = lane_bits(a < b)
        m.bits[at + 1] = lane_bits(a <= b)
        m.bits[at + 2] = lane_bits(a > b)
        m.bits[at + 3] = lane_bits(a >= b)
        m.bits[at + 4] = lane_bits(a == b)
        m.bits[at + 5] = lane_bits(a != b)
        m.bits[at + 6] = lane_bits(a < 0.5)
        m.bits[at + 7] = lane_bits(m.numbers[0] >= a)
        m.bits[at + 8] = lane_bits((a < b) & (a > 0.0))
        m.bits[at + 9] = lane_bits((a < b) | (a > 0.0))
        m.bits[at + 10] = lane_bits(~(a < b))
        m.bits[at + 11] = lane_bits(m.i[r] < m.k[r])
        m.bits[at + 12] = lane_bits(m.i[r] == m.k[r])
        m.bits[at + 13] = lane_bits(select_mask(a < b, b > 0.0, m.i[r] > 0))
        m.bits[at + 14] = any_lane(a > 3e5)
        both = a < b
        both &= a > 0.0
        m.bits[at + 15] = lane_bits(both)
        m.out[4 * r] = select(a < b, a, b)
        m.out[4 * r + 1] = select(a < b, 0.1, b)
        m.out[4 * r + 2] = select(a < b, a, -1)
        m.out[4 * r + 3] = select(a < b, 0.1, -0.0)
        m.whole[r] = select(a < b, m.i[r], m.k[r])


def test_comparisons_and_masks(memory: Arrays) -> None:
    a, b, i, k = (memory.__getattr__(name).copy() for name in "abik")
    memory.run(masks)
    less, positive = a < b, a > 0
    expected = [
        less,
        a <= b,
        a > b,
        a >= b,
        a == b,
        a != b,
        a < F(0.5),
        a <= F(0.1),
        less & positive,
        less | positive,
        ~less,
        i < k,
        i == k,
        np.where(less, b > 0, i > 0),
    ]
    weight = 2 ** np.arange(int(memory.width), dtype=np.int64)
    for at, mask in enumerate(expected):
        bits = memory.bits[at : 16 * ROWS : 16].astype(np.uint32)
        np.testing.assert_array_equal(bits, ((mask * weight).sum(axis=1)).astype(np.uint32))
    any_of = memory.bits[14 : 16 * ROWS : 16]
    np.testing.assert_array_equal(any_of, (a > F(3e5)).any(axis=1))
    assert 0 < any_of.sum() < ROWS
    np.testing.assert_array_equal(memory.bits[15 : 16 * ROWS : 16], memory.bits[8 : 16 * ROWS : 16])
    chosen = [
        np.where(less, a, b),
        np.where(less, F(0.1), b),
        np.where(less, a, F(-1)),
        np.where(less, F(0.1), F(-0.0)),
    ]
    for at, values in enumerate(chosen):
        same_bits(memory.out[at : 4 * ROWS : 4], values)
    np.testing.assert_array_equal(memory.whole[:ROWS], np.where(less, i, k))


@compiled
def largest_of_rows(buffer, offsets, width):
    m = views(Memory, buffer, offsets, width)
    for r in range(ROWS):
        m.numbers[0] = highest(m.a[r])
        m.out[r] = fill(m.out, m.numbers[0])


def test_highest_leaves_nan_out(memory: Arrays) -> None:
    numbers = np.random.default_rng(3).normal(size=memory.a.shape).astype(F)
    memory.a[:] = numbers
    memory.a[3] = np.nan
    for r in range(4, ROWS):  # every lane once
        memory.a[r, r % int(memory.width)] = np.nan if r % 2 else 9.0
    expected = np.where(np.isnan(memory.a), -np.inf, memory.a).max(axis=1)
    memory.run(largest_of_rows)
    np.testing.assert_array_equal(memory.out[:ROWS], np.repeat(expected[:, None], int(memory.width), axis=1))


@compiled
def lowest_bits(bits):
    found = np.empty(len(bits), np.int64)
    for n in range(len(bits)):
        found[n] = lowest_bit(bits[n])
    return found


def test_lowest_bit() -> None:
    bit = np.arange(63)
    above = np.random.default_rng(0).integers(0, 2**62, 63) >> bit << bit
    np.testing.assert_array_equal(lowest_bits((1 << bit) | above), bit)


# --- memory -------------------------------------------------------------------------------------------------


@compiled
def moving(buffer, offsets, width):
    m = views(Memory, buffer, offsets, width)
    for r in range(ROWS):
        m.out[r] = m.a[ROWS - 1 - r]
        m.whole[r] = m.i[ROWS - 1 - r]
        for lane in range(lane_count(width)):
            m.out[ROWS + r, lane] = m.a[r, lane_count(width) - 1 - lane]
            m.whole[ROWS + r, lane] = m.i[r, lane] + lane
        m.out[2 * ROWS + r] = m.numbers[r % NUMBERS]
    for r in range(ROWS):
        m.a[r] += 1.0
    for n in range(NUMBERS):
        m.counts[n] = 2 * m.counts[n]
        m.numbers[n] = m.numbers[n] + m.counts[n]


def test_rows_tables_and_single_numbers(memory: Arrays) -> None:
    a, i, numbers, counts = (memory.__getattr__(name).copy() for name in ("a", "i", "numbers", "counts"))
    b, c, k = memory.b.copy(), memory.c.copy(), memory.k.copy()
    memory.run(moving)
    same_bits(memory.out[:ROWS], a[::-1].copy())
    same_bits(memory.out[ROWS : 2 * ROWS], a[:, ::-1].copy())
    same_bits(memory.out[2 * ROWS : 3 * ROWS], np.broadcast_to(numbers[np.arange(ROWS) % NUMBERS, None], a.shape))
    same_bits(memory.a, a + F(1))
    np.testing.assert_array_equal(memory.whole[:ROWS], i[::-1])
    np.testing.assert_array_equal(memory.whole[ROWS : 2 * ROWS], i + np.arange(int(memory.width)))
    np.testing.assert_array_equal(memory.counts, 2 * counts)
    same_bits(memory.numbers, numbers + (2 * counts).astype(F))
    # and nothing else was written
    same_bits(memory.b, b)
    same_bits(memory.c, c)
    np.testing.assert_array_equal(memory.k, k)
    assert not memory.out[3 * ROWS :].any()
    assert not memory.whole[2 * ROWS :].any()
    assert not memory.bits.any()


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(
    "lengths", [LENGTHS, {"row": 1, "number": 33, "result": 5}, {"row": 0, "number": 16, "result": 0}]
)
def test_fields_stand_on_cache_lines_and_do_not_overlap(width: int, lengths: dict[str, int]) -> None:
    offsets = layout(Memory, lengths, width)
    buffers = aligned(3, offsets[-1])
    assert buffers.shape == (3, offsets[-1])
    assert buffers.dtype == F
    assert not buffers.any()
    owner = np.zeros(offsets[-1], int)
    for buffer in buffers:
        assert buffer.ctypes.data % LINE == 0
    for n, (name, (annotation, length)) in enumerate(fields(Memory).items()):
        kind, in_lanes = FIELD[annotation]
        array = field_of(buffers[1], Memory, offsets, name, lengths, width)
        assert array.shape == ((lengths[length], width) if in_lanes else (lengths[length],))
        assert array.dtype == (np.int32 if kind == "int" else F)
        if array.size:
            assert np.shares_memory(array, buffers[1])
            assert array.ctypes.data == buffers[1].ctypes.data + BYTES * offsets[n]
            assert array.ctypes.data % LINE == 0
        owner[offsets[n] : offsets[n] + array.size] += 1
    assert owner.max(initial=0) <= 1
    assert owner.sum() == sum(lengths[length] * (width if FIELD[a][1] else 1) for a, length in fields(Memory).values())
    assert not buffers[[0, 2]].any()


@compiled
def lanes_of(width):
    return lane_count(width)


def test_the_width_is_part_of_the_signature() -> None:
    known = [Width(4), Width(8)]
    assert [int(width) for width in known] == [4, 8]
    assert typeof(Width(4)) == typeof(Width(4)) != typeof(Width(8))
    assert [lanes_of(width) for width in [*known, *known]] == [4, 8] * 2
    assert len(lanes_of.signatures) == 2


class Mixed(NamedTuple):
    count: np.int32
    share: np.float32
    last: np.int32


@compiled
def sum_of_numbers(buffer):
    n = numbers(Mixed, buffer)
    return n.count + n.share * n.last


def test_single_numbers_of_both_kinds() -> None:
    given = Mixed(np.int32(-7), np.float32(0.1), np.int32(2**30))
    buffer = np.frombuffer(b"".join(number.tobytes() for number in given), dtype=F)
    assert sum_of_numbers(buffer) == -7 + np.float64(F(0.1)) * 2**30
