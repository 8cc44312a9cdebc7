"""A body, a scene and a task of your own: two chambers of gas that shall climb a step, fast and without bouncing."""

import numpy as np

import turgor
from turgor.scene import polyline

# two hexagons of gas that share an edge: masses, springs and chambers are lists, a ring is one body among others
corner = np.pi / 3 * (np.arange(6) + 0.5)
hexagon = 4.0 * np.stack([np.cos(corner), np.sin(corner)], axis=1)
left, right = hexagon - [hexagon[0, 0], 0], hexagon + [hexagon[0, 0], 0]
position = np.concatenate([left, right[[0, 1, 4, 5]]])  # masses 0 and 5 are shared
chambers = [[0, 1, 2, 3, 4, 5], [6, 7, 0, 5, 8, 9]]
springs = sorted({tuple(sorted((loop[i - 1], loop[i]))) for loop in chambers for i in range(6)})
body = turgor.Body(position=position, springs=springs, chambers=chambers, gas_amount=900.0)

scene = polyline(np.array([[-20, 0], [12, 0], [13, 1.5], [60, 1.5]]), friction=0.5)


def climbed(position):  # [agent, mass, 2]: has every mass passed the step?
    return position[:, :, 0].min(axis=1) > 13.0


def fitness(out):  # progress in m/s until the end, and a prize for what is saved of the 10 seconds
    return (out.com[:, 0] - out.start[:, 0]) / 10.0 + np.where(out.solved, 5.0 * (1 - out.steps / 600), 0.0)


task = turgor.Task(
    name="step", body=body, scene=scene, position=turgor.resting(body), steps=600, fitness=fitness, end=climbed
)
run = turgor.evolve(task, evaluations=200, seed=1)
print(f"{task.parameter_count} parameters; best {run.champion.fitness:.2f}, robust {run.champion.robust_fitness:.2f}")
