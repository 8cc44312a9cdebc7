"""The paper's agent on the real Box2D, through pybox2d: one agent, one core, as fast as reasonable in Python.

    python benchmarks/box2d_peer.py [BODY]      prints how fast it is with a random controller

It is what a careful author would write without an engine of their own: everything that does not change is laid out
once, positions and velocities are read through live views of Box2D's vectors, one force per mass, one NumPy product
for the controller, a contact listener instead of lists of contacts. The world is that of `turgor.fidelity.box2d`, which
runs any task; what is here does one kind of task, and that faster. `turgor bench` runs it beside the engine, and the
tests hold the two together over the first steps. Needs the package `box2d`; with `pyb2d3` the same runs in Box2D v3.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from turgor.control import Linear, rows
from turgor.fidelity.box2d import Box2DWorld
from turgor.task import Task, make_task


class Agent:
    """One agent of `task` with controller `theta` [parameter], in a Box2D world of its own."""

    def __init__(self, task: Task, theta: np.ndarray) -> None:
        check_task(task)
        body, n = task.body, task.body.mass_count
        self.physics = task.physics
        self.lay_out(task)
        self.share = body.mass / body.mass.sum()

        # observations: touch, x of all, y of all, velocity, pressure; theta has x and y of each mass together
        order = np.concatenate(
            [np.arange(n), n + 2 * np.arange(n), n + 2 * np.arange(n) + 1, [3 * n, 3 * n + 1, 3 * n + 2]]
        )
        weight, bias = rows(np.reshape(theta, (1, -1)), body, task.condition)
        self.weight, self.bias = np.ascontiguousarray(weight[0][:, order]), bias[0]
        self.position_scale = task.sensing.position_scale * body.radius
        self.velocity_scale = task.sensing.velocity_scale
        self.low = np.concatenate([np.zeros(n), np.full(2 * n + 2, -1.0), [0.0]])
        self.window = np.zeros((task.sensing.window, 3 * n + 3))
        self.total = np.zeros(3 * n + 3)  # of the window
        self.steps = 0

        loop = np.array(body.chambers[0])
        self.after, self.before = np.empty(n, int), np.empty(n, int)
        self.after[loop], self.before[loop] = np.roll(loop, -1), np.roll(loop, 1)
        self.rest = body.rest_length
        self.shorten, self.lengthen = (1 - body.shortest) * self.rest, (body.longest - 1) * self.rest
        self.pressure = float(task.pressure_start[0])
        self.pressure_min, self.pressure_max = task.pressure_range[0].tolist()
        self.pressure_step = float(task.pressure_step[0])

    def lay_out(self, task: Task) -> None:
        """Makes the world."""
        self.box2d = Box2DWorld(task, task.position)
        self.world, self.masses, self.springs = self.box2d.world, self.box2d.masses, self.box2d.springs
        self.touch = self.box2d.touches.count  # live, as positions and velocities are

    def step(self) -> None:
        """Sense, control, actuate, push, solve."""
        state = self.read()
        output = self.weight @ self.sense(state) + self.bias
        self.advance(self.actuate(output), self.push(state[:2]))
        self.steps += 1

    def read(self) -> np.ndarray:
        """x, y [m] and velocity x, y [m/s] of all masses, shape [4, mass]."""
        p, v = self.box2d.positions, self.box2d.velocities
        return np.array([[a.x for a in p], [a.y for a in p], [a.x for a in v], [a.y for a in v]])

    def sense(self, state: np.ndarray) -> np.ndarray:
        """The mean of the last observations, as many as the window holds."""
        n, observation = len(self.share), self.window[self.steps % len(self.window)]
        self.total -= observation
        centre = state @ self.share
        observation[:n] = self.touch
        observation[n : 3 * n] = ((state[:2] - centre[:2, None]) / self.position_scale).ravel()
        observation[3 * n : 3 * n + 2] = centre[2:] / self.velocity_scale
        observation[-1] = self.pressure / self.pressure_max
        np.minimum(np.maximum(observation, self.low, out=observation), 1, out=observation)
        self.total += observation
        return self.total / min(self.steps + 1, len(self.window))

    def actuate(self, output: np.ndarray) -> np.ndarray:
        """Rest lengths [m], shape [spring]; sets the pressure."""
        # L = L0 - s (L0 - l_min) for s > 0, L0 - s (l_max - L0) otherwise;  p = clip(p + dp, p_min, p_max)
        command = np.tanh(output[:-1])
        pressure = self.pressure + self.pressure_step * float(output[-1])
        self.pressure = min(max(pressure, self.pressure_min), self.pressure_max)
        return self.rest - command * np.where(command > 0, self.shorten, self.lengthen)

    def push(self, position: np.ndarray) -> np.ndarray:
        """The gas's force on every mass [N], shape [2, mass]."""
        # its two edges together: p/2 (d_y, -d_x), d from the mass before to the mass after
        d = position.take(self.after, axis=1) - position.take(self.before, axis=1)
        return self.pressure / 2 * np.stack([d[1], -d[0]])

    def advance(self, lengths: np.ndarray, force: np.ndarray) -> None:
        """One step of the world."""
        for spring, length in zip(self.springs, lengths.tolist(), strict=True):
            spring.length = length
        for mass, fx, fy in zip(self.masses, *force.tolist(), strict=True):
            mass.ApplyForceToCenter((fx, fy), True)
        self.world.Step(self.physics.dt, self.physics.velocity_iterations, self.physics.position_iterations)
        self.world.ClearForces()


class AgentV3(Agent):
    """The same agent in Box2D v3: another solver, so that it moves otherwise. Needs the package `pyb2d3`."""

    def lay_out(self, task: Task) -> None:
        from turgor.fidelity.box2d_v3 import Box2Dv3World

        n = task.body.mass_count
        self.box2d = Box2Dv3World(task, task.position)
        self.position, self.velocity, self.touch = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)

    def read(self) -> np.ndarray:
        self.box2d.read(self.position, self.velocity, self.touch)
        return np.concatenate([self.position, self.velocity], axis=1).T

    def advance(self, lengths: np.ndarray, force: np.ndarray) -> None:
        self.box2d.step(lengths, force.T)


def check_task(task: Task) -> None:
    """Raises `ValueError` for a task that this program does not cover."""
    if task.controller != Linear():
        raise ValueError("expected a linear controller")
    if task.condition != "pressure" or task.body.chamber_count != 1 or task.end is not None:
        raise ValueError("expected one chamber under control, and a task without an end")
    if len(task.body.chambers[0]) != task.body.mass_count or task.sensing.observation != "signed":
        raise ValueError("expected all masses around the chamber, and signed observations")


def rollout(task: Task, theta: np.ndarray, kind: type[Agent] = Agent) -> float:
    """Mean speed of the centre of mass [m/s] of one agent over the whole task."""
    agent = kind(task, theta)
    start = agent.read()[0] @ agent.share
    for _ in range(task.steps):
        agent.step()
    return float(agent.read()[0] @ agent.share - start) / task.duration


def trajectory(task: Task, theta: np.ndarray, steps: int, kind: type[Agent] = Agent) -> np.ndarray:
    """Positions [m], shape [step + 1, mass, 2], over the first `steps` steps."""
    agent = kind(task, theta)
    positions = [agent.read()[:2].T]
    for _ in range(steps):
        agent.step()
        positions.append(agent.read()[:2].T)
    return np.array(positions)


if __name__ == "__main__":
    _task = make_task("hilly", body=sys.argv[1] if len(sys.argv) > 1 else "large")
    _theta = np.random.default_rng(0).uniform(-1, 1, _task.parameter_count)
    _began = time.perf_counter()
    _speed = rollout(_task, _theta)
    _rate = _task.steps / (time.perf_counter() - _began)
    print(f"{_rate:,.0f} agent-steps/s, one agent on one core; it moved at {_speed:.3f} m/s")
