"""The control of the reference: what an agent observes, and what each controller makes of it.

A controller is a function of the state (which holds what it keeps from step to step), the observation o, theta and
the task; what it returns is the springs' numbers, then the chambers'. The arrays may be of one agent, or of many with
the agent's index first: other engines are driven with these functions too (`turgor.fidelity`).
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
    com = np.average(state.position, axis=-2, weights=mass)
    relative = (state.position - com[..., None, :]) / (sensing.position_scale * body.radius or np.inf)
    velocity = np.average(state.velocity, axis=-2, weights=mass) / sensing.velocity_scale
    signed = np.clip(np.concatenate([relative.reshape(*com.shape[:-1], -1), velocity], axis=-1), -1, 1)
    if sensing.observation == "unit":
        signed = (signed + 1) / 2
    full = np.where(task.pressure_range[:, 1] > 0, task.pressure_range[:, 1], np.inf)
    pressure = np.clip(state.pressure / full, 0, 1)
    return np.concatenate([state.touch, signed, pressure], axis=-1).astype(state.position.dtype)


def sense(state: State, task: Task) -> np.ndarray:
    """o: the mean of the last `window` observations, the present one included."""
    state.window.append(observe(state, task))
    return np.mean(np.array(state.window), axis=0)


def control(
    state: State, observation: np.ndarray, theta: ArrayLike | None, task: Task
) -> tuple[np.ndarray, np.ndarray]:
    """Spring commands [1] and pressure changes [Pa]; zeros for what the condition does not control."""
    chambers = np.zeros_like(state.pressure)
    if task.condition == "passive":
        return np.zeros_like(state.rest_length), chambers
    thinking: dict[type, Any] = {Linear: linear, MLP: mlp, Sinusoid: sinusoid, Distributed: distributed}
    think = thinking[type(task.controller)]
    output = think(state, observation, np.asarray(theta, dtype=np.float64), task).astype(observation.dtype)
    springs = np.tanh(output[..., : task.body.spring_count])
    if task.condition == "pressure":
        chambers = task.pressure_step * output[..., task.body.spring_count :]
    return springs, chambers


# --- controllers --------------------------------------------------------------------------------------------


def take(theta: np.ndarray, outputs: int, inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights [..., output, input] and biases [..., output] of `theta`'s first layer, and the rest of theta."""
    end = outputs * inputs
    weights = theta[..., :end].reshape(*theta.shape[:-1], outputs, inputs)
    return weights, theta[..., end : end + outputs], theta[..., end + outputs :]


def dense(w: np.ndarray, o: np.ndarray, b: np.ndarray) -> np.ndarray:
    """W o + b."""
    return (w @ o[..., None])[..., 0] + b


def heads(o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """W_s o + b_s, W_p o + b_p."""
    inputs = o.shape[-1]
    w_s, b_s, theta = take(theta, task.body.spring_count, inputs)
    w_p, b_p, _ = take(theta, task.body.chamber_count if task.condition == "pressure" else 0, inputs)
    return np.concatenate([dense(w_s, o, b_s), dense(w_p, o, b_p)], axis=-1)


def linear(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """W_s o + b_s, W_p o + b_p."""
    return heads(o, theta, task)


def mlp(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """W_s h + b_s, W_p h + b_p  with  h = tanh(W_1 o + b_1)."""
    assert isinstance(task.controller, MLP)
    w, b, theta = take(theta, task.controller.hidden, o.shape[-1])
    return heads(np.tanh(dense(w, o, b)), theta, task)


def sinusoid(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """a cos 2 pi p + b sin 2 pi p + c  of the phase p, which advances."""
    p = 2 * np.pi * state.phase
    w, b, _ = take(theta[..., 1:], output_count(task.body, task.condition), 2)
    state.phase = (state.phase + turn_per_step(theta[..., 0], task.physics.dt)) % 1
    return dense(w, np.stack([np.cos(p), np.sin(p)], axis=-1), b)


def distributed(state: State, o: np.ndarray, theta: np.ndarray, task: Task) -> np.ndarray:
    """Of each mass: the command for the spring after it; of each chamber: its masses' mean vote. Messages are sent."""
    body, controller = task.body, task.controller
    assert isinstance(controller, Distributed)
    n, m = body.mass_count, controller.messages
    w_1, b_1, theta = take(theta, controller.hidden, 5 + 2 * m)
    w_2, b_2, _ = take(theta, 1 + 2 * m + (task.condition == "pressure"), controller.hidden)
    i, j = body.springs.T
    before, after = np.argsort(j), np.argsort(i)  # of each mass: the spring that ends there, the one that begins there
    length = np.linalg.norm(state.position[..., j, :] - state.position[..., i, :], axis=-1)
    span = body.rest_length * np.maximum(1 - body.shortest, body.longest - 1)
    strain = np.clip((length - body.rest_length) / np.where(span > 0, span, np.inf), -1, 1)
    if task.sensing.observation == "unit":
        strain = (strain + 1) / 2
    place = [o[..., :n], o[..., n : 3 * n : 2], o[..., n + 1 : 3 * n : 2], strain[..., before], strain[..., after]]
    heard = [state.messages[..., before, 0, :], state.messages[..., after, 1, :]]
    seen = np.concatenate([np.stack(place, axis=-1), *heard], axis=-1)  # [..., mass, input]
    # the same layers for every mass: W x + b with x of one mass a row
    h = np.tanh(seen @ np.swapaxes(w_1, -1, -2) + b_1[..., None, :])
    answer = h @ np.swapaxes(w_2, -1, -2) + b_2[..., None, :]
    springs, sent = np.zeros_like(state.rest_length, dtype=np.float64), np.zeros_like(state.messages)
    springs[..., after] = answer[..., 0]
    sent[..., before, 1, :] = np.tanh(answer[..., 1 : 1 + m])
    sent[..., after, 0, :] = np.tanh(answer[..., 1 + m : 1 + 2 * m])
    state.messages = sent
    if task.condition != "pressure":
        return springs
    votes = [answer[..., list(loop), -1].mean(axis=-1, keepdims=True) for loop in body.chambers]
    return np.concatenate([springs, *votes], axis=-1)
