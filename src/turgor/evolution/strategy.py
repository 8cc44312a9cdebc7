"""Strategies: optimizers that are asked for controllers and told how good they were.

The protocol, the way from a name to a built-in strategy, and what the built-in ones share: checks of what comes from
outside, the bits of their generator, and arithmetic that tells when numbers are lost.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from turgor.errors import InvalidInput, describe, one_of
from turgor.evolution import STRATEGIES

WORST = 1e300  # cost of an agent without a fitness: finite, so that sums stay finite
SMALLEST_SIGMA = 1e-150  # its square is still a number
LARGEST_NUMBER = 1e15  # [1], of a controller: what the simulator takes
MOST_AGENTS, MOST_NUMBERS = 1_000_000, 200_000_000  # of a generation, and numbers in all of their controllers
UINT64 = 2**64


class Degenerate(Exception):
    """A strategy that cannot go on, because its numbers have lost their meaning; says why."""


class Strategy(Protocol):
    """An optimizer that maximises. Between `tell` and the next `tell`, `state` is all that it knows."""

    @property
    def name(self) -> str: ...

    @property
    def population(self) -> int:
        """Agents in a generation."""
        ...

    @property
    def sigma(self) -> float:
        """Size of the steps that it takes [1]."""
        ...

    def ask(self) -> np.ndarray:
        """The next generation, theta [agent, parameter]. Raises `Degenerate`."""
        ...

    def tell(self, theta: np.ndarray, fitness: np.ndarray) -> None:
        """Learns from the `fitness` [agent] of what `ask` returned; NaN counts as worst. Raises `Degenerate`."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as arrays (no objects)."""
        ...

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Goes on from `state`, bit by bit as the strategy that it was taken from. Raises `InvalidInput`."""
        ...


def built_in(name: str) -> Callable[..., Strategy]:
    """The class of a built-in strategy by its name, one of `STRATEGIES`. Raises `InvalidInput`."""
    if name not in STRATEGIES:
        raise one_of("strategy", STRATEGIES, name)
    module, kind = STRATEGIES[name]
    return getattr(importlib.import_module(module), kind)


def default_population(parameter_count: int) -> int:
    """Agents in a generation: 4 + floor(3 ln N) (Hansen, "The CMA Evolution Strategy: A Tutorial", 2016)."""
    return 4 + math.floor(3 * math.log(parameter_count))


# --- what comes from outside --------------------------------------------------------------------------------------


def check_start(
    parameter_count: int,
    rng: np.random.Generator,
    population: int | None,
    sigma: float,
    mean: ArrayLike | None,
    *,
    even: bool = False,
) -> tuple[int, float, np.ndarray]:
    """Population, step size and mean [parameter] to start from; the mean is uniform in [-1, 1] where it is None, the
    population `default_population`, and one more where it has to be `even`. Raises `InvalidInput`."""
    if parameter_count < 1:
        raise InvalidInput("evolve: expected a task with something to evolve", "a controller without parameters")
    if population is None:
        population = default_population(parameter_count)
        population += population % 2 if even else 0
    if not isinstance(population, int) or not 4 <= population <= MOST_AGENTS or (even and population % 2):
        kind = "an even whole number" if even else "a whole number"
        raise InvalidInput(f"population: expected {kind}, 4 to {MOST_AGENTS}", describe(population))
    check_generation(population, parameter_count)
    check_positive("sigma", sigma)
    if not isinstance(rng.bit_generator, np.random.PCG64):
        kind = type(rng.bit_generator).__name__
        raise InvalidInput("rng: expected a generator on PCG64 (numpy.random.default_rng)", kind)
    start = rng.uniform(-1, 1, parameter_count) if mean is None else np.array(mean, dtype=np.float64)
    if start.shape != (parameter_count,) or not np.isfinite(start).all():
        raise InvalidInput(f"mean: expected {parameter_count} finite numbers", f"shape {list(start.shape)}")
    return population, float(sigma), start


def check_generation(population: int, parameter_count: int) -> None:
    """Raises `InvalidInput` for a generation that takes too much memory."""
    if population * parameter_count > MOST_NUMBERS:
        expected = f"population: expected at most {MOST_NUMBERS // parameter_count} for {parameter_count} parameters"
        raise InvalidInput(expected, describe(population))


def check_positive(name: str, value: float) -> None:
    """Raises `InvalidInput` unless `value` is a positive, finite number."""
    if not (math.isfinite(value) and value > 0):
        raise InvalidInput(f"{name}: expected a positive number", describe(value))


def check_told(theta: np.ndarray, fitness: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """`theta` as float64 [agent, parameter] and the cost [agent] of each: the negative fitness, all of it finite.

    Raises `InvalidInput` unless they are of the `shape` that was asked.
    """
    theta, fitness = np.asarray(theta, dtype=np.float64), np.asarray(fitness, dtype=np.float64)
    if theta.shape != shape or not np.isfinite(theta).all():
        raise InvalidInput(f"theta: expected finite numbers of shape {list(shape)}", f"shape {list(theta.shape)}")
    if fitness.shape != shape[:1]:
        raise InvalidInput(f"fitness: expected numbers of shape {list(shape[:1])}", f"shape {list(fitness.shape)}")
    cost = np.nan_to_num(-fitness, nan=WORST, posinf=WORST, neginf=-WORST)
    return theta, np.clip(cost, -WORST, WORST)


def check_state(name: str, state: Mapping[str, np.ndarray], shapes: Mapping[str, str]) -> None:
    """Raises `InvalidInput` unless `state` holds a generator and finite numbers of the given `shapes`, in which a
    letter stands for a length, as in {"mean": "n", "C": "nn", "sigma": ""}."""
    shapes = {**shapes, "generator": "6"}
    missing = [key for key in shapes if key not in state]
    if missing:
        raise InvalidInput(f"state of {name}: expected {', '.join(shapes)}", f"no {', '.join(missing)}")
    lengths = {"6": 6}
    for key, letters in shapes.items():
        value = np.asarray(state[key])
        for letter, length in zip(letters, value.shape, strict=False):
            lengths.setdefault(letter, length)
        shape = tuple(lengths.get(letter, 0) for letter in letters)
        kind = np.uint64 if key == "generator" else np.float64 if letters else value.dtype
        if value.shape != shape or value.dtype != kind or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
            raise InvalidInput(f"state of {name}: expected finite numbers of shape {list(shape)} in {key}")
    *_, left, half = state["generator"].tolist()
    if left > 1 or half >= 2**32:
        raise InvalidInput(f"state of {name}: expected the bits of a PCG64 generator in generator")
    population = np.asarray(state["population"]).item()
    if not (state["sigma"] > 0 and 4 <= population <= MOST_AGENTS and int(population) == population):
        raise InvalidInput(f"state of {name}: expected a positive sigma and a population of 4 to {MOST_AGENTS}")
    check_generation(int(population), np.size(state["mean"]))


# --- randomness ---------------------------------------------------------------------------------------------------


def rng_bits(rng: np.random.Generator) -> np.ndarray:
    """The state of a PCG64 generator, uint64 [6]: state, increment (high, low), whether half a draw is left, it."""
    bits: Any = rng.bit_generator.state
    state, inc = bits["state"]["state"], bits["state"]["inc"]
    numbers = [*divmod(state, UINT64), *divmod(inc, UINT64), bits["has_uint32"], bits["uinteger"]]
    return np.array(numbers, dtype=np.uint64)


def set_rng_bits(rng: np.random.Generator, bits: np.ndarray) -> None:
    """Sets a PCG64 generator to what `rng_bits` returned."""
    state_high, state_low, inc_high, inc_low, left, half = (int(b) for b in bits)
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high * UINT64 + state_low, "inc": inc_high * UINT64 + inc_low},
        "has_uint32": left,
        "uinteger": half,
    }


# --- arithmetic ---------------------------------------------------------------------------------------------------


@contextmanager
def numerics() -> Generator[None]:
    """One thread for BLAS (its results depend on their number, and here more of them are slower); what the arithmetic
    stumbles over becomes `Degenerate`."""
    try:
        with _blas().limit(limits=1), np.errstate(over="raise", divide="raise", invalid="raise"):
            yield
    except (ArithmeticError, AssertionError, RuntimeError, np.linalg.LinAlgError) as error:
        reason = f"{type(error).__name__} {describe(error)}".strip()
        raise Degenerate(f"its numbers broke down ({reason})") from error


@cache
def hold_blas() -> None:
    """Has BLAS use one thread in this process from now on: `numerics` of several Python threads would undo each other's
    limit."""
    _blas().limit(limits=1)


@cache
def _blas() -> Any:
    from threadpoolctl import ThreadpoolController

    importlib.import_module("scipy.linalg")  # has a BLAS of its own, which is known once it is loaded
    return ThreadpoolController().select(user_api="blas")


def check_numbers(sigma: float, numbers: np.ndarray, covariance: np.ndarray | None = None) -> None:
    """Raises `Degenerate` unless the step size, a mean or theta, and the covariance are numbers that can be used."""
    sound = SMALLEST_SIGMA < sigma < np.inf and (np.abs(numbers) <= LARGEST_NUMBER).all()
    if not (sound and (covariance is None or np.isfinite(covariance).all())):
        raise Degenerate("its mean, step size or covariance is no longer a finite number, or too large or small")
