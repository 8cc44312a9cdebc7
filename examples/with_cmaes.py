"""Evolve with the cmaes package: whatever can be asked and told fits around `Simulator.rollout`."""

import cmaes
import numpy as np

import turgor

task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
simulator = turgor.Simulator(task)
mean = np.random.default_rng(0).uniform(-1, 1, task.parameter_count)
optimizer = cmaes.SepCMA(mean=mean, sigma=0.5, seed=0)  # or cmaes.CMA, the full covariance

champion, best = mean, -np.inf
for _ in range(40):
    theta = np.array([optimizer.ask() for _ in range(optimizer.population_size)])
    fitness = simulator.rollout(theta).fitness  # the whole generation at once: that is what is fast
    optimizer.tell([(t, -f) for t, f in zip(theta, fitness, strict=True)])  # cmaes minimises
    if fitness.max() > best:
        champion, best = theta[fitness.argmax()], fitness.max()

robust = np.median(turgor.evaluate(simulator, champion).fitness)
print(f"best of {40 * len(theta)}: {best:.2f} m/s; median of 30 perturbed starts {robust:.2f} m/s")
