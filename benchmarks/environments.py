"""Million agent-steps a second through Gymnasium's interface, measured with its own `benchmark_vector_step`.

    ./run python benchmarks/environments.py [--seconds 5] [--repeats 3]

Cases are run in turn, and of every case the fastest repeat counts.
"""

import argparse

import gymnasium
from gymnasium.utils.performance import benchmark_vector_step

import turgor  # noqa: F401 - registers the environments

CASES = {
    "Hilly, small, 1024": ("turgor/Hilly-v0", 1024, {}),
    "Hilly, small, 1024, SameStep, copy=False": (
        "turgor/Hilly-v0",
        1024,
        {"autoreset_mode": "SameStep", "copy": False},
    ),
    "Flat, small, 1024": ("turgor/Flat-v0", 1024, {}),
    "Hilly, medium, 1024": ("turgor/Hilly-v0", 1024, {"body": "medium"}),
    "Hilly, large, 1024": ("turgor/Hilly-v0", 1024, {"body": "large"}),
    "Hilly, small, 64": ("turgor/Hilly-v0", 64, {}),
    "Hilly, small, 16, Gymnasium's sync": ("turgor/Hilly-v0", 16, {"vectorization_mode": "sync"}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, default=5, help="of each measurement (default: 5)")
    parser.add_argument("--repeats", type=int, default=3, help="of each case (default: 3)")
    options = parser.parse_args()
    best = dict.fromkeys(CASES, 0.0)
    for _ in range(options.repeats):
        for case, (name, num_envs, keywords) in CASES.items():
            envs = gymnasium.make_vec(name, num_envs=num_envs, **keywords)
            best[case] = max(best[case], benchmark_vector_step(envs, target_duration=options.seconds, seed=0))
    for case, rate in best.items():
        print(f"{case:45}{rate / 1e6:8.3f}")


if __name__ == "__main__":
    main()
