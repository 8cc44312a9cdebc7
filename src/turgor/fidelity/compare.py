"""Crosscheck: is a controller worth in another physics engine what it is worth in this one?

One trajectory tells nothing: contacts are chaotic, so that two faithful engines part after some seconds, as one engine
parts from itself when the start is moved by a millionth of a metre. Compared is therefore what does not hang on luck:
the distribution of fitness over such starts, and the order in which an engine ranks controllers. What chaos alone does,
this engine against itself, stands beside it as the floor.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike

import turgor
from turgor.arrays import as_numbers
from turgor.control import check_theta
from turgor.errors import InvalidInput, describe
from turgor.experiments.statistics import median_difference
from turgor.fidelity.engines import ENGINES, Crew, installed, load_world, make_job, version_of
from turgor.recording import Recording
from turgor.rollout import Rollout
from turgor.simulate import Simulator, perturbed
from turgor.task import Task

HERE = "turgor"
UNUSUAL = ("box2d-ccd", "box2d-fine")  # compared with where asked for
CONTROLLERS = 60  # drawn at random, to be ranked, with numbers uniform in [-1, 1]
MOST_REPEATS = 10_000
MOVED = 1e-3  # [m], of a start: from 1e-6 m most starts meet the same accident, and a p counts it many times
CHAOS = 1e-6  # [m], of a start: what chaos makes of next to nothing
APART = 0.01  # [m], between two positions of a mass: there the trajectories part
SURE = 0.05  # a difference is told from chance where p is below
CLOSE = 0.05  # [1], of the fitness: what is as good as the same
FINE = 0.01  # [fitness]: the same where the fitness itself is near 0
WEAK = 0.8  # [1], of the fitness: a champion that keeps less has not held

Verdict = Literal["the same", "close", "stronger", "mixed", "weaker", "does not hold"]
HOLDS: tuple[Verdict, ...] = ("the same", "close", "stronger")


class Case(NamedTuple):
    """What is crosschecked."""

    task: Task
    theta: np.ndarray  # [parameter]
    ranked: np.ndarray  # [controller, parameter]


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """What a controller, and those to be ranked, are worth in one engine."""

    engine: str
    version: str
    own: float  # fitness from the task's start
    fitness: list[float]  # [repeat], from moved starts
    solved: list[bool] | None  # [repeat]; None: the task has no end
    ranked: list[float]  # [controller], fitness of each from the task's start


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Another engine beside this one. Medians are of the fitness from moved starts."""

    engine: str
    median_here: float
    median: float
    difference: float  # there - here
    low: float  # ends of its 95 % interval, by bootstrap
    high: float
    kept: float | None  # median there / median here; None where that is not positive
    ks: float  # Kolmogorov's and Smirnov's distance of the two distributions [1]
    ks_p: float
    solved_here: int | None  # starts from which the task was solved
    solved: int | None
    rank: float | None  # Spearman's correlation of the controllers' fitness; None: fewer than 3 controllers
    rank_floor: float | None  # of this engine with itself, the start moved by 1e-6 m
    parts: int | None  # first step after which the two trajectories are 1 cm apart; None: never
    parts_floor: int | None  # of this engine from itself
    verdict: Verdict
    says: str  # the verdict in words

    @property
    def holds(self) -> bool:
        """Whether the controller is worth as much in this engine."""
        return self.verdict in HOLDS


class Crosscheck(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One controller in several engines."""

    samples: list[Sample]  # of this engine first
    comparisons: list[Comparison]  # of every other engine with this one
    recordings: dict[str, Recording]  # by engine, from the task's start

    def __repr__(self) -> str:
        return "\n".join(f"{name_of(c.engine)}: {c.says}" for c in self.comparisons)

    @property
    def holds(self) -> bool:
        """Whether the controller is worth as much in every other engine."""
        return all(comparison.holds for comparison in self.comparisons)


def crosscheck(
    task: Task,
    theta: ArrayLike,
    repeats: int = 30,
    *,
    moved: float = MOVED,
    engines: Sequence[str] | None = None,
    controllers: int | ArrayLike = CONTROLLERS,
    seed: int = 0,
    processes: int | None = 1,
    progress: Callable[[int, int], object] | None = None,
) -> Crosscheck:
    """A `Crosscheck` of the controller `theta` [parameter]: what it is worth in real Box2D, and what here.

    In every engine it runs from `repeats` starts of which one coordinate of one mass is `moved` [m], and `controllers`
    run from the task's own, to be ranked: so many, drawn at random by `seed`, or those of an array [controller,
    parameter]. `engines` are some of
    "box2d" (2.3, the paper's), "box2d-ccd" (the same with continuous collision, as the paper's program had it),
    "box2d-fine" (in steps of a quarter of the length) and "box2d-v3"; None: the first and the last, where installed.
    `processes`: None for all cores; then a script has to be guarded by `if __name__ == "__main__"`. The numbers do not
    depend on it. `progress` is called with the agents that are done and with all.

    Raises `InvalidInput` for impossible numbers, and for an engine that is not installed or cannot do the task.
    """
    theta = np.reshape(as_numbers("theta", theta), (1, -1))
    theta = check_theta(theta, task.body, task.condition, task.controller)[0]
    case = Case(task, theta, controllers_for(task, controllers, seed))
    with Crew(processes) as crew:
        return next(crosschecks([case], repeats, moved, engines_for(engines), crew, progress))


def name_of(engine: str) -> str:
    """The name of an engine for people."""
    return HERE if engine == HERE else ENGINES[engine].says


def engines_for(names: Sequence[str] | None) -> list[str]:
    """The engines called `names`, each once; None: the usual ones that are installed. Raises `InvalidInput`."""
    if names is None:
        found = [engine for engine in installed() if engine not in UNUSUAL]
        if not found:
            raise InvalidInput("crosscheck: expected another engine; pip install 'turgor[box2d]'", "none")
        return found
    for name in names:
        load_world(name)
    return list(dict.fromkeys(names))


def controllers_for(task: Task, given: int | ArrayLike, seed: int) -> np.ndarray:
    """Controllers to be ranked, [controller, parameter]: so many, drawn by `seed`, or those given. Raises
    `InvalidInput`."""
    if not isinstance(given, int):
        return check_theta(given, task.body, task.condition, task.controller)
    if not 0 <= given <= MOST_REPEATS:
        raise InvalidInput(f"controllers: expected a whole number, 0 to {MOST_REPEATS}", describe(given))
    if not isinstance(seed, int) or seed < 0:
        raise InvalidInput("seed: expected a whole number, 0 or more", describe(seed))
    count = given if task.parameter_count else 0
    return np.random.default_rng(seed).uniform(-1, 1, (count, task.parameter_count))


def crosschecks(
    cases: Sequence[Case],
    repeats: int,
    moved: float,
    engines: Sequence[str],
    crew: Crew,
    progress: Callable[[int, int], object] | None = None,
) -> Iterator[Crosscheck]:
    """A `Crosscheck` of each of `cases` in their order, as soon as it is known. Raises `InvalidInput`."""
    if not isinstance(repeats, int) or not 2 <= repeats <= MOST_REPEATS:
        raise InvalidInput(f"repeats: expected a whole number, 2 to {MOST_REPEATS}", describe(repeats))
    if not isinstance(moved, int | float) or not 0 < moved <= 1:
        raise InvalidInput("moved: expected a number of metres, more than 0 and up to 1", describe(moved))
    jobs = []
    for case in cases:
        agents = _line_up(case, repeats, moved)
        jobs += [make_job(engine, case.task, *agents, record=True) for engine in engines]
    answers = crew.run(jobs, progress)
    for case in cases:
        floor = _Floor(case, crew.processes)
        samples, recordings = [floor.sample(repeats, moved)], {HERE: floor.recording}
        comparisons = []
        for engine in engines:
            done = next(answers)
            assert done.recording is not None
            recordings[engine] = done.recording
            samples.append(_sample(engine, version_of(engine), case.task, done.rollout, repeats))
            comparisons.append(compare(samples[0], samples[-1], floor, done.recording))
        yield Crosscheck(samples=samples, comparisons=comparisons, recordings=recordings)


def _line_up(case: Case, repeats: int, moved: float) -> tuple[np.ndarray, np.ndarray]:
    """Theta and starts of a case's agents: the controller from the task's start, then from `repeats` moved ones; then
    the controllers to be ranked."""
    own, ranked = case.task.position[None], len(case.ranked)
    theta = np.concatenate([np.tile(case.theta, (1 + repeats, 1)), case.ranked])
    starts = perturbed(case.task.position, repeats, moved)
    return theta, np.concatenate([own, starts, np.repeat(own, ranked, axis=0)])


def _sample(engine: str, version: str, task: Task, out: Rollout, repeats: int) -> Sample:
    """What agents that were lined up so have achieved."""
    fitness, moved = np.asarray(out.fitness, dtype=np.float64), slice(1, 1 + repeats)
    return Sample(
        engine=engine,
        version=version,
        own=float(fitness[0]),
        fitness=fitness[moved].tolist(),
        solved=None if task.end is None else out.solved[moved].tolist(),
        ranked=fitness[1 + repeats :].tolist(),
    )


class _Floor:
    """A case in this engine, and what chaos alone makes of it."""

    def __init__(self, case: Case, threads: int) -> None:
        self.case, self.simulator = case, Simulator(case.task, threads=threads)
        moved = perturbed(case.task.position, max(len(case.ranked), 1), CHAOS)
        self.recording = self.simulator.record(case.theta)
        self.parts = first_apart(self.recording, self.simulator.record(case.theta, moved[0]))
        self.again = self.simulator.rollout(case.ranked, moved[: len(case.ranked)]).fitness

    def sample(self, repeats: int, moved: float) -> Sample:
        out = self.simulator.rollout(*_line_up(self.case, repeats, moved))
        return _sample(HERE, turgor.__version__, self.case.task, out, repeats)


# --- what differs -------------------------------------------------------------------------------------------------


def compare(here: Sample, there: Sample, floor: _Floor, recording: Recording) -> Comparison:
    """How what was found `there` compares with what was found `here`."""
    median_here, median = float(np.median(here.fitness)), float(np.median(there.fitness))
    difference, low, high = median_difference(here.fitness, there.fitness)
    ks, p = kolmogorov_smirnov(here.fitness, there.fitness)
    verdict = judge_medians(median_here, median, low, high, p)
    return Comparison(
        engine=there.engine,
        median_here=median_here,
        median=median,
        difference=difference,
        low=low,
        high=high,
        kept=median / median_here if median_here > 0 else None,
        ks=ks,
        ks_p=p,
        solved_here=None if here.solved is None else sum(here.solved),
        solved=None if there.solved is None else sum(there.solved),
        rank=rank_correlation(here.ranked, there.ranked),
        rank_floor=rank_correlation(here.ranked, floor.again),
        parts=first_apart(floor.recording, recording),
        parts_floor=floor.parts,
        verdict=verdict,
        says=_in_words(verdict, median_here, median, low, high, ks, len(there.fitness)),
    )


def judge_medians(here: float, there: float, low: float, high: float, ks_p: float) -> Verdict:
    """What two medians, the interval of their difference and the p of two distributions tell together."""
    told_apart = not low <= 0 <= high
    if not told_apart:
        return "the same" if ks_p >= SURE else "mixed"
    if _is_close(here, there, low, high):
        return "close"
    if there > here:
        return "stronger"
    return "weaker" if here > 0 and there >= WEAK * here else "does not hold"


def _is_close(here: float, there: float, low: float, high: float) -> bool:
    """Whether the interval of two medians' difference lies within `CLOSE` of the larger one."""
    return max(abs(low), abs(high)) <= max(CLOSE * max(abs(here), abs(there)), FINE)


def _in_words(verdict: Verdict, here: float, there: float, low: float, high: float, ks: float, starts: int) -> str:
    medians = f"{there:.3g} there, {here:.3g} here"
    kept = f"keeps {there / here:.0%}" if here > 0 <= there else "falls"
    same = f"holds: {medians}, not to be told from chance in {starts} starts"
    if not _is_close(here, there, low, high):
        same = f"holds as far as {starts} starts can tell: {medians}, the difference is {low:+.2g} to {high:+.2g}"
    return {
        "the same": same,
        "close": f"holds: {medians}, within {CLOSE:.0%}",
        "stronger": f"holds, and does better: {medians}",
        "mixed": f"holds in the median ({medians}), but the distributions differ (KS {ks:.2f})",
        "weaker": f"holds in part: {kept} ({medians})",
        "does not hold": f"does not hold: {kept} ({medians})",
    }[verdict]


def kolmogorov_smirnov(a: ArrayLike, b: ArrayLike) -> tuple[float, float]:
    """The largest difference of the distribution functions of two samples, and its two-sided p."""
    from scipy.stats import ks_2samp

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where exact p cannot be had, it is the asymptotic one
        found = ks_2samp(a, b)
    return float(found.statistic), float(found.pvalue)


def rank_correlation(a: ArrayLike, b: ArrayLike) -> float | None:
    """Spearman's rank correlation; None for fewer than 3 values, or where one side has a single value."""
    from scipy.stats import rankdata

    a, b = rankdata(a), rankdata(b)
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(np.corrcoef(a, b)[0, 1])


def first_apart(a: Recording, b: Recording, distance: float = APART) -> int | None:
    """The first step after which any mass is `distance` [m] apart in two recordings; None: never."""
    steps = min(len(a.position), len(b.position))
    gap = np.linalg.norm(np.asarray(a.position[:steps], np.float64) - b.position[:steps], axis=2).max(axis=1)
    apart = np.flatnonzero(gap >= distance)
    return int(apart[0]) if apart.size else None
