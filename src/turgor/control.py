"""Sensing and control: what an agent observes, and the linear controller that moves it.

    s  = tanh(W_s o + b_s)              spring commands: > 0 shortens, < 0 lengthens
    dp = p_unit (W_p o + b_p)           pressure change per step

`o` is the mean of the last `window` observations. theta = [W_s row-major, b_s, W_p row-major, b_p].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from turgor.body import Body
from turgor.errors import InvalidInput, describe
from turgor.variants import Condition
from turgor.variants import Sensing as Sensing


def observation_count(body: Body) -> int:
    """Values in one observation: touch, x, y of each mass; velocity x, y; pressure of each chamber."""
    return 3 * body.mass_count + 2 + body.chamber_count


def output_count(body: Body, condition: Condition) -> int:
    """Rows of the controller: one per commanded spring, then one per commanded chamber."""
    if condition == "passive":
        return 0
    return body.spring_count + (body.chamber_count if condition == "pressure" else 0)


def parameter_count(body: Body, condition: Condition) -> int:
    """Length of theta: 374, 784, 1344 for the paper's bodies with pressure, 340, 735, 1280 without."""
    return output_count(body, condition) * (observation_count(body) + 1)


def rows(theta: np.ndarray, body: Body, condition: Condition) -> tuple[np.ndarray, np.ndarray]:
    """Weights [agent, output, observation] and biases [agent, output] of `theta` [agent, parameter]."""
    agents, inputs = len(theta), observation_count(body)
    weights, biases, at = [], [], 0
    springs = body.spring_count if condition != "passive" else 0
    for outputs in (springs, output_count(body, condition) - springs):
        weights.append(theta[:, at : at + outputs * inputs].reshape(agents, outputs, inputs))
        at += outputs * inputs
        biases.append(theta[:, at : at + outputs])
        at += outputs
    return np.concatenate(weights, axis=1), np.concatenate(biases, axis=1)


def check_theta(theta: ArrayLike, body: Body, condition: Condition) -> np.ndarray:
    """`theta` as float64 [agent, parameter]; raises `InvalidInput` for another shape, NaN or infinity."""
    count = parameter_count(body, condition)
    try:
        array = np.asarray(theta, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidInput(f"theta: expected numbers of shape [agent, {count}]", describe(theta)) from None
    if array.ndim != 2 or array.shape[1] != count:
        hint = " (for one agent: theta[None])" if array.shape == (count,) else ""
        raise InvalidInput(f"theta: expected shape [agent, {count}]{hint}", f"shape {list(array.shape)}")
    if not np.isfinite(array).all():
        agent, parameter = np.argwhere(~np.isfinite(array))[0]
        raise InvalidInput(
            "theta: expected finite numbers", f"{array[agent, parameter]} at agent {agent}, parameter {parameter}"
        )
    largest = max(array.max(initial=0.0), -array.min(initial=0.0))  # no temporary array: theta may be large
    if largest > 1e15:
        raise InvalidInput("theta: expected numbers within 1e15", describe(largest))
    return array
