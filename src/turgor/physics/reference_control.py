"""The control of the reference: what an agent observes, and what each controller makes of it.

A controller is a function of the state (which holds what it keeps from step to step), the observation o, theta and
the task; what it returns is the springs' numbers, then the chambers'.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from turgor.control import MLP, Distributed, Linear, Sinusoid, output_count, turn_per_step
from turgor.task import Task

if TYPE_CHECKING:
    from turgor.physics.reference import State


def observe(state: State, task: Task) -> np.ndarray:
    """One observation: touch, x and y of each mass, velocity x, y, pressure of each chamber."""
    sensing, body = task.sensing, task.body
    mass = body.mass.astype(state.position.dtype)
    com = np.average(state.position, axis=0, weights=mass)
    relative = (state.position - com) / (sensing.position_scale * body.radius or np.inf)
    velocity = np.average(state.velocity, axis=0, weights=mass) / sensing.velocity_scale
    signed = np.clip(np.concatenate([relative.ravel(), velocity]), -1, 1)
    if sensing.observation == "unit":
        signed = (signed + 1) / 2
    full = np.where(task.pressure_range[:, 1] > 0, task.pressure_range[:, 1], np.inf)
    pressure = np.clip(state.pressure / full, 0, 1)
    return np.concatenate([state.touch, signed, pressure]).astype(state.position.dtype)


def sense(state: State, task: Task) -> np.ndarray:
    """o: the mean of the last `window` observations, the present one included."""
    state.window.append(observe(state, task))
    return np.mean(np.array(state.window), axis=0)


def control(
    state: State, observation: np.ndarray, theta: ArrayLike | None, task: Task
) -> tuple[np.ndarray, np.ndarray]:
    """Spring commands [1] and pressure changes [Pa]; zeros for what the condition does not control."""
    body = task.body
    springs, chambers = np.zeros(body.spring_count), np.zeros(body.chamber_count)
    if task.condition == "passive":
        return springs, chambers
    thinking: dict[type, Any] = {Linear: linear, MLP: mlp, Sinusoid: sinusoid, Distributed: distributed}
    think = thinking[type(task.controller)]
    output = think(state, observation, np.asarray(theta, dtype=np.float64), task).astype(observation.dtype)
    springs = np.tanh(output[: body.spring_count])
    if task.condition == "pressure":
        chambers = task.pressure_step * output[body.spring_count :]
    return springs, chambers


# --- controllers --------------------------------------------------------------------------------------------


def take(theta: np.ndarray, outputs: int, inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights [output, input], biases [output] of the layer that `theta` begins with, and the rest of theta."""
    end = outputs * inputs
    return theta[:end].reshape(outputs, inputs), theta[end : end + outputs], theta[end + outputs :]


def heads(o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """W_s o + b_s, W_p o + b_p."""
    w_s, b_s, theta = take(theta, task.body.spring_count, len(o))
    w_p, b_p, _ = take(theta, task.body.chamber_count if task.condition == "pressure" else 0, len(o))
    return np.concatenate([w_s @ o + b_s, w_p @ o + b_p])


def linear(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """W_s o + b_s, W_p o + b_p."""
    return heads(o, theta, task)


def mlp(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """W_s h + b_s, W_p h + b_p  with  h = tanh(W_1 o + b_1)."""
    assert isinstance(task.controller, MLP)
    w, b, theta = take(theta, task.controller.hidden, len(o))
    return heads(np.tanh(w @ o + b), theta, task)


def sinusoid(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """a cos 2 pi p + b sin 2 pi p + c  of the phase p, which advances."""
    p = 2 * np.pi * state.phase
    w, b, _ = take(theta[1:], output_count(task.body, task.condition), 2)
    state.phase = (state.phase + turn_per_step(theta[0], task.physics.dt)) % 1
    return w @ np.array([np.cos(p), np.sin(p)]) + b


def distributed(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """Of each mass: the command for the spring after it; of each chamber: its masses' mean vote. Messages are sent."""
    body, controller = task.body, task.controller
    assert isinstance(controller, Distributed)
    n, m = body.mass_count, controller.messages
    w_1, b_1, theta = take(theta, controller.hidden, 5 + 2 * m)
    w_2, b_2, _ = take(theta, 1 + 2 * m + (task.condition == "pressure"), controller.hidden)
    i, j = body.springs.T
    length = np.linalg.norm(state.position[j] - state.position[i], axis=1)
    span = body.rest_length * np.maximum(1 - body.shortest, body.longest - 1)
    strain = np.clip((length - body.rest_length) / np.where(span > 0, span, np.inf), -1, 1)
    if task.sensing.observation == "unit":
        strain = (strain + 1) / 2
    springs, votes = np.zeros(body.spring_count), np.zeros(n)
    sent = np.zeros_like(state.messages)
    for mass in range(n):
        before, after = int(np.flatnonzero(j == mass)[0]), int(np.flatnonzero(i == mass)[0])
        heard = np.concatenate([state.messages[before, 0], state.messages[after, 1]])
        place = o[[mass, n + 2 * mass, n + 2 * mass + 1]]
        h = np.tanh(w_1 @ np.concatenate([place, strain[[before, after]], heard]) + b_1)
        answer = w_2 @ h + b_2
        springs[after] = answer[0]
        sent[before, 1], sent[after, 0] = np.tanh(answer[1 : 1 + m]), np.tanh(answer[1 + m : 1 + 2 * m])
        votes[mass] = answer[-1]
    state.messages = sent
    if task.condition != "pressure":
        return springs
    return np.concatenate([springs, [votes[list(loop)].mean() for loop in body.chambers]])
