"""Do champions of robust evolutions keep more of their fitness in other engines than those of plain ones?

./run python benchmarks/robust_champions.py > results/robust/champions.csv       # 45 evolutions, about 25 minutes

Evolves on five hilly terrains at every size, plain, `--robust` and `--robust --robust-keep worst`, 10,000 candidates
each, and runs the champions in every engine that is installed (extra `box2d`), from 30 starts moved by 1 mm. Prints
CSV: what the champion was chosen for (`best`), then medians [m/s]: in 100 changed worlds that no generation had
(`changed`), here, and in the other engines. The runs are kept in runs/robust; started again, it goes on from there.
`--sum FILE` sums up such a table.
"""

from __future__ import annotations

import argparse
import csv
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import turgor
from turgor.fidelity.compare import MOVED
from turgor.fidelity.engines import Crew, Job, installed, make_job
from turgor.runs import Run
from turgor.simulate import Simulator, perturbed

KINDS = {"plain": None, "median": turgor.Robust(), "worst": turgor.Robust(keep="worst")}
BODIES, EVALUATIONS, STARTS, WORLDS = ("small", "medium", "large"), 10_000, 30, 100
Case = tuple[str, int, str]  # body, seed, kind


def evolved(folder: Path, case: Case) -> Run:
    """The run of `case`, kept in `folder`."""
    body, seed, kind = case
    path = folder / f"hilly-{body}-pressure-s{seed}-{kind}"
    if path.exists():
        run = Run.open(path)
        return run if run.status == "done" else turgor.resume(run, threads=1)
    task = turgor.make_task("hilly", body=body, seed=seed)
    recipe = {"name": "hilly", "body": body, "condition": "pressure", "seed": seed}
    return turgor.evolve(task, EVALUATIONS, seed, path, threads=1, robust=KINDS[kind], recipe=recipe)


def jobs_of(run: Run, engines: list[str]) -> list[Job]:
    """The champion of `run` from moved starts in every other engine."""
    starts, theta = perturbed(run.task.position, STARTS, MOVED), run.checked_champion().theta
    return [make_job(engine, run.task, np.tile(theta, (STARTS, 1)), starts) for engine in engines]


def worth_here(run: Run, seed: int) -> dict[str, float]:
    """What the champion of `run` was chosen for, and what it is worth in changed worlds and from moved starts."""
    champion, simulator = run.checked_champion(), Simulator(run.task)
    worlds = turgor.draw_worlds(run.task, turgor.Robust(worlds=WORLDS), seed, 0)  # of no generation
    changed = [out.fitness[0] for out in simulator.rollout_in(worlds, champion.theta[None])]
    moved = simulator.rollout(np.tile(champion.theta, (STARTS, 1)), perturbed(run.task.position, STARTS, MOVED))
    return {
        "best": champion.fitness,
        "changed": float(np.median(changed)),
        "turgor": float(np.median(moved.fitness)),
    }


def measure(folder: Path, seeds: int, processes: int) -> None:
    """Evolves what is missing, and prints a row a champion."""
    cases, engines = list(product(BODIES, range(seeds), KINDS)), installed()
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        runs = dict(zip(cases, pool.map(evolved, [folder] * len(cases), cases), strict=True))
    writer = None
    with Crew(processes) as crew:
        answers = crew.run([job for run in runs.values() for job in jobs_of(run, engines)])
        for (body, seed, kind), run in runs.items():
            row = {"body": body, "seed": seed, "kind": kind, **worth_here(run, seed)}
            row |= {engine: float(np.median(next(answers).rollout.fitness)) for engine in engines}
            if writer is None:
                writer = csv.DictWriter(sys.stdout, row, lineterminator="\n")
                writer.writeheader()
            writer.writerow(row)
            sys.stdout.flush()


def sum_up(path: Path) -> None:
    """Prints medians of what is kept of `best`, and how often more is kept than by the plain champion of a terrain."""
    from scipy.stats import wilcoxon

    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    places = [name for name in rows[0] if name not in ("body", "seed", "kind", "best")]
    kept = {(r["body"], r["seed"], r["kind"], p): float(r[p]) / float(r["best"]) for r in rows for p in places}
    worth = {(r["body"], r["seed"], r["kind"], p): float(r[p]) for r in rows for p in places}
    print("kind,place,median worth,median kept,keeps more than plain,p,worth more than plain,p")
    for kind, place in product(KINDS, places):
        mine = [key for key in kept if key[2:] == (kind, place)]
        plain = [(*key[:2], "plain", place) for key in mine]
        cells = [f"{np.median([worth[k] for k in mine]):.2f}", f"{np.median([kept[k] for k in mine]):.0%}"]
        if kind != "plain":
            for what in (kept, worth):
                more = np.array([what[k] - what[p] for k, p in zip(mine, plain, strict=True)])
                cells += [f"{int((more > 0).sum())} of {len(more)}", f"{wilcoxon(more).pvalue:.2g}"]
        print(",".join([kind, place, *cells]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/robust"), metavar="FOLDER")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="terrains (default: 5)")
    parser.add_argument("--processes", type=int, default=2, metavar="N")
    parser.add_argument("--sum", type=Path, metavar="FILE", help="sum up a table instead")
    options = parser.parse_args()
    if options.sum is not None:
        sum_up(options.sum)
    else:
        measure(options.runs, options.seeds, options.processes)


if __name__ == "__main__":
    main()
