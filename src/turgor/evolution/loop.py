"""The loop: a strategy is asked for a generation, the simulator judges it, the run records it."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.arrays import as_numbers
from turgor.errors import InvalidInput, WorkLost, describe
from turgor.evolution import STRATEGIES
from turgor.evolution.strategy import Degenerate, Strategy, built_in
from turgor.evolution.worlds import check_worlds, judge_generation
from turgor.files import NotWritten
from turgor.records import MOST_REPEATS, RECORD, Champion, Checkpoint, Settings
from turgor.runs import Run, current_versions
from turgor.simulate import Rollout, Simulator, perturbed
from turgor.task import Task
from turgor.variants import Robust

CHECKPOINT_INTERVAL = 10.0  # [s]
MakeStrategy = Callable[[int, np.random.Generator], Strategy]  # of the number of parameters and the randomness


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """Where a run stands after a generation."""

    generation: int
    evaluations: int
    budget: int  # evaluations to reach
    best: float  # so far
    median: float  # of the generation
    sigma: float  # that the generation was drawn with
    evaluations_per_second: float
    seconds_left: float


def evolve(
    task: Task,
    evaluations: int = 10_000,
    seed: int = 0,
    out: str | os.PathLike[str] | None = None,
    *,
    strategy: str | MakeStrategy = "cma-es",
    threads: int | None = None,
    progress: Callable[[Progress], object] | None = None,
    robust_repeats: int = 30,
    recipe: Mapping[str, Any] | None = None,
    executor: Any = None,
    robust: Robust | None = None,
) -> Run:
    """The `Run` that evolves a controller for `task`: its champion, its history and, in the folder `out`, its files.

    Whole generations are evaluated until there are at least `evaluations`. The champion is the best agent of all;
    then it runs again from `robust_repeats` starts moved by 1e-6 m, of which the median is its robust fitness: the
    best of many is partly luck. An agent whose fitness is NaN counts as worse than every other.

    The same `seed` gives the same bits whatever the number of `threads` (None: all cores). `strategy` is the name of
    a built-in one, "cma-es", "sep-cma-es", "lm-ma-es" or "openai-es", or makes a `Strategy` from the number of
    parameters and the randomness, as `functools.partial(SepCMAES, population=100)` does. `progress` is called after
    every generation. `recipe` is kept in run.json: the arguments of `make_task`. `out=None` keeps all in memory.
    `executor`: a Dask `Client`, over whose workers generations of a few hundred agents and more are spread, with the
    same bits whatever the workers are and whatever becomes of them (docs/cluster.md); None: all is done here.
    `robust`: an agent's fitness is the median, or the worst, of what it achieves in a few worlds that differ from the
    task's at random, as in `Robust(worlds=5)` (docs/robustness.md); an evaluation is then so many rollouts.

    Ctrl-C ends it after the generation in hand, a second one at once: what was evolved is kept in `out`,
    `resume` goes on from there, and `KeyboardInterrupt` is raised. Raises `InvalidInput` for a task without anything
    to evolve, an unknown strategy, a folder that is not empty, or where no agent of the first generation has a fitness;
    and, once what was evolved is kept, where the scheduler or all workers of `executor` are gone.
    """
    started = time.perf_counter()
    simulator = _simulator(task, threads, executor)
    with _told_what_is_kept(out):
        run, optimizer = begin(
            task, evaluations, seed, out, strategy, simulator.threads, robust_repeats, recipe, robust
        )
        with contextlib.closing(run):
            return _carry_on(run, simulator, optimizer, progress, _Clock(run.seconds, started))


def begin(
    task: Task,
    evaluations: int,
    seed: int,
    out: str | os.PathLike[str] | None,
    strategy: str | MakeStrategy,
    threads: int,
    robust_repeats: int = 30,
    recipe: Mapping[str, Any] | None = None,
    robust: Robust | None = None,
) -> tuple[Run, Strategy]:
    """A new run and its strategy, before the first generation; see `evolve`."""
    for name, value in (("evaluations", evaluations), ("robust_repeats", robust_repeats)):
        if not isinstance(value, int) or value < 1:
            raise InvalidInput(f"{name}: expected a whole number, at least 1", describe(value))
    if not isinstance(seed, int) or seed < 0:
        raise InvalidInput("seed: expected a whole number, 0 or more", describe(seed))
    if task.parameter_count == 0:
        raise InvalidInput("evolve: expected a condition that controls something", f"{task.name}, {task.condition}")
    make = built_in(strategy) if isinstance(strategy, str) else strategy
    optimizer = make(task.parameter_count, np.random.default_rng(seed))
    settings = Settings(
        evaluations=evaluations,
        seed=seed,
        strategy=optimizer.name,
        population=optimizer.population,
        sigma=float(optimizer.sigma),
        threads=threads,
        robust_repeats=robust_repeats,
        recipe=None if recipe is None else dict(recipe),
        robust=robust,
    )
    if robust is not None:
        check_worlds(task, robust)
    return Run.create(task, settings, out), optimizer


def resume(
    run: Run,
    evaluations: int | None = None,
    *,
    strategy: str | MakeStrategy | None = None,
    threads: int | None = None,
    progress: Callable[[Progress], object] | None = None,
    executor: Any = None,
) -> Run:
    """`run`, taken up where it was left, to its end or to `evaluations`: with the same bits as without the pause.

    It goes on from its last checkpoint; what came after is evolved again. `strategy` is what `evolve` was given; None
    for a built-in one, which run.json names. `executor` is as in `evolve`, whatever the run was started with.

    Raises `InvalidInput` for a run that another process writes, that has no evaluations left, whose strategy is another
    one or not known, or of which no checkpoint can be read.
    """
    started = time.perf_counter()
    run.claim()
    with _told_what_is_kept(run.path), contextlib.closing(run):
        settings = run.settings
        budget = settings.evaluations if evaluations is None else evaluations
        if not isinstance(budget, int) or budget < 1:
            raise InvalidInput("evaluations: expected a whole number, at least 1", describe(budget))
        if run.status == "done" and run.evaluations >= budget:
            raise InvalidInput(f"evaluations: expected more than the {run.evaluations} that are done", str(budget))
        if run.status == "done" and run.note:
            raise InvalidInput(f"resume: expected a run that can go on; {run.note}")
        simulator = _simulator(run.task, threads, executor)
        checkpoint = run.read_checkpoint()
        optimizer = _restored(run, checkpoint, strategy)
        reopen(run, checkpoint, msgspec.structs.replace(settings, evaluations=budget, threads=simulator.threads))
        return _carry_on(run, simulator, optimizer, progress, _Clock(run.seconds, started))


def reopen(run: Run, checkpoint: Checkpoint, settings: Settings) -> None:
    """Has `run` go back to `checkpoint`, to be evolved by `settings` from there."""
    run.settings = settings
    run.status, run.note, run.versions = "running", None, current_versions()
    run.go_back(checkpoint)


def evolve_a_while(
    run: Run,
    checkpoint: Checkpoint,
    strategy: MakeStrategy,
    seconds: float,
    progress: Callable[[Progress], object] | None = None,
) -> dict[str, np.ndarray] | None:
    """Takes up `run`, which is in memory and stands at `checkpoint`, for `seconds` of the clock or to its end; then its
    status is "running" or "done". Where the pause falls leaves no trace in the bits. Returns the strategy's state; None
    where it cannot go on."""
    started = time.perf_counter()
    optimizer = _restored(run, checkpoint, strategy)
    simulator, clock = Simulator(run.task, threads=run.settings.threads), _Clock(run.seconds, started)
    _carry_on(run, simulator, optimizer, progress, clock, until=started + seconds)
    return optimizer.state() if run.note is None else None


def _simulator(task: Task, threads: int | None, executor: Any) -> Simulator:
    if executor is None:
        return Simulator(task, threads=threads)
    from turgor.cluster.shards import ShardedSimulator

    return ShardedSimulator(task, executor, threads=threads)


def _restored(run: Run, checkpoint: Checkpoint, strategy: str | MakeStrategy | None) -> Strategy:
    """The strategy that `run` was started with, as it was at `checkpoint`; raises `InvalidInput` for another one."""
    settings = run.settings
    make = _as_started(settings, strategy) if strategy is None or isinstance(strategy, str) else strategy
    optimizer = make(run.task.parameter_count, np.random.default_rng(settings.seed))
    if optimizer.name != settings.strategy:
        raise InvalidInput(f"strategy: expected {settings.strategy}", optimizer.name)
    if checkpoint.state is not None:
        optimizer.restore(checkpoint.state)
    if optimizer.population != settings.population:
        raise InvalidInput(f"strategy: expected a population of {settings.population}", str(optimizer.population))
    return optimizer


def _as_started(settings: Settings, name: str | None) -> MakeStrategy:
    """Makes the built-in strategy as the run was started with: it may have stopped before its first checkpoint."""
    if name is None and settings.strategy not in STRATEGIES:
        expected = "strategy: expected the one of your own that the run was evolved with"
        raise InvalidInput(expected, f"none, and {settings.strategy!r} is not one of {', '.join(STRATEGIES)}")
    sigma = {} if settings.sigma is None else {"sigma": settings.sigma}
    return partial(built_in(name or settings.strategy), population=settings.population, **sigma)


def evaluate(simulator: Simulator, theta: ArrayLike, repeats: int = 30, size: float = 1e-6) -> Rollout:
    """A `Rollout` of one controller, `theta` [parameter], from `repeats` starts that differ by `size` [m]."""
    if not isinstance(repeats, int) or not 1 <= repeats <= MOST_REPEATS:
        raise InvalidInput(f"repeats: expected a whole number, 1 to {MOST_REPEATS}", describe(repeats))
    theta = as_numbers("theta", theta)
    thetas = np.broadcast_to(theta, (repeats, *theta.shape))
    return simulator.rollout(thetas, perturbed(simulator.task.position, repeats, size))


def _carry_on(
    run: Run,
    simulator: Simulator,
    optimizer: Strategy,
    progress: Callable[[Progress], object] | None,
    clock: _Clock,
    until: float = math.inf,
) -> Run:
    """Evolves `run` to its end, or `until` a time of `perf_counter`, and writes it down, whatever ends it."""
    with _gentle_interrupt() as interrupt:
        try:
            _generations(run, simulator, optimizer, progress, clock, interrupt, until)
            run.status = "done" if run.evaluations >= run.settings.evaluations else "running"
        except Degenerate as reason:
            run.status, run.note = "done", f"stopped in generation {run.generation + 1}: {reason}"
        except KeyboardInterrupt:
            run.status = "interrupted"
            raise
        except WorkLost as lost:
            run.status = "interrupted"
            kept = "the run was in memory alone" if run.path is None else f"turgor resume {run.path} goes on"
            raise InvalidInput(f"{lost}; {run.generation} generations were done; {kept}") from None
        except NotWritten as error:
            run.status, run.note = "interrupted", str(error)
            raise
        except Exception as error:
            run.status, run.note = "failed", describe(error)
            raise
        finally:
            if run.status == "done":
                with clock.of("simulation"):
                    _measure_champion(run, simulator)
            # a strategy that stopped, or was stopped amid its work, has no state to go on from
            whole = run.status != "failed" and run.note is None and not interrupt.forced
            save(run, optimizer.state() if whole else None, clock.seconds())
    if interrupt.wanted:
        raise KeyboardInterrupt
    return run


@contextlib.contextmanager
def _told_what_is_kept(folder: str | os.PathLike[str] | None) -> Generator[None]:
    """Adds to a full disk's error what became of the work."""
    try:
        yield
    except NotWritten as error:
        if folder is None or not (Path(folder) / RECORD).exists():
            raise
        raise NotWritten(f"{error}; all written before is whole, and turgor resume {folder} goes on from it") from None


def _generations(
    run: Run,
    simulator: Simulator,
    optimizer: Strategy,
    progress: Callable[[Progress], object] | None,
    clock: _Clock,
    interrupt: _Interrupt,
    until: float,
) -> None:
    saved, first = time.perf_counter(), run.evaluations
    with clock.of("start"):
        _load_engine(run.task)
    began = time.perf_counter()
    while run.evaluations < run.settings.evaluations:
        sigma = optimizer.sigma
        with clock.of("strategy"):
            theta = optimizer.ask()
        with clock.of("simulation"):
            out = judge_generation(simulator, theta, run.settings.robust, run.settings.seed, run.generation + 1)
        median = _note_generation(run, theta, out, sigma, clock.total())
        with clock.of("strategy"):
            optimizer.tell(theta, out.fitness)
        now = time.perf_counter()
        if progress is not None:
            rate = (run.evaluations - first) / (now - began)
            progress(_progress(run, median, sigma, rate))
        if interrupt.wanted:
            raise KeyboardInterrupt
        if now > until:
            return
        if now - saved > CHECKPOINT_INTERVAL:
            save(run, optimizer.state(), clock.seconds())
            saved = time.perf_counter()


def _load_engine(task: Task) -> None:
    """Compiles the engine or loads it, so that its time is not the first generation's."""
    task = msgspec.structs.replace(task, fitness="progress")  # a function of the user's own need not take no agents
    Simulator(task, threads=1).rollout(np.zeros((0, task.parameter_count)))


def _note_generation(run: Run, theta: np.ndarray, out: Rollout, sigma: float, seconds: float) -> float:
    """Adds a generation to the history, its best to the champions; returns its median fitness."""
    generation = run.generation + 1
    fitness = np.where(np.isnan(out.fitness), -np.inf, out.fitness)

    def better(than: Champion | None, among: np.ndarray) -> Champion | None:
        k = int(np.argmax(np.where(among, fitness, -np.inf)))
        if not (among[k] and math.isfinite(fitness[k]) and (than is None or fitness[k] > than.fitness)):
            return than
        return Champion(
            theta=theta[k].copy(),
            fitness=float(fitness[k]),
            steps=int(out.steps[k]),
            solved=bool(out.solved[k]),
            generation=generation,
        )

    run.champion = better(run.champion, np.isfinite(fitness))
    if run.task.end is not None:
        run.solver = better(run.solver, out.solved & np.isfinite(fitness))
    if run.champion is None:
        raise InvalidInput("fitness: expected a finite number from an agent of the first generation", "none")
    ordered = np.sort(fitness)
    half = len(ordered) // 2
    median = float(ordered[half] if len(ordered) % 2 else ordered[half - 1 : half + 1].mean())
    run.add((generation, run.evaluations + len(theta), run.champion.fitness, median, float(sigma), round(seconds, 3)))
    return median


def _measure_champion(run: Run, simulator: Simulator) -> None:
    if run.champion is not None and run.champion.robust is None:
        out = evaluate(simulator, run.champion.theta, run.settings.robust_repeats)
        run.champion = msgspec.structs.replace(run.champion, robust=out.fitness, robust_solved=out.solved)


def _progress(run: Run, median: float, sigma: float, rate: float) -> Progress:
    return Progress(
        generation=run.generation,
        evaluations=run.evaluations,
        budget=run.settings.evaluations,
        best=run.rows[-1][2],
        median=median,
        sigma=sigma,
        evaluations_per_second=rate,
        seconds_left=max(run.settings.evaluations - run.evaluations, 0) / rate,
    )


def save(run: Run, state: dict[str, np.ndarray] | None, seconds: Mapping[str, float]) -> None:
    """Writes down everything, with the strategy's `state` if there is one, and where the `seconds` went; run.json last,
    because it says that the others are there."""
    run.write_champion()
    if state is not None:
        run.write_checkpoint(state)
    run.seconds = dict(seconds)
    run.write_record()


class _Clock:
    """Where the time goes, on top of what earlier sessions of the run took."""

    def __init__(self, before: Mapping[str, float], started: float) -> None:
        self._parts = {"start": 0.0, "simulation": 0.0, "strategy": 0.0}
        self._parts |= {name: seconds for name, seconds in before.items() if name in self._parts}
        self._parts["start"] += time.perf_counter() - started
        self._started = started - before.get("total", 0.0)

    @contextlib.contextmanager
    def of(self, part: str) -> Generator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self._parts[part] += time.perf_counter() - began

    def total(self) -> float:
        return time.perf_counter() - self._started

    def seconds(self) -> dict[str, float]:
        """Seconds of every part, of the rest and of all."""
        total = self.total()
        return {**self._parts, "rest": total - sum(self._parts.values()), "total": total}


class _Interrupt:
    wanted = False  # after this generation
    forced = False  # at once


@contextlib.contextmanager
def _gentle_interrupt() -> Generator[_Interrupt]:
    """Has the first Ctrl-C noted and the second one raised, so that no generation is torn apart.

    Only in the main thread, which alone gets signals, and where nobody else handles them.
    """
    interrupt = _Interrupt()

    def handle(*_: object) -> None:
        interrupt.forced = interrupt.wanted
        interrupt.wanted = True
        if interrupt.forced:
            raise KeyboardInterrupt

    here = threading.current_thread() is threading.main_thread()
    if not here or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield interrupt
        return
    signal.signal(signal.SIGINT, handle)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
