"""Simulate a hundred random controllers at once, and look at the best one step by step."""

import numpy as np

import turgor

task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
simulator = turgor.Simulator(task)

theta = np.random.default_rng(0).uniform(-1, 1, (100, task.parameter_count))
out = simulator.rollout(theta)
best = out.fitness.argmax()
print(f"best of 100: {out.fitness[best]:.2f} m/s, median {np.median(out.fitness):.2f} m/s")

recording = simulator.record(theta[best])
print(f"{recording.steps} steps, from x = {recording.com[0, 0]:.1f} m to {recording.com[-1, 0]:.1f} m")
print(f"area ratio {recording.area_ratio.min():.2f} to {recording.area_ratio.max():.2f}")
print(f"pressure {recording.pressure.min() / 1e3:.1f} to {recording.pressure.max() / 1e3:.1f} kPa")
