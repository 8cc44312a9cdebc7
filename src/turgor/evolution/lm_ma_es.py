"""LM-MA-ES: a transformation of m vectors in place of a covariance.

Loshchilov, Glasmachers and Beyer, "Large Scale Black-Box Optimization by Limited-Memory Matrix Adaptation", IEEE
Transactions on Evolutionary Computation 23(2), 2019; the symbols are those of its algorithm.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from turgor.errors import InvalidInput
from turgor.evolution.strategy import (
    check_numbers,
    check_start,
    check_state,
    check_told,
    default_population,
    numerics,
    rng_bits,
    set_rng_bits,
)

STATE = {"mean": "n", "sigma": "", "p_sigma": "n", "m": "mn", "t": "", "population": ""}  # shapes


class LMMAES:
    """LM-MA-ES: learns m = 4 + floor(3 ln n) directions in which parameters depend on each other.

        strategy = LMMAES(1344, np.random.default_rng(0))
        for _ in range(100):
            theta = strategy.ask()  # [agent, parameter]
            strategy.tell(theta, fitness=-np.square(theta - 1).sum(axis=1))  # the higher the better

    Its time and memory grow as n ln n with the number of parameters n. Its initial mean is uniform in [-1, 1]. All
    randomness is the generator's; the bits are the same for the same generator, whatever the number of threads. It
    never ends by itself, apart from `Degenerate`. The paper's rates c_sigma and c_c exceed 1 where the population is
    more than n / 2, and are 1 there.
    """

    name = "lm-ma-es"

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
        population, sigma, mean = check_start(parameter_count, rng, population, sigma, mean)
        self._rng = rng
        self._start(mean, sigma, population)
        self._before_ask = rng_bits(rng)

    def _start(self, mean: np.ndarray, sigma: float, population: int) -> None:
        n, lambda_ = len(mean), population
        mu, memory = lambda_ // 2, default_population(n)
        w = math.log(mu + 1 / 2) - np.log(np.arange(1, mu + 1))
        self._w = w / w.sum()
        self._mu_w = float(1 / (self._w**2).sum())
        k = np.arange(memory)  # i - 1
        self._c_sigma = min(1.0, 2 * lambda_ / n)
        self._c_d = 1 / (1.5**k * n)
        self._c_c = np.minimum(1.0, lambda_ / (4.0**k * n))

        self._mean, self._sigma, self._lambda = mean, sigma, lambda_
        self._p_sigma = np.zeros(n)
        self._m = np.zeros((memory, n))
        self._t = 0  # generations
        self._asked: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # theta and its z, d

    @property
    def population(self) -> int:
        return self._lambda

    @property
    def sigma(self) -> float:
        return self._sigma

    def ask(self) -> np.ndarray:
        """The next generation, float64 [agent, parameter]."""
        self._before_ask = rng_bits(self._rng)
        with numerics():
            z = self._rng.standard_normal((self._lambda, len(self._mean)))
            d = z.copy()
            for c_d, m in zip(self._c_d[: self._t], self._m, strict=False):
                along = c_d * (d * m).sum(axis=1, keepdims=True)
                d *= 1 - c_d  # d <- (1 - c_d) d + c_d m (m' d)
                d += along * m
            theta = self._mean + self._sigma * d
        check_numbers(self._sigma, theta)
        self._asked = theta.copy(), z, d
        return theta

    def tell(self, theta: np.ndarray, fitness: np.ndarray) -> None:
        """Learns from the `fitness` [agent], the higher the better, of `theta` from the last `ask`. Only its order
        counts; NaN and -inf are worse than every number. Raises `InvalidInput` for another theta (what it was drawn
        from is not known), and `Degenerate`."""
        theta, cost = check_told(theta, fitness, (self._lambda, len(self._mean)))
        if self._asked is None or not np.array_equal(theta, self._asked[0]):
            raise InvalidInput(f"theta: expected what {self.name} was asked for last", "another one")
        best = np.argsort(cost, kind="stable")[: len(self._w)]
        with numerics():
            self._learn(self._asked[1][best], self._asked[2][best])
        self._asked = None
        self._before_ask = rng_bits(self._rng)
        check_numbers(self._sigma, self._mean)

    def _learn(self, z: np.ndarray, d: np.ndarray) -> None:
        """Moves the distribution towards the best steps `d` and the `z` they were made from, [rank, parameter]."""
        w, mu_w, c_sigma = self._w[:, None], self._mu_w, self._c_sigma
        z_w = (w * z).sum(axis=0)
        self._mean = self._mean + self._sigma * (w * d).sum(axis=0)
        # p_sigma <- (1 - c_sigma) p_sigma + sqrt(mu_w c_sigma (2 - c_sigma)) sum_i w_i z_i
        self._p_sigma = (1 - c_sigma) * self._p_sigma + math.sqrt(mu_w * c_sigma * (2 - c_sigma)) * z_w
        # m_i <- (1 - c_c,i) m_i + sqrt(mu_w c_c,i (2 - c_c,i)) sum_i w_i z_i
        c_c = self._c_c[:, None]
        self._m = (1 - c_c) * self._m + np.sqrt(mu_w * c_c * (2 - c_c)) * z_w
        self._sigma *= math.exp(c_sigma / 2 * ((self._p_sigma**2).sum() / len(z_w) - 1))
        self._t += 1

    def state(self) -> dict[str, np.ndarray]:
        """Arrays from which `restore` goes on; taken between `ask` and `tell`, it goes on with the same `ask`."""
        numbers = (self._mean, self._sigma, self._p_sigma, self._m, self._t, self._lambda)
        arrays = {name: np.array(value) for name, value in zip(STATE, numbers, strict=True)}
        return {**arrays, "generator": self._before_ask.copy()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Goes on from `state`; number of parameters and population are the state's. Raises `InvalidInput`."""
        check_state(self.name, state, STATE)
        if len(state["m"]) != default_population(len(state["mean"])):
            raise InvalidInput(f"state of {self.name}: expected 4 + floor(3 ln n) vectors in m", str(len(state["m"])))
        self._start(np.array(state["mean"]), float(state["sigma"]), int(state["population"]))
        self._p_sigma, self._m, self._t = np.array(state["p_sigma"]), np.array(state["m"]), int(state["t"])
        self._before_ask = np.array(state["generator"])
        set_rng_bits(self._rng, self._before_ask)
