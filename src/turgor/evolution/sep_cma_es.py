"""Separable CMA-ES: a covariance of its diagonal alone.

Ros and Hansen, "A Simple Modification in CMA-ES Achieving Linear Time and Space Complexity", PPSN 2008. The numbers
in parentheses are the equations of Hansen, "The CMA Evolution Strategy: A Tutorial", 2016, for the same steps; the
weights and learning rates are those of 2008.
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
    numerics,
    rng_bits,
    set_rng_bits,
)

STATE = {"mean": "n", "sigma": "", "C": "n", "p_sigma": "n", "p_c": "n", "g": "", "population": ""}  # shapes


class SepCMAES:
    """Separable CMA-ES: a step size for every parameter, learned (n + 2) / 3 times as fast as a full covariance.

        strategy = SepCMAES(374, np.random.default_rng(0))
        for _ in range(100):
            theta = strategy.ask()  # [agent, parameter]
            strategy.tell(theta, fitness=-np.square(theta - 1).sum(axis=1))  # the higher the better

    Time and memory grow with the number of parameters, not with its square; what it cannot learn is how parameters
    depend on each other. Its initial mean is uniform in [-1, 1]. All randomness is the generator's; the bits are the
    same for the same generator, whatever the number of threads. It never ends by itself, apart from `Degenerate`.
    """

    name = "sep-cma-es"

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
        mu = lambda_ // 2
        w = math.log(mu + 1) - np.log(np.arange(1, mu + 1))
        self._w = w / w.sum()
        self._mu_eff = mu_eff = float(1 / (self._w**2).sum())
        self._c_sigma = (mu_eff + 2) / (n + mu_eff + 3)
        self._d_sigma = 1 + 2 * max(0, math.sqrt((mu_eff - 1) / (n + 1)) - 1) + self._c_sigma
        self._c_c = 4 / (n + 4)
        c_cov = 2 / (mu_eff * (n + math.sqrt(2)) ** 2)
        c_cov += (1 - 1 / mu_eff) * min(1, (2 * mu_eff - 1) / ((n + 2) ** 2 + mu_eff))
        # the paper's modification; more than 1, as for populations much larger than n, would forget more than all
        c_cov = min(1, (n + 2) / 3 * c_cov)
        self._c_1, self._c_mu = c_cov / mu_eff, c_cov * (1 - 1 / mu_eff)
        self._chi_n = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))  # E|N(0, I)|

        self._mean, self._sigma, self._lambda = mean, sigma, lambda_
        self._C = np.ones(n)  # diagonal of the covariance
        self._p_sigma, self._p_c = np.zeros(n), np.zeros(n)
        self._g = 0  # generations

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
            z = self._rng.standard_normal((self._lambda, len(self._mean)))  # (38)
            theta = self._mean + self._sigma * (np.sqrt(self._C) * z)  # (39), (40)
        check_numbers(self._sigma, theta, self._C)
        return theta

    def tell(self, theta: np.ndarray, fitness: np.ndarray) -> None:
        """Learns from the `fitness` [agent], the higher the better, of `theta` from `ask`. Only its order counts; NaN
        and -inf are worse than every number. Raises `Degenerate`."""
        theta, cost = check_told(theta, fitness, (self._lambda, len(self._mean)))
        best = np.argsort(cost, kind="stable")[: len(self._w)]
        with numerics():
            self._learn((theta[best] - self._mean) / self._sigma)
        self._before_ask = rng_bits(self._rng)
        check_numbers(self._sigma, self._mean, self._C)

    def _learn(self, y: np.ndarray) -> None:
        """Moves the distribution towards the best steps, `y` [rank, parameter]."""
        n, w, mu_eff, c_sigma, c_c = len(self._mean), self._w[:, None], self._mu_eff, self._c_sigma, self._c_c
        y_w = (w * y).sum(axis=0)  # (41)
        self._mean = self._mean + self._sigma * y_w  # (42)
        # p_sigma <- (1 - c_sigma) p_sigma + sqrt(c_sigma (2 - c_sigma) mu_eff) C^(-1/2) y_w  (43)
        self._p_sigma = (1 - c_sigma) * self._p_sigma
        self._p_sigma += math.sqrt(c_sigma * (2 - c_sigma) * mu_eff) * y_w / np.sqrt(self._C)
        length = math.sqrt((self._p_sigma**2).sum())
        # the path to the covariance waits while the one to the step size is long: sigma comes first
        expected = math.sqrt(1 - (1 - c_sigma) ** (2 * (self._g + 1))) * self._chi_n
        h_sigma = 1.0 if length < (1.4 + 2 / (n + 1)) * expected else 0.0
        # p_c <- (1 - c_c) p_c + h_sigma sqrt(c_c (2 - c_c) mu_eff) y_w  (45)
        self._p_c = (1 - c_c) * self._p_c + h_sigma * math.sqrt(c_c * (2 - c_c) * mu_eff) * y_w
        # C <- (1 - c_1 - c_mu) C + c_1 diag(p_c p_c') + c_mu sum_i w_i diag(y_i y_i')  (47)
        rank_mu = (w * y**2).sum(axis=0)
        self._C = (1 - self._c_1 - self._c_mu) * self._C + self._c_1 * self._p_c**2 + self._c_mu * rank_mu
        self._sigma *= math.exp(c_sigma / self._d_sigma * (length / self._chi_n - 1))  # (44)
        self._g += 1

    def state(self) -> dict[str, np.ndarray]:
        """Arrays from which `restore` goes on; taken between `ask` and `tell`, it goes on with the same `ask`."""
        numbers = (self._mean, self._sigma, self._C, self._p_sigma, self._p_c, self._g, self._lambda)
        arrays = {name: np.array(value) for name, value in zip(STATE, numbers, strict=True)}
        return {**arrays, "generator": self._before_ask.copy()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Goes on from `state`; number of parameters and population are the state's. Raises `InvalidInput`."""
        check_state(self.name, state, STATE)
        if not (state["C"] > 0).all():
            raise InvalidInput(f"state of {self.name}: expected positive numbers in C")
        self._start(np.array(state["mean"]), float(state["sigma"]), int(state["population"]))
        self._C, self._g = np.array(state["C"]), int(state["g"])
        self._p_sigma, self._p_c = np.array(state["p_sigma"]), np.array(state["p_c"])
        self._before_ask = np.array(state["generator"])
        set_rng_bits(self._rng, self._before_ask)
