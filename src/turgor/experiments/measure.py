"""Measurements: what a champion is worth, from its own start and from starts moved by a millionth of a metre."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from turgor.evolution.loop import evaluate
from turgor.experiments.plan import Entry
from turgor.experiments.rows import Champion, Start
from turgor.recording import tangled
from turgor.runs import Run
from turgor.simulate import Simulator

STARTS = 30


class Measured(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """An entry of a campaign and what came of it."""

    entry: Entry
    champion: Champion
    starts: list[Start]
    theta: Any  # float64 [parameter]
    evaluations: Any  # [generation]; of a passive body: empty
    best: Any  # [generation], so far
    seconds: dict[str, float]  # where the time of the run went
    versions: dict[str, str]  # that it was made with


def measure(entry: Entry, run: Run | None) -> Measured:
    """The champion of `run`, or the passive body of `entry`, run again from its own start and from `STARTS` others."""
    task = entry.make_judge()
    theta = np.zeros(0) if run is None else run.checked_champion().theta
    simulator = Simulator(task, threads=1)
    own = simulator.record(theta)
    out = evaluate(simulator, theta, STARTS)
    escapes = out.solved if task.end is not None else None
    around = tangled(out.position, task.body, task.scene)
    seconds = out.steps * task.physics.dt
    low, median, high = np.percentile(out.fitness, [25, 50, 75]).tolist()
    champion = Champion(
        run=entry.name,
        question=entry.question,
        task=entry.task,
        body=entry.body,
        condition=entry.condition,
        change=entry.change,
        seed=entry.seed,
        evaluations=0 if run is None else run.evaluations,
        generation=None if run is None else run.checked_champion().generation,
        best=float(own.fitness) if own.fitness is not None else 0.0,
        robust=median,
        robust_low=low,
        robust_high=high,
        starts=STARTS,
        solved=None if escapes is None else own.solved,
        solved_starts=None if escapes is None else int(escapes.sum()),
        escape_time=None if escapes is None or not escapes.any() else float(np.median(seconds[escapes])),
        tangled_starts=int(around.sum()),
        tangled_steps=int(own.tangled.sum()),
        steps=own.steps,
    )
    starts = [
        Start(
            run=entry.name,
            start=k,
            fitness=float(out.fitness[k]),
            solved=None if escapes is None else bool(escapes[k]),
            time=float(seconds[k]),
            tangled=bool(around[k]),
        )
        for k in range(STARTS)
    ]
    history = {"evaluations": np.zeros(0), "best": np.zeros(0)} if run is None else run.history
    return Measured(
        entry=entry,
        champion=champion,
        starts=starts,
        theta=theta,
        evaluations=history["evaluations"],
        best=history["best"],
        seconds={} if run is None else run.seconds,
        versions={} if run is None else run.versions,
    )
