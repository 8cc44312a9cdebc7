"""Sensing and control: what an agent observes, and the controllers that move it.

    Linear        s = tanh(W_s o + b_s)                      the paper's
                  dp = p_unit (W_p o + b_p)
    MLP           h = tanh(W_1 o + b_1)                      a hidden layer before the same two
    Sinusoid      s = tanh(a cos wt + b sin wt + c)          open loop: it observes nothing
                  dp = p_unit (a cos wt + b sin wt + c)
    Distributed   h_i = tanh(W_1 o_i + b_1), W_2 h_i + b_2   of each mass i, the same network for all

s are spring commands (> 0 shortens, < 0 lengthens), dp is the pressure change per step, `o` the mean of the last
`window` observations. docs/controllers.md tells what they can do, and how to add one.

theta is a sequence of dense layers, each W row-major [output, input], then b: `layers` lists them. Before its only
layer, a sinusoid's theta holds u, its frequency 2^u Hz.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.body import Body
from turgor.errors import InvalidInput, describe, one_of
from turgor.variants import Condition
from turgor.variants import Sensing as Sensing

LARGEST_EXPONENT = 3.0  # of a sinusoid's frequency: u beyond +-3 is 3, so that f is within 1/8 and 8 Hz
CLOCK = 2**23  # a sinusoid's phase advances by whole parts of a turn this large: float32 adds them without error


class Linear(msgspec.Struct, frozen=True, tag="linear"):
    """The paper's: one dense layer from all observations to all outputs."""


class MLP(msgspec.Struct, frozen=True, tag="mlp"):
    """One hidden layer of `hidden` tanh units."""

    hidden: int = 16

    def __post_init__(self) -> None:
        _check_count("hidden", self.hidden, 1)


class Sinusoid(msgspec.Struct, frozen=True, tag="sinusoid"):
    """Open loop: every output follows its own sinusoid, all of one frequency."""


class Distributed(msgspec.Struct, frozen=True, tag="distributed"):
    """The same small network in every mass, which sees its mass and hears its neighbours: theta does not grow with
    the body. `messages` numbers go each way along every spring, and arrive a step later."""

    hidden: int = 8
    messages: int = 1

    def __post_init__(self) -> None:
        _check_count("hidden", self.hidden, 1)
        _check_count("messages", self.messages, 0)


Controller = Linear | MLP | Sinusoid | Distributed
LINEAR = Linear()
CONTROLLERS = {"linear": Linear, "mlp": MLP, "sinusoid": Sinusoid, "distributed": Distributed}


def _check_count(name: str, value: Any, least: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= 1000:
        raise InvalidInput(f"{name}: expected a whole number, {least} to 1000", describe(value))


def make_controller(name: str, **numbers: int | None) -> Controller:
    """The controller called `name`; `numbers` that are None are left at their defaults. Raises `InvalidInput`."""
    if name not in CONTROLLERS:
        raise one_of("controller", CONTROLLERS, name)
    kind = CONTROLLERS[name]
    chosen = {number: value for number, value in numbers.items() if value is not None}
    for number in chosen:
        if number not in kind.__struct_fields__:
            having = [name for name, kind in CONTROLLERS.items() if number in kind.__struct_fields__]
            raise InvalidInput(f"{number}: expected a controller that has it ({', '.join(having)})", name)
    return kind(**chosen)


# --- sizes --------------------------------------------------------------------------------------------------------


def observation_count(body: Body) -> int:
    """Values in one observation: touch, x, y of each mass; velocity x, y; pressure of each chamber."""
    return 3 * body.mass_count + 2 + body.chamber_count


def output_count(body: Body, condition: Condition) -> int:
    """What a controller gives out: a command for each spring, then one for each chamber whose pressure it controls."""
    if condition == "passive":
        return 0
    return body.spring_count + (body.chamber_count if condition == "pressure" else 0)


def local_input_count(controller: Distributed) -> int:
    """What one mass of a distributed controller sees: its touch, x, y, the strain of the spring before and of the
    one after it, the messages from the mass before and from the mass after."""
    return 5 + 2 * controller.messages


def local_output_count(controller: Distributed, condition: Condition) -> int:
    """What it gives out: the command for the spring after it, the messages to the mass before and to the mass after,
    and, if pressure is controlled, its vote on the change."""
    return 1 + 2 * controller.messages + (condition == "pressure")


def layers(body: Body, condition: Condition, controller: Controller) -> list[tuple[int, int]]:
    """Outputs and inputs of each dense layer, in the order of theta."""
    inputs, outputs = observation_count(body), output_count(body, condition)
    if outputs == 0:
        return []
    springs, chambers = body.spring_count, outputs - body.spring_count
    match controller:
        case Linear():
            return [(springs, inputs), (chambers, inputs)]
        case MLP(hidden=hidden):
            return [(hidden, inputs), (springs, hidden), (chambers, hidden)]
        case Sinusoid():
            return [(outputs, 2)]
        case Distributed(hidden=hidden):
            return [(hidden, local_input_count(controller)), (local_output_count(controller, condition), hidden)]


def parameter_count(body: Body, condition: Condition, controller: Controller = LINEAR) -> int:
    """Length of theta. Linear: 374, 784, 1344 for the paper's bodies with pressure, 340, 735, 1280 without."""
    found = layers(body, condition, controller)
    frequencies = int(isinstance(controller, Sinusoid) and len(found) > 0)
    return frequencies + sum(outputs * (inputs + 1) for outputs, inputs in found)


def memory_count(body: Body, condition: Condition, controller: Controller) -> int:
    """Numbers that an agent's controller keeps from step to step, 0 at the start: a sinusoid its phase, a distributed
    one the messages on their way, [spring, forth and back, message]."""
    if condition == "passive":
        return 0
    match controller:
        case Sinusoid():
            return 1
        case Distributed(messages=messages):
            return 2 * messages * body.spring_count
    return 0


def check_body(body: Body, condition: Condition, controller: Controller) -> None:
    """Raises `InvalidInput` for a body that the controller cannot drive: a distributed one needs closed rings of
    springs, all directed the same way around."""
    if not isinstance(controller, Distributed) or condition == "passive":
        return
    for which, ends in (("first", body.springs[:, 0]), ("second", body.springs[:, 1])):
        count = np.bincount(ends, minlength=body.mass_count)
        if (count != 1).any():
            mass = int(np.argmax(count != 1))
            raise InvalidInput(
                "distributed: expected closed rings, where each mass is the first of one spring and the second of one",
                f"mass {mass}, the {which} of {count[mass]}",
            )


# --- theta --------------------------------------------------------------------------------------------------------


def pack(
    theta: np.ndarray, body: Body, condition: Condition, controller: Controller, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """`theta` [agent, parameter] as the kernel reads it: the weights [agent, weight] of all layers, one after the
    other, and their biases [agent, bias]. Before a sinusoid's weights stands what its clock does in a step of `dt` [s].
    """
    weights, biases, at = [theta[:, :0]], [theta[:, :0]], 0
    if isinstance(controller, Sinusoid) and condition != "passive":
        weights.append(turn_per_step(theta[:, :1], dt))
        at = 1
    for outputs, inputs in layers(body, condition, controller):
        weights.append(theta[:, at : at + outputs * inputs])
        at += outputs * inputs
        biases.append(theta[:, at : at + outputs])
        at += outputs
    return np.concatenate(weights, axis=1), np.concatenate(biases, axis=1)


def turn_per_step(u: np.ndarray, dt: float) -> np.ndarray:
    """Part of a turn [1], in [0, 1), by which sinusoids of 2^u Hz advance in `dt` [s], in whole 2^-23 of a turn."""
    turn = np.exp2(np.clip(u.astype(np.float64), -LARGEST_EXPONENT, LARGEST_EXPONENT)) * dt
    return np.round(turn * CLOCK) % CLOCK / CLOCK


def rows(theta: np.ndarray, body: Body, condition: Condition) -> tuple[np.ndarray, np.ndarray]:
    """Weights [agent, output, observation] and biases [agent, output] of a linear controller's `theta`
    [agent, parameter]."""
    weights, biases = pack(theta, body, condition, Linear(), 0.0)
    return weights.reshape(len(theta), output_count(body, condition), observation_count(body)), biases


def check_theta(theta: ArrayLike, body: Body, condition: Condition, controller: Controller = LINEAR) -> np.ndarray:
    """`theta` as float64 [agent, parameter], or as it is if it is an array of float32: theta may be large, and the
    kernel reads float32. Raises `InvalidInput` for another shape, NaN or infinity."""
    count = parameter_count(body, condition, controller)
    dtype = np.float32 if getattr(theta, "dtype", None) == np.float32 else np.float64
    try:
        array = np.asarray(theta, dtype=dtype)
    except (TypeError, ValueError):
        raise InvalidInput(f"theta: expected numbers of shape [agent, {count}]", describe(theta)) from None
    if array.ndim != 2 or array.shape[1] != count:
        hint = " (for one agent: theta[None])" if array.shape == (count,) else ""
        raise InvalidInput(f"theta: expected shape [agent, {count}]{hint}", f"shape {list(array.shape)}")
    # NaN and infinity show in the extremes, without a temporary array
    with np.errstate(invalid="ignore"):
        largest = float(np.maximum(array.max(initial=0.0), -array.min(initial=0.0)))
    if not np.isfinite(largest):
        agent, parameter = np.argwhere(~np.isfinite(array))[0]
        raise InvalidInput(
            "theta: expected finite numbers", f"{array[agent, parameter]} at agent {agent}, parameter {parameter}"
        )
    if largest > 1e15:
        raise InvalidInput("theta: expected numbers within 1e15", describe(largest))
    return array
