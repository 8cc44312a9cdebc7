"""OpenAI-ES: stochastic gradient ascent on the fitness of a blurred controller.

Salimans, Ho, Chen, Sidor and Sutskever, "Evolution Strategies as a Scalable Alternative to Reinforcement Learning",
2017. Adam: Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015, with its symbols and in the order of
the end of its section 2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from turgor.evolution.strategy import (
    check_numbers,
    check_positive,
    check_start,
    check_state,
    check_told,
    numerics,
    rng_bits,
    set_rng_bits,
)

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8  # of Adam
STATE = {"mean": "n", "sigma": "", "alpha": "", "m": "n", "v": "n", "t": "", "population": ""}  # shapes


class OpenAIES:
    """OpenAI-ES: mirrored agents around a mean, their ranks as weights of a gradient, Adam's steps along it.

        strategy = OpenAIES(374, np.random.default_rng(0))
        for _ in range(100):
            theta = strategy.ask()  # [agent, parameter]
            strategy.tell(theta, fitness=-np.square(theta - 1).sum(axis=1))  # the higher the better

    Its step size `sigma` never changes: it improves what it has, and does not converge. Its initial mean is uniform
    in [-1, 1]. All randomness is the generator's; the bits are the same for the same generator, whatever the number
    of threads. Agents of the same fitness share their rank, and there is no weight decay.
    """

    name = "openai-es"

    def __init__(
        self,
        parameter_count: int,
        rng: np.random.Generator,
        *,
        population: int | None = None,
        sigma: float = 0.3,
        mean: ArrayLike | None = None,
        alpha: float = 0.1,
    ) -> None:
        """`population`: even, None for 4 + floor(3 ln parameter_count) or one more; `mean` [parameter]: None for
        uniform in [-1, 1]; `alpha`: what Adam moves a parameter by in a generation, at most about [1].

        Raises `InvalidInput`.
        """
        self._lambda, self._sigma, self._mean = check_start(parameter_count, rng, population, sigma, mean, even=True)
        check_positive("alpha", alpha)
        self._alpha = float(alpha)
        self._m, self._v = np.zeros(parameter_count), np.zeros(parameter_count)  # moments of the gradient
        self._t = 0  # generations
        self._rng = rng
        self._before_ask = rng_bits(rng)

    @property
    def population(self) -> int:
        return self._lambda

    @property
    def sigma(self) -> float:
        return self._sigma

    def ask(self) -> np.ndarray:
        """The next generation, float64 [agent, parameter]; agent k and agent k + population / 2 mirror each other."""
        self._before_ask = rng_bits(self._rng)
        with numerics():
            epsilon = self._rng.standard_normal((self._lambda // 2, len(self._mean)))
            theta = self._mean + self._sigma * np.concatenate([epsilon, -epsilon])
        check_numbers(self._sigma, theta)
        return theta

    def tell(self, theta: np.ndarray, fitness: np.ndarray) -> None:
        """Learns from the `fitness` [agent], the higher the better, of `theta` from `ask`. Only its order counts; NaN
        and -inf are worse than every number. Raises `Degenerate`."""
        theta, cost = check_told(theta, fitness, (self._lambda, len(self._mean)))
        with numerics():
            # g = 1 / (lambda sigma) sum_i F_i epsilon_i,  epsilon_i = (theta_i - mean) / sigma
            epsilon = (theta - self._mean) / self._sigma
            self._ascend((centred_ranks(-cost)[:, None] * epsilon).sum(axis=0) / (self._lambda * self._sigma))
        self._before_ask = rng_bits(self._rng)
        check_numbers(self._sigma, self._mean)

    def _ascend(self, g: np.ndarray) -> None:
        """A step of Adam along the gradient `g` [parameter]."""
        self._t += 1
        alpha_t = self._alpha * math.sqrt(1 - BETA_2**self._t) / (1 - BETA_1**self._t)
        self._m = BETA_1 * self._m + (1 - BETA_1) * g
        self._v = BETA_2 * self._v + (1 - BETA_2) * g**2
        self._mean = self._mean + alpha_t * self._m / (np.sqrt(self._v) + EPSILON)

    def state(self) -> dict[str, np.ndarray]:
        """Arrays from which `restore` goes on; taken between `ask` and `tell`, it goes on with the same `ask`."""
        numbers = (self._mean, self._sigma, self._alpha, self._m, self._v, self._t, self._lambda)
        arrays = {name: np.array(value) for name, value in zip(STATE, numbers, strict=True)}
        return {**arrays, "generator": self._before_ask.copy()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Goes on from `state`; number of parameters and population are the state's. Raises `InvalidInput`."""
        check_state(self.name, state, STATE)
        self._lambda, self._sigma, self._alpha = int(state["population"]), float(state["sigma"]), float(state["alpha"])
        self._mean, self._m, self._v = (np.array(state[name]) for name in ("mean", "m", "v"))
        self._t = int(state["t"])
        self._before_ask = np.array(state["generator"])
        set_rng_bits(self._rng, self._before_ask)


def centred_ranks(fitness: np.ndarray) -> np.ndarray:
    """The rank of each agent, from -1/2 (worst) to 1/2 (best), [agent]; equal ones share their mean rank."""
    _, which, count = np.unique(fitness, return_inverse=True, return_counts=True)
    below = np.cumsum(count) - count
    return (below + (count - 1) / 2)[which] / (len(fitness) - 1) - 0.5
