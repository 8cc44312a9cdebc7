"""Controllers in many engines: random ones, and the champions of a campaign, against Box2D 2.3 and against the floor.

The floor is what is left of an engine's agreement with itself when starts are moved by 1e-6 m: no other engine can be
expected to agree better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from turgor.experiments.plan import BODIES, CONDITIONS, Entry
from turgor.experiments.statistics import median_difference
from turgor.fidelity.compare import CONTROLLERS, HERE, kolmogorov_smirnov, rank_correlation
from turgor.fidelity.engines import Crew, Job, make_job
from turgor.rollout import Rollout
from turgor.runs import Run
from turgor.simulate import Simulator, perturbed
from turgor.task import Task, make_task
from turgor.variants import Condition

BOX2D = "box2d"  # that everything is compared with
AGAIN = " again"  # an engine from moved starts; of champions: from other moved starts
STARTS = 30
NEEDLE = 1e-6  # [m], by which starts are moved: most meet the same accidents, by which engines differ and one does not
WIDE = 1e-3  # [m]: enough for accidents of their own
RESAMPLES = 10_000

Progress = Callable[[int, int], object]


class Ranked(msgspec.Struct, frozen=True, kw_only=True):
    """Random controllers in one engine, compared with another (or itself)."""

    task: str
    body: str
    condition: str
    engine: str
    against: str
    rank: float | None  # Spearman's correlation
    ks: float  # Kolmogorov's and Smirnov's distance [1]
    ks_p: float
    mean: float  # difference of the mean fitness [m/s]: engine - against
    sd: float  # of the fitness in `against` [m/s]
    median: float  # difference of the medians [m/s]
    low: float  # ends of its 95 % interval
    high: float


class Crossed(msgspec.Struct, frozen=True, kw_only=True):
    """A champion from starts that are `moved` [m] in one engine, compared with Box2D 2.3."""

    task: str
    body: str
    condition: str
    seed: int
    moved: float
    engine: str
    lower: float  # quartiles of its fitness [m/s]
    median: float
    upper: float
    box2d: float  # median in Box2D 2.3 [m/s]
    difference: float  # of the medians: engine - Box2D 2.3
    low: float  # ends of its 95 % interval
    high: float
    floor_low: float  # ends of the interval that holds 95 % of Box2D 2.3's differences from itself
    floor_high: float
    ks: float
    ks_p: float
    solved: int | None  # starts, of 30
    solved_box2d: int | None

    @property
    def inside(self) -> bool:
        """Whether the difference is one that Box2D 2.3 has from itself."""
        return self.floor_low <= self.difference <= self.floor_high


# --- random controllers -------------------------------------------------------------------------------------------


def random_cells() -> list[tuple[str, str, Condition]]:
    """Task, body and condition of each set of random controllers."""
    return [(task, body, c) for task in ("hilly", "escape") for body in BODIES for c in CONDITIONS if c != "passive"]


def ranked_rows(engines: Sequence[str], crew: Crew, progress: Progress | None = None) -> list[Ranked]:
    """60 random controllers of every cell, seed 0, in every engine."""
    cells = [(*cell, make_task(cell[0], body=cell[1], condition=cell[2])) for cell in random_cells()]
    jobs: list[Job] = []
    for *_, task in cells:
        theta, moved = _random(task), _moved(task)
        jobs += [make_job(engine, task, theta) for engine in engines]
        jobs.append(make_job(BOX2D, task, theta, moved))
    answers = crew.run(jobs, progress)
    rows = []
    for name, body, condition, task in cells:
        theta, simulator = _random(task), Simulator(task)
        fitness = {HERE: simulator.rollout(theta).fitness, HERE + AGAIN: simulator.rollout(theta, _moved(task)).fitness}
        for engine in [*engines, BOX2D + AGAIN]:
            fitness[engine] = next(answers).rollout.fitness
        for engine, against in _pairs(engines):
            a, b = np.asarray(fitness[against]), np.asarray(fitness[engine])
            ks, p = kolmogorov_smirnov(a, b)
            median, low, high = median_difference(a, b)
            rows.append(
                Ranked(
                    task=name,
                    body=body,
                    condition=condition,
                    engine=engine,
                    against=against,
                    rank=rank_correlation(a, b),
                    ks=ks,
                    ks_p=p,
                    mean=float(b.mean() - a.mean()),
                    sd=float(a.std(ddof=1)),
                    median=median,
                    low=low,
                    high=high,
                )
            )
    return rows


def _pairs(engines: Sequence[str]) -> list[tuple[str, str]]:
    """Which engines are compared: each with itself, all with Box2D 2.3."""
    others = [engine for engine in engines if engine != BOX2D]
    floors = [(BOX2D + AGAIN, BOX2D), (HERE + AGAIN, HERE)]
    return [(HERE, BOX2D), *floors, *((engine, BOX2D) for engine in others)]


def _random(task: Task) -> np.ndarray:
    """Controllers with numbers uniform in [-1, 1], [controller, parameter]."""
    return np.random.default_rng(0).uniform(-1, 1, (CONTROLLERS, task.parameter_count))


def _moved(task: Task) -> np.ndarray:
    return perturbed(task.position, CONTROLLERS)


# --- champions ----------------------------------------------------------------------------------------------------


def champions(campaign: Path) -> Iterator[tuple[Entry, Task, np.ndarray]]:
    """Entry, task and theta of every champion of the paper preset in `campaign`, on hills and in the cage."""
    for task, body, condition in random_cells():
        for path in sorted(campaign.glob(f"{task}-{body}-{condition}-s*/run.json")):
            run = Run.open(path.parent)
            seed, evaluations = run.settings.seed, run.settings.evaluations
            entry = Entry(task=task, body=body, condition=condition, seed=seed, evaluations=evaluations)
            usual = entry.name == path.parent.name and entry.make_task().identity == run.task.identity
            if usual and run.champion is not None and run.settings.robust is None:
                yield entry, run.task, run.champion.theta


def crossed_rows(campaign: Path, engines: Sequence[str], crew: Crew, progress: Progress | None = None) -> list[Crossed]:
    """Every champion from 30 starts moved by 1 mm in every engine, and from 30 others in Box2D 2.3; here and in Box2D
    2.3 from starts moved by 1e-6 m, too."""
    cases = [
        (entry, task, theta, moved, engines if moved == WIDE else [BOX2D])
        for entry, task, theta in champions(campaign)
        for moved in (NEEDLE, WIDE)
    ]
    jobs: list[Job] = []
    for _, task, theta, moved, among in cases:
        for engine in among:
            starts = perturbed(task.position, 2 * STARTS if engine == BOX2D else STARTS, moved)
            jobs.append(make_job(engine, task, np.tile(theta, (len(starts), 1)), starts))
    answers = crew.run(jobs, progress)
    rows = []
    for entry, task, theta, moved, among in cases:
        starts = perturbed(task.position, STARTS, moved)
        outs = {HERE: Simulator(task).rollout(np.tile(theta, (STARTS, 1)), starts)}
        outs |= {engine: next(answers).rollout for engine in among}
        rows += [_crossed(entry, task, moved, engine, out, outs[BOX2D]) for engine, out in outs.items()]
    return rows


def _crossed(entry: Entry, task: Task, moved: float, engine: str, out: Rollout, box2d: Rollout) -> Crossed:
    """The row of `engine`; of Box2D 2.3 itself, its second 30 starts against its first."""
    first, second = slice(0, STARTS), slice(STARTS, 2 * STARTS)
    mine = second if engine == BOX2D else first
    a, b = np.asarray(box2d.fitness[first]), np.asarray(out.fitness[mine])
    lower, median, upper = np.percentile(b, [25, 50, 75]).tolist()
    difference, low, high = median_difference(a, b)
    floor_low, floor_high = floor_of(np.asarray(box2d.fitness))
    ks, p = kolmogorov_smirnov(a, b)
    return Crossed(
        task=entry.task,
        body=entry.body,
        condition=entry.condition,
        seed=entry.seed,
        moved=moved,
        engine=engine + AGAIN if engine == BOX2D else engine,
        lower=lower,
        median=median,
        upper=upper,
        box2d=float(np.median(a)),
        difference=difference,
        low=low,
        high=high,
        floor_low=floor_low,
        floor_high=floor_high,
        ks=ks,
        ks_p=p,
        solved=None if task.end is None else int(out.solved[mine].sum()),
        solved_box2d=None if task.end is None else int(box2d.solved[first].sum()),
    )


def floor_of(fitness: np.ndarray) -> tuple[float, float]:
    """The interval that holds 95 % of the differences of two medians of 30 values, both drawn from `fitness`."""
    rng = np.random.default_rng(0)
    a, b = (np.median(rng.choice(fitness, (RESAMPLES, STARTS)), axis=1) for _ in range(2))
    low, high = np.quantile(b - a, [0.025, 0.975])
    return float(low), float(high)
