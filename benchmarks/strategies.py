"""Compares the built-in strategies on hilly ground: what they cost a generation, and what came out of evolutions.

./run python benchmarks/strategies.py                  # time of a generation: about a minute
./run python benchmarks/strategies.py --seeds 5        # and evolutions of 10,000 evaluations, two at a time

Prints CSV: kind, body, strategy, seed, evaluations, value, robust. `ask+tell` [ms] is the mean of a generation of the
strategy alone, one thread; `evolve` [m/s] the best fitness and the median of 30 perturbed starts of it.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np

import turgor
from turgor.evolution import STRATEGIES
from turgor.evolution.strategy import built_in

BODIES = ("small", "medium", "large")
EVALUATIONS = 10_000
Row = tuple[str, str, str, object, object, float, object]


def ask_and_tell(body: str, name: str) -> Row:
    """Milliseconds of a generation, without any simulation: the fitness is one parameter's distance from 0."""
    task = turgor.make_task("hilly", body=body)
    strategy = built_in(name)(task.parameter_count, np.random.default_rng(0))
    seconds = []
    for _ in range(150):
        began = time.perf_counter()
        theta = strategy.ask()
        asked = time.perf_counter()
        fitness = -np.abs(theta[:, 0])
        told = time.perf_counter()
        strategy.tell(theta, fitness)
        seconds.append(time.perf_counter() - told + asked - began)
    # a mean, because CMA-ES decomposes its covariance in some generations only; the first ones load and warm up
    return ("ask+tell", body, name, "", "", 1e3 * float(np.mean(seconds[30:])), "")


def evolved(job: tuple[str, str, int]) -> Row:
    """What came out of one evolution."""
    body, name, seed = job
    task = turgor.make_task("hilly", body=body, seed=seed)
    champion = turgor.evolve(task, EVALUATIONS, seed, strategy=name, threads=1).checked_champion()
    return ("evolve", body, name, seed, EVALUATIONS, champion.fitness, champion.robust_fitness)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=0, metavar="N", help="evolutions of each kind (default: 0)")
    parser.add_argument("--body", nargs="+", default=list(BODIES), choices=BODIES)
    parser.add_argument("--processes", type=int, default=2, metavar="N")
    options = parser.parse_args()
    print("kind,body,strategy,seed,evaluations,value,robust", flush=True)
    for body in options.body:
        for name in STRATEGIES:
            print(*ask_and_tell(body, name), sep=",", flush=True)
    jobs = [(body, name, seed) for seed in range(options.seeds) for body in options.body for name in STRATEGIES]
    with ProcessPoolExecutor(options.processes) as pool:
        for row in pool.map(evolved, jobs):
            print(*row, sep=",", flush=True)


if __name__ == "__main__":
    main()
