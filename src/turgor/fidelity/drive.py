"""Agents in another physics engine: what they sense, decide and do is turgor's, what moves them is the engine's.

Each agent has a world of its own. All go through their steps together, so that sensing, control and the gas are one
NumPy call for the batch; they are those of the engine's oracle, `turgor.physics.reference`.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from turgor.errors import InvalidInput
from turgor.physics.reference import State, actuate, gas_pressure, has_ended, pressure_force, start
from turgor.physics.reference_control import control, sense
from turgor.task import Task


class World(Protocol):
    """The body and the scene of a task in another engine, for one agent."""

    def __init__(self, task: Task, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """At `position` [m] with `velocity` [m/s], shape [mass, 2]. Raises `InvalidInput` for a task that the engine
        has no counterpart of."""

    def read(self, position: np.ndarray, velocity: np.ndarray, touch: np.ndarray) -> None:
        """Fills in position [m] and velocity [m/s], shape [mass, 2], and which masses touched anything but their spring
        neighbours in the last step, [mass]."""

    def step(self, rest_length: np.ndarray, force: np.ndarray) -> None:
        """One step under rest lengths [m], shape [spring], and the gas's force [N], shape [mass, 2]."""

    def close(self) -> None:
        """Gives the world back; nothing can be asked of it any more."""


class Ended(NamedTuple):
    """Where agents were when their task was over."""

    position: np.ndarray  # [m], shape [agent, mass, 2]
    steps: np.ndarray  # [agent]
    solved: np.ndarray  # [agent], bool


class Script(NamedTuple):
    """A course of rest lengths and pressure in place of a controller."""

    rest_length: np.ndarray  # [m], shape [step, spring]
    pressure: np.ndarray | None  # [Pa], shape [step, chamber]; None: the gas law's


class Trace(NamedTuple):
    """What the first agent did; index t is after step t, as in a `Recording`."""

    position: list[np.ndarray]
    velocity: list[np.ndarray]
    pressure: list[np.ndarray]
    rest_length: list[np.ndarray]
    touch: list[np.ndarray]
    observation: list[np.ndarray]


def run(
    engine: type[World],
    task: Task,
    theta: np.ndarray,
    position: np.ndarray,
    *,
    velocity: np.ndarray | None = None,
    script: Script | None = None,
    trace: Trace | None = None,
) -> Ended:
    """What agents with `theta` [agent, parameter] achieve from `position` [m], shape [agent, mass, 2], in worlds of
    `engine`, over the whole task or the whole `script`. `trace`, if given, is filled."""
    if script is None and task.pressure is not None:
        script = Script(np.tile(task.body.rest_length, (task.steps, 1)), task.pressure)
    state = start(task, position, velocity)
    final, steps = state.position.copy(), np.zeros(len(position), dtype=np.int64)
    solved = np.zeros(len(position), dtype=bool)
    worlds = [engine(task, p, v) for p, v in zip(state.position, state.velocity, strict=True)]
    try:
        _note(trace, state)
        for t in range(task.steps if script is None else len(script.rest_length)):
            _decide(state, task, theta, script, t, trace)
            force = pressure_force(state, task)
            for a in np.flatnonzero(~solved):
                worlds[a].step(state.rest_length[a], force[a])
                worlds[a].read(state.position[a], state.velocity[a], state.touch[a])
            _check(state, t)
            _note(trace, state)
            final[~solved], steps[~solved] = state.position[~solved], t + 1
            solved |= has_ended(state, task)
            if solved.all():
                break
    finally:
        for world in worlds:
            world.close()
    return Ended(final, steps, solved)


def _decide(state: State, task: Task, theta: np.ndarray, script: Script | None, t: int, trace: Trace | None) -> None:
    """Sets rest lengths and pressure for step `t`."""
    if script is not None:
        state.rest_length[:] = script.rest_length[t]
        state.pressure[:] = gas_pressure(state, task) if script.pressure is None else script.pressure[t]
        return
    observation = sense(state, task)
    actuate(state, task, *control(state, observation, theta, task))
    if trace is not None:
        trace.observation.append(observation[0])


def _check(state: State, t: int) -> None:
    """Raises `InvalidInput` where an engine has lost its numbers."""
    if not np.isfinite(state.position).all():
        agent = int(np.flatnonzero(~np.isfinite(state.position).all(axis=(1, 2)))[0])
        raise InvalidInput("position: expected finite numbers from the engine", f"NaN of agent {agent} in step {t + 1}")


def _note(trace: Trace | None, state: State) -> None:
    if trace is not None:
        for name in ("position", "velocity", "pressure", "rest_length", "touch"):
            getattr(trace, name).append(getattr(state, name)[0].copy())


def new_trace() -> Trace:
    """A `Trace` to be filled."""
    empty: list[Any] = [[] for _ in Trace._fields]
    return Trace(*empty)
