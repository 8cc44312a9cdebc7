"""Evolve one small network for every mass of a small body, then let it drive medium and large ones, untrained."""

import sys

import numpy as np

import turgor

evaluations = int(sys.argv[1]) if len(sys.argv) > 1 else 500  # 10,000 to see it run
task = turgor.make_task("hilly", body="small", controller="distributed", seed=0)
run = turgor.evolve(task, evaluations, seed=0)
print(f"{task.parameter_count} parameters, evolved on small: {run.champion.robust_fitness:.2f} m/s")

for body in ("medium", "large"):
    # the same theta fits, because no parameter belongs to a mass
    other = turgor.make_task("hilly", body=body, controller="distributed", seed=0)
    simulator = turgor.Simulator(other)
    fitness = turgor.evaluate(simulator, run.champion.theta).fitness  # 30 starts moved by a millionth of a metre
    random = np.random.default_rng(0).uniform(-1, 1, (100, other.parameter_count))
    chance = simulator.rollout(random).fitness
    print(f"on {body}, untrained: {np.median(fitness):.2f} m/s; random networks {np.median(chance):.2f} m/s")
