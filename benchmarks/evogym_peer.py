"""Robots of EvoGym with controllers like the paper's: one after the other on one core, as fast as its interface allows.

    python benchmarks/evogym_peer.py [large|small] [plane|Walker-v0]     prints how fast they are

Runs in any Python that has the package `evogym` (2.0.0 is for Python 3.7 to 3.10), and needs nothing of turgor. With
--serve it waits: every line on its input is answered by one turn, all robots from start to end, timed by itself, so
that `turgor bench --evogym PYTHON` can take turns with it and its start does not count.

A robot is a grid of voxels: masses at their corners, springs on their edges and diagonals, every voxel an actuator,
horizontal and vertical ones in turn. There is no gas. The nearest to turgor's bodies in the number of masses are

    large (20 masses, 20 springs)    4 x 3 voxels: 20 masses, 55 springs, 12 actuators
    small (10 masses, 10 springs)    4 x 1 voxels: 10 masses, 21 springs,  4 actuators

Controllers are linear with a tanh, of the mean of the last 25 observations, as turgor's are. They observe what EvoGym's
own walking task does: where the masses are around their centre, and how fast the centre moves. Touch is not told.

Worlds: "plane" is the ground that is part of EvoGym's physics and costs it next to nothing; "Walker-v0" that of its
walking task, 100 fixed voxels, which are simulated as the robot is: EvoGym integrates every mass there is.

A step is 30 Runge-Kutta steps (RK4) of 0.0001 s: `physics_updates_per_step` in EvoGym's Sim.cpp, `step_rk4` in its
Environment.cpp. These seconds are not those of the world: voxels are 0.1 wide, a mass weighs 1, gravity is 110, and its
authors say that the numbers have no units (https://github.com/EvolutionGym/evogym/issues/49).

EvoGym's class Sim is called directly, without the checks of EvoSim and without Gymnasium; nothing is drawn.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from importlib import metadata

import evogym
import numpy as np
from evogym.simulator_cpp import Sim

ROBOTS = {"large": (4, 3), "small": (4, 1)}  # voxels: columns, rows
WORLDS = ("plane", "Walker-v0")
VOXEL = 0.1  # [its unit of length]: a voxel's side
GRAVITY = 110.0  # [its units]
STEP = 30 * 0.0001  # [its unit of time]: 30 Runge-Kutta steps
WINDOW = 25  # observations whose mean is taken
POSITION, VELOCITY = 1.75 * 2 * VOXEL, 2.0  # observations are divided by: 1.75 times half a robot's length, and a speed
MIDDLE, REACH = 1.1, 0.5  # actions: 0.6 to 1.6 times a voxel's side, EvoGym's own limits


class Robots:
    """A robot in its world, which one controller after the other moves."""

    def __init__(self, body: str, world: str) -> None:
        columns, rows = self.voxels = ROBOTS[body]
        self.sim = evogym.EvoSim(lay_out(columns, rows, world))
        self.actuators = self.sim.get_actuator_indices("robot")
        self.masses = Sim.object_pos_at_time(self.sim, 0, "robot").shape[1]
        self.springs = columns * (rows + 1) + rows * (columns + 1) + 2 * columns * rows  # edges, and two diagonals each

    def draw(self, controllers: int) -> np.ndarray:
        """Weights uniform in [-1, 1], the bias last, shape [controller, actuator, observation + 1]."""
        shape = (controllers, len(self.actuators), 2 * self.masses + 3)
        return np.random.default_rng(0).uniform(-1, 1, shape)

    def rollout(self, theta: np.ndarray, steps: int) -> tuple[float, int, float]:
        """Seconds in EvoGym's simulator; the steps taken, fewer where it tells that its robot has become unstable; how
        far the centre has come, in voxels."""
        sim, clock, n = self.sim, time.perf_counter, self.masses
        weight, bias = np.ascontiguousarray(theta[:, :-1]), theta[:, -1]
        command = np.column_stack([self.actuators, np.ones(len(self.actuators))])
        window, total = np.zeros((WINDOW, 2 * n + 2)), np.zeros(2 * n + 2)
        sim.revert(0)
        start, inside = Sim.object_pos_at_time(sim, 0, "robot")[0].mean(), 0.0
        for step in range(steps):
            observation = window[step % WINDOW]
            total -= observation
            position = Sim.object_pos_at_time(sim, step, "robot")
            velocity = Sim.object_vel_at_time(sim, step, "robot")
            observation[:-2] = ((position - position.mean(axis=1)[:, None]) / POSITION).ravel()
            observation[-2:] = velocity.mean(axis=1) / VELOCITY
            np.minimum(np.maximum(observation, -1, out=observation), 1, out=observation)
            total += observation
            command[:, 1] = MIDDLE + REACH * np.tanh(weight @ (total / min(step + 1, WINDOW)) + bias)
            Sim.set_action(sim, "robot", command)
            began = clock()
            unstable = Sim.step(sim)
            inside += clock() - began
            if unstable:
                break
        moved = Sim.object_pos_at_time(sim, Sim.get_time(sim), "robot")[0].mean() - start
        return inside, step + 1, float(moved) / VOXEL

    def turn(self, thetas: np.ndarray, steps: int) -> dict:
        """All controllers from start to end: seconds, those of them in EvoGym's simulator, the steps that were taken,
        and how far each robot has come."""
        began = time.perf_counter()
        done = [self.rollout(theta, steps) for theta in thetas]
        seconds = time.perf_counter() - began
        inside, taken = sum(one[0] for one in done), sum(one[1] for one in done)
        return {"seconds": seconds, "simulator": inside, "steps": taken, "voxels": [one[2] for one in done]}

    def facts(self) -> dict:
        """What there is to tell of the robot."""
        return {
            "robot": "{} x {} voxels".format(*self.voxels),
            "masses": self.masses,
            "springs": self.springs,
            "actuators": len(self.actuators),
            "masses_in_world": Sim.pos_at_time(self.sim, 0).shape[1],
            "step": STEP,
            "fall": (2 * VOXEL / GRAVITY) ** 0.5,
            "version": version(),
        }


def version() -> str:
    """EvoGym's version, that of a fork with its name."""
    for package in ("evogym", "evogym-py313"):
        try:
            told = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
        return told if package == "evogym" else f"{told} ({package})"
    return "of unknown version"


def lay_out(columns: int, rows: int, world: str) -> evogym.EvoWorld:
    """The world with its robot, which stands where EvoGym's walking task has it."""
    types = [evogym.VOXEL_TYPES["H_ACT"], evogym.VOXEL_TYPES["V_ACT"]]
    robot = np.array([[types[(x + y) % 2] for x in range(columns)] for y in range(rows)])
    if world == "plane":
        made = evogym.EvoWorld()
    else:
        folder = os.path.join(os.path.dirname(evogym.__file__), "envs", "sim_files")
        made = evogym.EvoWorld.from_json(os.path.join(folder, world + ".json"))
    made.add_from_array("robot", robot, 1, 0 if world == "plane" else 1)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description="Robots of EvoGym, one after the other on one core.")
    parser.add_argument("body", nargs="?", choices=sorted(ROBOTS), default="large")
    parser.add_argument("world", nargs="?", choices=WORLDS, default="plane")
    parser.add_argument("--robots", type=int, default=2, help="controllers, one after the other")
    parser.add_argument("--steps", type=int, default=600, help="of each")
    parser.add_argument("--serve", action="store_true", help="facts, then a turn for every line of input, as JSON")
    given = parser.parse_args()
    out = own_output()
    robots = Robots(given.body, given.world)
    thetas = robots.draw(given.robots)
    robots.turn(thetas, min(given.steps, 10))  # what is slow the first time
    if given.serve:
        print(json.dumps(robots.facts()), file=out, flush=True)
        for _ in sys.stdin:
            print(json.dumps(robots.turn(thetas, given.steps)), file=out, flush=True)
        return
    told = robots.turn(thetas, given.steps)
    rate, share = told["steps"] / told["seconds"], told["simulator"] / told["seconds"]
    line = "{:,.0f} agent-steps/s, {:.0%} of the time in EvoGym's simulator; {:.2f} s of its time a second; {}"
    print(line.format(rate, share, rate * STEP, json.dumps(robots.facts())), file=out)


def own_output():
    """The output that was stdout. What EvoGym's C++ prints goes to stderr from now on."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return out


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
