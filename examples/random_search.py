"""A strategy of your own, plain random search, beside CMA-ES: it is asked, told, paused and resumed like any other."""

import numpy as np

import turgor


class RandomSearch:
    """Uniform draws from [-1, 1], whatever came of those before."""

    name, population, sigma = "random-search", 25, 1.0

    def __init__(self, parameter_count, rng):
        self.parameter_count, self.seed, self.generation = parameter_count, int(rng.integers(2**62)), 0

    def ask(self):  # a generator for each generation, so that its number is all the state there is
        rng = np.random.default_rng([self.seed, self.generation])
        return rng.uniform(-1, 1, (self.population, self.parameter_count))

    def tell(self, theta, fitness):  # a search that learns would do it here, from the fitness: the higher the better
        self.generation += 1

    def state(self):
        return {"seed": np.array(self.seed), "generation": np.array(self.generation)}

    def restore(self, state):
        self.seed, self.generation = int(state["seed"]), int(state["generation"])


task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
for strategy in (RandomSearch, "cma-es"):
    run = turgor.evolve(task, evaluations=1000, seed=0, strategy=strategy)
    best, robust = run.champion.fitness, run.champion.robust_fitness
    print(f"{run.settings.strategy:<14}best {best:.2f} m/s; median of 30 perturbed starts {robust:.2f} m/s")
