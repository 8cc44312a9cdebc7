"""CMA-ES with a full covariance, by pycma."""

from __future__ import annotations

import importlib
import math
import sys
import warnings
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from turgor.errors import InvalidInput
from turgor.evolution.eigen import eigenvectors
from turgor.evolution.strategy import (
    Degenerate,
    check_numbers,
    check_start,
    check_state,
    check_told,
    numerics,
    rng_bits,
    set_rng_bits,
)

MOST_PARAMETERS = 5000  # the covariance is the square of them, 200 MB
LARGEST_CONDITION = 1e14  # of the covariance: beyond it float64 cannot tell its axes; pycma's own limit


class CMAES:
    """CMA-ES (pycma): full covariance, active weights, cumulative step-size adaptation.

        strategy = CMAES(374, np.random.default_rng(0))
        for _ in range(100):
            theta = strategy.ask()  # [agent, parameter]
            strategy.tell(theta, fitness=-np.square(theta - 1).sum(axis=1))  # the higher the better

    Its initial mean is uniform in [-1, 1]. All randomness is the generator's; the bits are the same for the same
    generator on the same machine, whatever the number of threads. It never ends by itself, apart from `Degenerate`.
    Step sizes adapt by the length of the evolution path (CSA) for every number of parameters; pycma would take two
    mirrored agents of each generation from 300 parameters on (TPA). The two steps that take most of the time of many
    parameters, the covariance's update and its decomposition, are ours: the same formulas on whole matrices.
    """

    name = "cma-es"
    # What pycma's object carries from one generation to the next, with these options.
    _OF_EVOLUTION = ("mean", "sigma", "pc", "countiter", "countevals")
    _OF_SAMPLER = ("C", "B", "D", "last_update", "count_tell", "count_eigen")
    _OF_STEP_SIZE = ("ps", "_ps_updated_iteration", "delta")

    def __init__(
        self,
        parameter_count: int,
        rng: np.random.Generator,
        *,
        population: int | None = None,
        sigma: float = 0.5,
        mean: ArrayLike | None = None,
    ) -> None:
        """`population`: None for 4 + floor(3 ln parameter_count); `mean` [parameter]: None for uniform in [-1, 1].

        Raises `InvalidInput`.
        """
        if parameter_count > MOST_PARAMETERS:
            expected = f"{self.name}: expected at most {MOST_PARAMETERS} parameters; sep-cma-es and lm-ma-es take more"
            raise InvalidInput(expected, str(parameter_count))
        population, sigma, mean = check_start(parameter_count, rng, population, sigma, mean)
        self._rng = rng
        self._start(mean, sigma, population)

    @property
    def population(self) -> int:
        return self._evolution.popsize

    @property
    def sigma(self) -> float:
        return float(self._evolution.sigma)

    def ask(self) -> np.ndarray:
        """The next generation, float64 [agent, parameter]."""
        self._before_ask = rng_bits(self._rng)
        with numerics():
            theta = np.array(self._evolution.ask())
        self._check(theta)
        return theta

    def tell(self, theta: np.ndarray, fitness: np.ndarray) -> None:
        """Learns from the `fitness` [agent], the higher the better, of `theta` from `ask`. Only its order counts; NaN
        and -inf are worse than every number."""
        theta, cost = check_told(theta, fitness, (self.population, self._evolution.N))
        with numerics():
            self._evolution.tell(list(theta), cost.tolist())
        self._before_ask = rng_bits(self._rng)
        self._check(self._evolution.mean, self._evolution.sm.C)  # which `ask` does not change

    def state(self) -> dict[str, np.ndarray]:
        """Arrays from which `restore` goes on; taken between `ask` and `tell`, it goes on with the same `ask`."""
        evolution = self._evolution
        parts = (
            (evolution, self._OF_EVOLUTION),
            (evolution.sm, self._OF_SAMPLER),
            (evolution.adapt_sigma, self._OF_STEP_SIZE),
        )
        # order "K": the order of B in memory decides which of BLAS's routines multiplies it
        arrays = {name: np.array(getattr(part, name), order="K") for part, names in parts for name in names}
        return {**arrays, "population": np.array(self.population), "generator": self._before_ask.copy()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Goes on from `state`; number of parameters and population are the state's. Raises `InvalidInput`."""
        names = (*self._OF_EVOLUTION, *self._OF_SAMPLER, *self._OF_STEP_SIZE, "population")
        shapes = {"mean": "n", "pc": "n", "ps": "n", "D": "n", "B": "nn", "C": "nn"}
        check_state(self.name, state, {name: shapes.get(name, "") for name in names})
        if not ((np.diagonal(state["C"]) > 0).all() and (state["D"] > 0).all()):
            raise InvalidInput(f"state of {self.name}: expected positive variances in C, and positive numbers in D")
        self._start(np.array(state["mean"]), float(state["sigma"]), int(state["population"]))
        evolution = self._evolution
        _put(evolution, state, self._OF_EVOLUTION)
        _put(evolution.sm, state, self._OF_SAMPLER)
        _put(evolution.adapt_sigma, state, self._OF_STEP_SIZE)
        evolution._updateBDfromSM()
        self._before_ask = np.array(state["generator"], dtype=np.uint64)
        set_rng_bits(self._rng, self._before_ask)

    def _start(self, mean: np.ndarray, sigma: float, population: int) -> None:
        cma = _load_pycma()
        options = {
            "randn": lambda *shape: self._rng.standard_normal(shape),
            "seed": math.nan,  # any other seeds NumPy's global generator
            "popsize": population,
            "AdaptSigma": cma.sigma_adaptation.CMAAdaptSigmaCSA,
            # else pycma changes its coordinates on the way, and with them what its state means
            "conditioncov_alleviate": False,
            "CMA_mirrors": 0,  # else small populations carry directions from one generation to the next
            "verbose": -10,
            "verb_log": 0,
            "verb_disp": 0,
        }
        self._evolution: Any = cma.CMAEvolutionStrategy(mean, sigma, options)
        self._evolution.mean_old = self._evolution.mean  # `tell` sets it, but asks for it from the second time on
        self._evolution.sm.eigenmethod = eigenvectors
        self._evolution.sm.update = partial(_learn, self._evolution.sm)
        self._evolution.timer = cma.utilities.utils.ElapsedWCTime()  # `ask` makes it in the first generation alone
        self._before_ask = rng_bits(self._rng)

    def _check(self, numbers: np.ndarray, covariance: np.ndarray | None = None) -> None:
        evolution = self._evolution
        check_numbers(evolution.sigma, numbers, covariance)
        smallest, largest = float(evolution.sm.D[0]), float(evolution.sm.D[-1])
        ratio = largest / smallest if smallest > 0 else math.inf
        condition = ratio * ratio  # infinite where `ratio ** 2` would raise
        if condition > LARGEST_CONDITION:
            raise Degenerate(f"its covariance's condition number is {condition:.0e}, too large for float64")


def _learn(sampler: Any, vectors: Any, weights: Any, c1_times_delta_hsigma: float = 0.0) -> None:
    """C <- (1 + delta - sum w) C + sum_k w_k y_k y_k', with  w_k N / |C^(-1/2) y_k|^2  in place of a negative w_k
    (Hansen, "The CMA Evolution Strategy: A Tutorial", 2016, equations 46 and 47).

    pycma's `update` takes the norms one by one, and C three times through memory.
    """
    from scipy.linalg import get_blas_funcs

    y, w = np.asarray(vectors), np.array(weights)
    decay = 1 + c1_times_delta_hsigma - w.sum()
    worse = w < 0
    norm = np.sqrt((((y[worse] @ sampler.B) / sampler.D) ** 2).sum(axis=1))
    w[worse] *= y.shape[1] / (norm + 1e-9) ** 2
    gemm = get_blas_funcs("gemm", dtype=np.float64)
    sampler.C = gemm(1.0, (w[:, None] * y).T, y.T, beta=decay, c=sampler.C.T, trans_b=True, overwrite_c=True).T
    sampler.count_tell += 1


def _put(part: Any, state: dict[str, np.ndarray], names: tuple[str, ...]) -> None:
    """Sets fields: arrays as copies in the same order in memory, single numbers as Python's own."""
    for name in names:
        value = state[name]
        setattr(part, name, np.array(value, order="K") if np.ndim(value) else value.item())


@cache
def _load_pycma() -> Any:
    """pycma, without the plots and the tests of ranks that it loads but that nothing here uses.

    They would take 3.4 of 4 seconds. Modules that are loaded already stay as they are.
    """
    unused = ("matplotlib", "matplotlib.pyplot", "scipy", "scipy.stats")
    left_out = [name for name in unused if name not in sys.modules and "cma" not in sys.modules]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sys.modules.update(dict.fromkeys(left_out))  # ty: ignore[no-matching-overload]
        try:
            return importlib.import_module("cma")
        finally:
            for name in left_out:
                del sys.modules[name]
