"""Campaigns: many runs in one folder, spread over the cores.

Every core has a process of its own that takes one run after the other, each on one thread, so that the optimizer of one
run works while another one simulates. A run's bits do not depend on where and when it ran.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from turgor.errors import InvalidInput, WorkLost, describe
from turgor.evolution.cma_es import CMAES
from turgor.evolution.loop import Progress as RunProgress
from turgor.evolution.loop import evolve, resume
from turgor.experiments.measure import Measured, measure
from turgor.experiments.plan import Entry
from turgor.runs import Run
from turgor.simulate import available_cores

LEAST_KNOWN = 1e-3  # of the work: before, nothing is told of the rest
REPORT_INTERVAL = 0.2  # [s], between two reports of a run


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """Where a campaign stands."""

    running: dict[str, tuple[int, int, float]]  # run: evaluations done, evaluations to reach, best so far
    finished: Measured | None  # that was finished just now
    done: int  # entries
    total: int
    seconds_left: float | None  # None: nothing to go by yet


def run_entries(
    folder: Path,
    entries: Sequence[Entry],
    workers: int | None = None,
    progress: Callable[[Progress], object] | None = None,
    executor: Any = None,
) -> list[Measured]:
    """What every one of `entries` achieved, in their order; their runs are in `folder`, and go on where they stopped.

    Finished runs are measured, not run again. Ctrl-C stops every run after the generation in hand and raises
    `KeyboardInterrupt`. `executor`: a Dask `Client`, whose workers then do all the work, with the same results. Raises
    `InvalidInput` for a run in `folder` that was made with other settings.
    """
    if workers is not None and (not isinstance(workers, int) or workers < 1):
        raise InvalidInput("workers: expected a whole number, at least 1", describe(workers))
    shares = {entry: share_done(folder, entry) for entry in entries}  # refuses before anything is run
    costs = {entry: cost(entry) * (1 - share) for entry, share in shares.items()}
    if not entries:
        return []
    if executor is not None:
        found = _on_cluster(folder, costs, executor, _Display(shares, progress))
        return [found[entry] for entry in entries]
    context = multiprocessing.get_context("spawn")
    reports, stop = context.Queue(), context.Event()
    count = min(workers or available_cores(), len(entries))
    with ProcessPoolExecutor(count, context, _begin, (reports, stop)) as pool:
        try:
            found = _gather(folder, Schedule(costs, count), pool, count, reports, _Display(shares, progress))
        except BaseException as error:
            stop.set()
            pool.shutdown(cancel_futures=True)
            if isinstance(error, BrokenProcessPool):
                raise InvalidInput(
                    f"{folder}: a process of the campaign was ended from outside (memory?); start again to go on"
                ) from None
            raise
    return [found[entry] for entry in entries]


def cost(entry: Entry) -> float:
    """How long an entry takes, in units of its own."""
    return entry.evaluations * entry.make_task().parameter_count ** 1.2 + 1


def share_done(folder: Path, entry: Entry) -> float:
    """How much of an entry's evolution earlier sessions did [1]. Raises `InvalidInput` as `open_run` does."""
    run = open_run(folder, entry)
    return 0.0 if run is None else min(run.evaluations / entry.evaluations, 1.0)


class Schedule:
    """The order in which entries are run.

    Half of the processes take the longest entry that waits, the others the shortest: then the large matrices of one
    optimizer share memory and cache with another run's simulation rather than with matrices as large. A few of the
    shortest are kept for the end, so that the processes end together.
    """

    def __init__(self, costs: Mapping[Entry, float], processes: int) -> None:
        self._waiting = sorted(costs, key=lambda entry: -costs[entry])
        self._from_the_top = (processes + 1) // 2
        self._kept = 3 * processes
        self._long: set[Entry] = set()  # under way, from the long end

    def start(self) -> Entry | None:
        """The entry that is to be started next; None where none waits."""
        if not self._waiting:
            return None
        if len(self._long) < self._from_the_top:
            entry = self._waiting.pop(0)
            self._long.add(entry)
            return entry
        return self._waiting.pop(max(len(self._waiting) - 1 - self._kept, 0))

    def end(self, entry: Entry) -> None:
        """Notes that an entry has ended."""
        self._long.discard(entry)


def open_run(folder: Path, entry: Entry) -> Run | None:
    """The run of `entry` in `folder`, None where there is none yet; raises `InvalidInput` for one of other settings."""
    path = folder / entry.name
    if not entry.evaluations or not path.exists():
        return None
    if path.is_dir() and not any(path.iterdir()):
        return None
    run, task = Run.open(path), entry.make_task()
    wanted = {"evaluations": entry.evaluations, "seed": entry.seed, "population": entry.population}
    for name, value in wanted.items():
        found = getattr(run.settings, name)
        if found != value:
            raise InvalidInput(
                f"{path}: expected a run of {value} {name}; choose another folder, or the setting it has",
                f"one of {found}",
            )
    if run.settings.robust is not None:
        raise InvalidInput(
            f"{path}: expected a run that is not robust; choose another folder", run.settings.robust.told
        )
    if run.task.identity != task.identity:
        raise InvalidInput(f"{path}: expected the task {task.name} of this version; choose another folder", "another")
    return run


# --- in the processes ---------------------------------------------------------------------------------------------

_reports: Any = None
_stop: Any = None
_in_hand = threading.Lock()  # held while something must not be torn apart


def _begin(reports: Any, stop: Any) -> None:
    global _reports, _stop
    _reports, _stop = reports, stop
    follow_first_process()


def follow_first_process() -> None:
    """Leaves it to the first process what Ctrl-C means, which reaches every process of a terminal; and ends this one,
    once what it has in hand is put down, if the first one is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    first = multiprocessing.parent_process()
    assert first is not None

    def end() -> None:
        first.join()
        with _in_hand:
            os._exit(1)

    threading.Thread(target=end, daemon=True).start()


def _work(folder: Path, entry: Entry) -> Measured:
    """Runs an entry to its end, wherever it was left, and measures its champion."""
    with _in_hand:
        return measure(entry, _evolve(folder, entry))


def _evolve(folder: Path, entry: Entry) -> Run | None:
    run = open_run(folder, entry)
    report = _Reporter(entry)
    if entry.evaluations and (run is None or run.status != "done"):
        how: dict[str, Any] = {
            "strategy": partial(CMAES, population=entry.population),
            "threads": 1,
            "progress": report,
        }
        if run is None:
            path = folder / entry.name
            run = evolve(entry.make_task(), entry.evaluations, entry.seed, path, recipe=entry.recipe, **how)
        else:
            run = resume(run, **how)
    return run


class _Reporter:
    """Tells the first process how far a run is, and stops it where that is wanted or gone."""

    def __init__(self, entry: Entry) -> None:
        self._name, self._told = entry.name, 0.0
        self._parent = multiprocessing.parent_process()

    def __call__(self, progress: RunProgress) -> None:
        if _stop.is_set() or (self._parent is not None and not self._parent.is_alive()):
            raise KeyboardInterrupt
        now = time.monotonic()
        if now - self._told > REPORT_INTERVAL:
            self._told = now
            _reports.put((self._name, progress.evaluations, progress.budget, progress.best))


# --- in the first process -----------------------------------------------------------------------------------------


def _gather(
    folder: Path, schedule: Schedule, pool: ProcessPoolExecutor, count: int, reports: Any, display: _Display
) -> dict[Entry, Measured]:
    """Keeps every process of the pool at work until no entry waits."""
    running: dict[Future[Measured], Entry] = {}
    found: dict[Entry, Measured] = {}

    def start() -> None:
        if (entry := schedule.start()) is not None:
            future = pool.submit(_work, folder, entry)
            running[future] = entry
            future.add_done_callback(lambda _: reports.put(None))  # wakes the loop

    for _ in range(count):
        start()
    while running:
        with contextlib.suppress(queue.Empty):
            if (report := reports.get(timeout=REPORT_INTERVAL)) is not None:
                display.note(*report)
        for future in [future for future in running if future.done()]:
            entry = running.pop(future)
            schedule.end(entry)
            found[entry] = future.result()
            start()
            display.finish(entry, found[entry])
    return found


def _on_cluster(folder: Path, costs: Mapping[Entry, float], executor: Any, display: _Display) -> dict[Entry, Measured]:
    from turgor.cluster.crew import Crew
    from turgor.experiments.pieces import run_in_pieces

    crew = Crew(executor, whole_runs=True)
    try:
        return run_in_pieces(folder, partial(open_run, folder), Schedule(costs, max(crew.workers, 1)), crew, display)
    except WorkLost as lost:
        raise InvalidInput(f"{lost}; every run is kept in {folder}; the same command goes on") from None


class _Display:
    """Turns what the processes tell into `Progress`."""

    def __init__(self, shares: Mapping[Entry, float], show: Callable[[Progress], object] | None) -> None:
        self._cost = {entry.name: cost(entry) for entry in shares}
        self._share = {entry.name: share for entry, share in shares.items()}  # done of each
        self._first = dict(self._share)  # done in earlier sessions
        self._running: dict[str, tuple[int, int, float]] = {}
        self._done, self._show, self._began = 0, show, time.monotonic()

    def note(self, name: str, evaluations: int, budget: int, best: float) -> None:
        if self._share[name] == 1:  # told before its end, heard after it
            return
        self._share[name] = min(evaluations / budget, 0.999)
        self._running[name] = evaluations, budget, best
        self._tell(None)

    def finish(self, entry: Entry, measured: Measured) -> None:
        self._share[entry.name] = 1.0
        self._running.pop(entry.name, None)
        self._done += 1
        self._tell(measured)

    def _tell(self, finished: Measured | None) -> None:
        if self._show is None:
            return
        work = sum(self._cost[n] * (share - self._first[n]) for n, share in self._share.items())
        left = sum(self._cost[n] * (1 - share) for n, share in self._share.items())
        known = work > LEAST_KNOWN * (work + left)
        seconds = left * (time.monotonic() - self._began) / work if known else None
        self._show(
            Progress(
                running=dict(sorted(self._running.items())),
                finished=finished,
                done=self._done,
                total=len(self._cost),
                seconds_left=0.0 if left == 0 else seconds,
            )
        )
