"""Learning curves of PPO beside those of CMA-ES, at equal numbers of agent-steps.

    for seed in 0 1 2; do
        ./run python examples/train_ppo.py --task Flat --seed $seed --out flat-$seed.csv
        ./run python examples/train_ppo.py --task Hilly --terrain 0 --seed $seed --out hilly-$seed.csv
    done
    ./run python benchmarks/learning_curves.py *-?.csv --csv curves.csv --figure curves.png

PPO's fitness is the mean of the episodes that ended in an update, exploration included. CMA-ES's are the best so far
and the median of the generation; it evolves the paper's linear controller, 1800 steps an evaluation.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

import turgor

ROWS = 60  # of a curve


def ppo(path: Path) -> list[tuple[str, str, int, int, float]]:
    """Rows (task, method, seed, steps, fitness) of a file TASK-SEED.csv by examples/train_ppo.py."""
    task, seed = path.stem.rsplit("-", 1)
    steps, fitness = np.loadtxt(path, delimiter=",", skiprows=1, unpack=True, ndmin=2)
    return [
        (task, "ppo", int(seed), int(part[-1]), float(mean.mean()))
        for part, mean in zip(np.array_split(steps, ROWS), np.array_split(fitness, ROWS), strict=True)
    ]


def cma_es(task: str, seed: int, steps: int) -> list[tuple[str, str, int, int, float]]:
    """The same of an evolution with CMA-ES that takes as many steps."""
    run = turgor.evolve(turgor.make_task(task, seed=0), steps // 1800, seed)
    history = run.history
    kept = np.unique(np.linspace(0, len(history["best"]) - 1, ROWS).astype(int))
    return [
        (task, f"cma-es {name}", seed, int(1800 * history["evaluations"][k]), float(history[name][k]))
        for name in ("best", "median")
        for k in kept
    ] + [(task, "cma-es robust", seed, int(1800 * history["evaluations"][-1]), run.champion.robust_fitness)]


def draw(rows: list[tuple[str, str, int, int, float]], path: Path) -> None:
    """One panel a task; a thin line a run, a thick one the median of the runs."""
    from matplotlib.figure import Figure

    tasks = sorted({row[0] for row in rows})
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    colours = {"cma-es best": "#1b6ca8", "cma-es median": "#7fb3d5", "ppo": "#d1495b"}
    names = {"cma-es best": "CMA-ES, best so far", "cma-es median": "CMA-ES, median of a generation", "ppo": "PPO"}
    for axes, task in zip(figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0], tasks, strict=True):
        for method, colour in colours.items():
            of_method = [row for row in rows if row[:2] == (task, method)]
            curves = []
            for seed in sorted({row[2] for row in of_method}):
                steps, fitness = zip(*[row[3:] for row in of_method if row[2] == seed], strict=True)
                axes.plot(np.array(steps) / 1e6, fitness, color=colour, alpha=0.35, linewidth=0.8)
                curves.append((steps, fitness))
            grid = np.linspace(max(c[0][0] for c in curves), min(c[0][-1] for c in curves), 200)
            median = np.median([np.interp(grid, *curve) for curve in curves], axis=0)
            axes.plot(grid / 1e6, median, color=colour, linewidth=2, label=names[method])
        axes.set(title=f"small body, {task}", xlabel="million agent-steps")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.2)
        axes.set_xlim(0)
    figure.axes[0].set_ylabel("fitness [m/s]")
    figure.axes[-1].legend(frameon=False, loc="center right", bbox_to_anchor=(1.0, 0.45))
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ppo", type=Path, nargs="+", help="TASK-SEED.csv, by examples/train_ppo.py")
    parser.add_argument("--csv", type=Path, default=Path("curves.csv"))
    parser.add_argument("--figure", type=Path, default=Path("curves.png"))
    options = parser.parse_args()
    rows = [row for path in options.ppo for row in ppo(path)]
    for task, seed in sorted({(row[0], row[2]) for row in rows}):
        steps = max(row[3] for row in rows if (row[0], row[2]) == (task, seed))
        rows += cma_es(task, seed, steps)
        print(f"{task}, seed {seed}: CMA-ES done", flush=True)
    with open(options.csv, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows(
            [("task", "method", "seed", "steps", "fitness"), *(row[:4] + (round(row[4], 4),) for row in rows)]
        )
    draw(rows, options.figure)
    for task in sorted({row[0] for row in rows}):
        for method in ("cma-es best", "cma-es median", "cma-es robust", "ppo"):
            last = {row[2]: row[4] for row in rows if row[:2] == (task, method)}
            print(f"{task:8}{method:16}", "  ".join(f"{value:6.2f}" for value in last.values()))


if __name__ == "__main__":
    main()
