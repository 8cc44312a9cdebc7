"""CMA-ME by pyribs: an archive of gaits, by how inflated they are and how much they touch, and a map of it."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from matplotlib.figure import Figure
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter
from ribs.schedulers import Scheduler

import turgor

evaluations = int(sys.argv[1]) if len(sys.argv) > 1 else 3000
task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
simulator, n, size, ranges = turgor.Simulator(task), task.parameter_count, (14, 12), [(0.1, 1.5), (0.1, 0.7)]
archive = GridArchive(solution_dim=n, dims=size, ranges=ranges, seed=0)
starts = np.random.default_rng(0).uniform(-1, 1, (4, n))
how = {"sigma0": 0.5, "ranker": "2imp", "es": "sep_cma_es", "batch_size": 30}
scheduler = Scheduler(archive, [EvolutionStrategyEmitter(archive, x0=x, seed=k, **how) for k, x in enumerate(starts)])
with ThreadPoolExecutor() as pool:  # a recording has every step of its agent, and so what the measures need
    for _ in range(0, evaluations, 120):
        gaits = list(pool.map(simulator.record, scheduler.ask()))
        measures = [(gait.area_ratio.mean(), gait.touch.mean()) for gait in gaits]
        scheduler.tell([gait.fitness for gait in gaits], measures)

elites = archive.data()  # np.load("gaits.npz")["F7"] is the theta of the cell F7, for Simulator.record
cells = [(int(c), int(r), f"{'ABCDEFGHIJKLMN'[c]}{r + 1}") for c, r in archive.int_to_grid_index(elites["index"])]
np.savez("gaits.npz", **{name: theta for (_, _, name), theta in zip(cells, elites["solution"], strict=True)})
grid, edges = np.full(size[::-1], np.nan), archive.boundaries
axes = (figure := Figure(figsize=(11, 7), layout="constrained")).subplots()
for (c, r, name), fitness in zip(cells, elites["objective"], strict=True):
    grid[r, c], middle = fitness, (edges[0][c : c + 2].mean(), edges[1][r : r + 2].mean())
    color = "white" if fitness < elites["objective"].max() * 0.6 else "black"
    axes.annotate(f"{name}\n{fitness:z.1f}", middle, ha="center", va="center", size=8, color=color)
figure.colorbar(axes.pcolormesh(*edges, grid, edgecolors="white"), label="fitness of the cell's champion [m/s]")
axes.set(xlabel="mean area ratio [1]", ylabel="share of time in contact [1]", xticks=edges[0], yticks=edges[1])
axes.set_title(f"{len(cells)} gaits on hilly ground, from {evaluations:,} evaluations")
figure.savefig("gaits.png")
