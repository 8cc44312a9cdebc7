"""How fast every controller runs beside the linear one: `python benchmarks/controllers.py`, about ten minutes.

Rollouts of 1800 steps on hilly ground, one thread, all controllers in turn, the fastest of several. "still": theta 0,
so that all bodies do the same and the controllers' own cost is compared. "moving": theta is uniform in [-1, 1] and
pressure moves by 1 Pa per unit of output, so that bodies keep their gas; each controller moves them in its own way,
and the more masses touch each other, the more a step costs.
"""

import argparse

import numpy as np

from turgor.bench.measuring import fastest
from turgor.control import CONTROLLERS
from turgor.simulate import Simulator
from turgor.task import make_task


def rollouts(body, agents, scale):
    """A function for each controller that runs `agents` agents, theta uniform within +-`scale`."""
    calls = []
    for controller in CONTROLLERS:
        task = make_task("hilly", body=body, controller=controller, pressure_unit=1.0)
        simulator = Simulator(task, threads=1)
        theta = np.random.default_rng(0).uniform(-scale, scale, (agents, task.parameter_count))
        calls.append(lambda simulator=simulator, theta=theta: simulator.rollout(theta))
    return calls


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--repeats", type=int, default=7)
parser.add_argument("--seconds", type=float, default=3.0, help="of measuring each, at least")
options = parser.parse_args()

print("million agent-steps/s on one thread (relative to linear)")
print(f"{'body':<7}{'agents':>7}  {'theta':<7}", *(f"{name:>15}" for name in CONTROLLERS))
for body in ("small", "large"):
    for agents in (20, 1024):
        for motion, scale in (("still", 0.0), ("moving", 1.0)):
            times = fastest(rollouts(body, agents, scale), options.seconds, options.repeats)
            cells = (f"{agents * 1800 / t / 1e6:7.2f} ({times[0] / t:.2f})" for t in times)
            print(f"{body:<7}{agents:>7}  {motion:<7}", *(f"{cell:>15}" for cell in cells), flush=True)
