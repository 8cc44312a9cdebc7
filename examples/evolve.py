"""Evolve a controller, then see how much of its fitness was luck."""

import numpy as np

import turgor

task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
run = turgor.evolve(task, evaluations=500, seed=0)

simulator = turgor.Simulator(task)
starts = turgor.perturbed(task.position, repeats=30)  # one mass moved by a millionth of a metre
fitness = simulator.rollout(np.repeat(run.champion.theta[None], 30, axis=0), position=starts).fitness
print(f"champion {run.champion.fitness:.2f} m/s; from 30 perturbed starts: median {np.median(fitness):.2f} m/s")

# the same without its controller: a start on a slope may roll by itself
passive = turgor.Simulator(turgor.make_task("hilly", body="small", condition="passive", seed=0))
print(f"passive body {passive.rollout(np.zeros((1, 0))).fitness[0]:.2f} m/s")
