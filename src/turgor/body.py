"""Bodies: square masses, soft springs between them, and chambers that hold gas.

A ring (the paper's agent) is one body among others: springs and chambers are lists of mass indices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.arrays import LARGEST, LARGEST_COORDINATE, SMALLEST, as_numbers
from turgor.errors import InvalidInput, describe

GAS_CONSTANT = 8.314462618  # J/(mol K), exact since 2019
MINIMUM_MASSES = 3
MOST_MASSES = 1000  # pairs of them grow with the square


class Body(msgspec.Struct, frozen=True, eq=False, kw_only=False):
    """A soft body at rest: what it is made of, not where it stands.

    Every per-element field takes one number or one number per element, and is stored per element.
    Raises `InvalidInput` for a body that cannot exist (too few masses, a spring to nowhere, ...).
    """

    position: Any  # [m], shape [mass, 2], relative to the body's own origin
    angle: Any = 0.0  # [rad], shape [mass]; a mass never turns from it
    springs: Any = ()  # [1], shape [spring, 2], indices of the two masses; solved from the last to the first
    chambers: Any = ()  # closed loops of mass indices, counter-clockwise around their gas
    gas_amount: Any = 0.0  # [mol], shape [chamber]
    side: Any = 1.0  # [m], shape [mass]
    density: Any = 2500.0  # [kg/m^2], shape [mass]
    friction: float = 10.0  # [1], mixed with the other surface's by the geometric mean
    rest_length: Any = None  # [m], shape [spring]; None: the distances in `position`
    frequency: Any = 8.0  # [Hz], shape [spring]
    damping_ratio: Any = 0.3  # [1], shape [spring]
    shortest: Any = 0.75  # [1], shape [spring], shortest commanded length / rest length
    longest: Any = 1.25  # [1], shape [spring], longest commanded length / rest length

    def __post_init__(self) -> None:
        put = msgspec.structs.force_setattr
        position = _array("position", self.position, (None, 2))
        count = len(position)
        if count > MOST_MASSES or not (np.abs(position) <= LARGEST_COORDINATE).all():
            expected = f"position: expected at most {MOST_MASSES} masses within {LARGEST_COORDINATE:g} m"
            raise InvalidInput(expected, f"{count} masses" if count > MOST_MASSES else "one that is further away")
        springs = _indices("springs", self.springs, count)
        chambers = _loops(self.chambers, count)
        put(self, "position", position)
        put(self, "springs", springs)
        put(self, "chambers", chambers)
        put(self, "angle", _per("angle", self.angle, count))
        put(self, "side", _positive("side", _per("side", self.side, count)))
        put(self, "density", _positive("density", _per("density", self.density, count)))
        put(self, "gas_amount", _per("gas_amount", self.gas_amount, len(chambers)))
        put(self, "friction", float(_not_negative("friction", _array("friction", self.friction, ()))))
        _not_negative("gas_amount", self.gas_amount)
        distance = np.linalg.norm(position[springs[:, 1]] - position[springs[:, 0]], axis=1)
        rest = distance if self.rest_length is None else _per("rest_length", self.rest_length, len(springs))
        put(self, "rest_length", _frozen(_positive("rest_length", rest)))
        for name in ("frequency", "damping_ratio", "shortest", "longest"):
            values = _per(name, getattr(self, name), len(springs))
            put(self, name, values if name == "damping_ratio" else _positive(name, values))
        _not_negative("damping_ratio", self.damping_ratio)
        if (self.shortest > 1).any() or (self.longest < 1).any():
            raise InvalidInput(
                "shortest, longest: expected shortest <= 1 <= longest",
                f"{describe(self.shortest.max())} and {describe(self.longest.min())}",
            )

    def __repr__(self) -> str:
        chambers = f"{self.chamber_count} chamber" + "s" * (self.chamber_count != 1)
        counts = f"{self.mass_count} masses, {self.spring_count} springs, {chambers}"
        return f"Body({counts}, radius {self.radius:g} m, {self.mass.sum():g} kg)"

    @property
    def mass_count(self) -> int:
        return len(self.position)

    @property
    def spring_count(self) -> int:
        return len(self.springs)

    @property
    def chamber_count(self) -> int:
        return len(self.chambers)

    @property
    def mass(self) -> np.ndarray:
        """Mass of each square [kg], shape [mass]."""
        return self.density * self.side**2

    @property
    def radius(self) -> float:
        """Mean distance of the masses from their centroid [m]; a ring's radius."""
        return float(np.linalg.norm(self.position - self.position.mean(axis=0), axis=1).mean())

    def chamber_radius(self, chamber: int) -> float:
        """Mean distance of a chamber's masses from their centroid [m]; pi times its square is the area
        that p_max and the area ratio refer to."""
        corner = self.position[list(self.chambers[chamber])]
        return float(np.linalg.norm(corner - corner.mean(axis=0), axis=1).mean())

    def area(self, position: np.ndarray) -> np.ndarray:
        """Signed (shoelace) area of each chamber [m^2], shape [..., chamber], for `position` [..., mass, 2]."""
        areas = np.zeros((*position.shape[:-2], self.chamber_count))
        for c, loop in enumerate(self.chambers):
            # edge by edge: NumPy's sum adds in an order that depends on the batch, and so do its last bits
            for i, k in zip(loop, loop[1:] + loop[:1], strict=True):
                here, following = position[..., i, :], position[..., k, :]
                areas[..., c] += 0.5 * (here[..., 0] * following[..., 1] - following[..., 0] * here[..., 1])
        return areas

    def lowest_corner(self) -> float:
        """Lowest y of any square's corner [m] when the body stands at its own origin."""
        reach = 0.5 * self.side * (np.abs(np.cos(self.angle)) + np.abs(np.sin(self.angle)))
        return float((self.position[:, 1] - reach).min())


def ring(
    mass_count: int,
    radius: float,
    *,
    gas_amount: float = 0.0,
    **elements: Any,
) -> Body:
    """A `Body` like the paper's: masses on a circle, joined in a closed ring around one chamber of gas.

    Mass i stands at the angle 2 pi i / n, counter-clockwise, the first at (+radius, 0), turned by that angle;
    spring i joins masses i and i + 1. `gas_amount` in mol, `radius` in m; `elements` are the other fields
    of `Body`. Source: Pigozzi 2022, and its program for the turned squares.
    """
    if not isinstance(mass_count, int | np.integer) or not MINIMUM_MASSES <= mass_count <= MOST_MASSES:
        expected = f"mass_count: expected a whole number, {MINIMUM_MASSES} to {MOST_MASSES}"
        raise InvalidInput(expected, describe(mass_count))
    if not (isinstance(radius, int | float | np.number) and 0 < radius <= LARGEST_COORDINATE):
        raise InvalidInput(
            f"radius: expected a positive number of metres, up to {LARGEST_COORDINATE:g}", describe(radius)
        )
    index = np.arange(mass_count)
    angle = 2 * np.pi * index / mass_count
    return Body(
        position=radius * np.stack([np.cos(angle), np.sin(angle)], axis=1),
        angle=angle,
        springs=np.stack([index, (index + 1) % mass_count], axis=1),
        chambers=[index.tolist()],
        gas_amount=gas_amount,
        # the chord from its formula: the distances of rounded positions differ in the last bits
        rest_length=2 * radius * math.sin(math.pi / mass_count),
        **elements,
    )


def _frozen(array: np.ndarray) -> np.ndarray:
    array = np.array(array)
    array.flags.writeable = False
    return array


def _array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> np.ndarray:
    array = as_numbers(name, value)
    if array.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, array.shape, strict=True)):
        raise InvalidInput(f"{name}: expected shape {_shape(shape)}", f"shape {_shape(array.shape)}")
    if not np.isfinite(array).all():
        raise InvalidInput(f"{name}: expected finite numbers", "NaN or infinity")
    return _frozen(array)


def _shape(shape: Sequence[int | None]) -> str:
    return "[" + ", ".join("any" if n is None else str(n) for n in shape) + "]"


def _per(name: str, value: ArrayLike, count: int) -> np.ndarray:
    array = as_numbers(name, value)
    return _array(name, np.full(count, array) if array.ndim == 0 else array, (count,))


def _positive(name: str, array: np.ndarray) -> np.ndarray:
    wrong = array[~((array >= SMALLEST) & (array <= LARGEST))]
    if wrong.size:
        raise InvalidInput(f"{name}: expected positive numbers, {SMALLEST:g} to {LARGEST:g}", describe(wrong[0]))
    return array


def _not_negative(name: str, array: np.ndarray) -> np.ndarray:
    wrong = array[~((array >= 0) & (array <= LARGEST))]
    if wrong.size:
        raise InvalidInput(f"{name}: expected a finite number, 0 or more, up to {LARGEST:g}", describe(wrong[0]))
    return array


def _indices(name: str, value: ArrayLike, count: int) -> np.ndarray:
    array = as_numbers(name, value)
    array = array.reshape(-1, 2) if array.size % 2 == 0 else array
    expected = f"{name}: expected pairs of different masses, 0 to {count - 1}"
    if array.ndim != 2 or not ((array >= 0) & (array < count)).all() or (array[:, 0] == array[:, 1]).any():
        raise InvalidInput(expected, describe(array.tolist()))
    return _frozen(array.astype(np.int64))


def _loops(value: Sequence[Sequence[int]], count: int) -> tuple[tuple[int, ...], ...]:
    try:
        loops = tuple(tuple(int(i) for i in loop) for loop in value)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInput("chambers: expected loops of masses", describe(value)) from None
    for loop in loops:
        if len(loop) < MINIMUM_MASSES or len(set(loop)) != len(loop) or min(loop) < 0 or max(loop) >= count:
            raise InvalidInput(
                f"chambers: expected loops of 3 or more different masses, 0 to {count - 1}", describe(loop)
            )
    return loops


# The amounts of gas are those that the paper's program computed (grams times molar mass); the printed 0.05 to
# 0.1 kg never lift the body. See docs/replication.md.
SIZES: dict[str, dict[str, Any]] = {
    "small": {"mass_count": 10, "radius": 5.0, "gas_amount": 1400.67},
    "medium": {"mass_count": 15, "radius": 7.5, "gas_amount": 2101.005},
    "large": {"mass_count": 20, "radius": 10.0, "gas_amount": 2801.34},
}
SMALL = ring(**SIZES["small"])
MEDIUM = ring(**SIZES["medium"])
LARGE = ring(**SIZES["large"])
