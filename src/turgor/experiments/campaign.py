"""Campaigns: many runs in one folder, spread over the cores.

Every core has a process of its own that takes one run after the other, each on one thread, so that the optimizer of one
run works while another one simulates. A run's bits do not depend on where and when it ran.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import queue
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from turgor.errors import InvalidInput, describe
from turgor.evolution.loop import Progress as RunProgress
from turgor.evolution.loop import evolve, resume
from turgor.evolution.strategy import CMAES
from turgor.experiments.measure import Measured, measure
from turgor.experiments.plan import Entry
from turgor.runs import Run
from turgor.simulate import available_cores

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
) -> list[Measured]:
    """What every one of `entries` achieved, in their order; their runs are in `folder`, and go on where they stopped.

    Finished runs are measured, not run again. Ctrl-C stops every run after the generation in hand and raises
    `KeyboardInterrupt`. Raises `InvalidInput` for a run in `folder` that was made with other settings.
    """
    if workers is not None and (not isinstance(workers, int) or workers < 1):
        raise InvalidInput("workers: expected a whole number, at least 1", describe(workers))
    for entry in entries:
        open_run(folder, entry)  # refuses before anything is done
    if not entries:
        return []
    context = multiprocessing.get_context("spawn")
    reports, stop = context.Queue(), context.Event()
    count = min(workers or available_cores(), len(entries))
    display = _Display(entries, count, progress)
    # the longest first, so that the cores end together
    order = sorted(entries, key=lambda entry: -cost(entry))
    with ProcessPoolExecutor(count, context, _begin, (reports, stop)) as pool:
        futures = {pool.submit(_work, folder, entry): entry for entry in order}
        try:
            return _gather(entries, futures, reports, display)
        except BaseException as error:
            stop.set()
            pool.shutdown(cancel_futures=True)
            if isinstance(error, BrokenProcessPool):
                raise InvalidInput(
                    f"{folder}: a process of the campaign was ended from outside (memory?); start again to go on"
                ) from None
            raise


def cost(entry: Entry) -> float:
    """How long an entry takes, in units of its own."""
    return entry.evaluations * entry.make_task().parameter_count ** 1.2 + 1


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
    if run.task.identity != task.identity:
        raise InvalidInput(f"{path}: expected the task {task.name} of this version; choose another folder", "another")
    return run


# --- in the processes ---------------------------------------------------------------------------------------------

_reports: Any = None
_stop: Any = None


def _begin(reports: Any, stop: Any) -> None:
    global _reports, _stop
    _reports, _stop = reports, stop
    ignore_interrupts()


def ignore_interrupts() -> None:
    """Ctrl-C reaches every process of a terminal: the first one decides."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(folder: Path, entry: Entry) -> Measured:
    """Runs an entry to its end, wherever it was left, and measures its champion."""
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
    return measure(entry, run)


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
    entries: Sequence[Entry], futures: dict[Future[Measured], Entry], reports: Any, display: _Display
) -> list[Measured]:
    waiting, found = set(futures), {}
    while waiting:
        with contextlib.suppress(queue.Empty):
            display.note(*reports.get(timeout=REPORT_INTERVAL))
        for future in [f for f in waiting if f.done()]:
            waiting.discard(future)
            entry = futures[future]
            found[entry] = future.result()
            display.finish(entry, found[entry])
    return [found[entry] for entry in entries]


class _Display:
    """Turns what the processes tell into `Progress`."""

    def __init__(self, entries: Sequence[Entry], workers: int, show: Callable[[Progress], object] | None) -> None:
        self._cost = {entry.name: cost(entry) for entry in entries}
        self._share = dict.fromkeys(self._cost, 0.0)  # done of each
        self._first: dict[str, float] = {}  # share when first heard of: done in an earlier session
        self._running: dict[str, tuple[int, int, float]] = {}
        self._done, self._show, self._began = 0, show, time.monotonic()

    def note(self, name: str, evaluations: int, budget: int, best: float) -> None:
        if self._share[name] == 1:
            return
        self._share[name] = min(evaluations / budget, 0.999)
        self._first.setdefault(name, self._share[name])
        self._running[name] = evaluations, budget, best
        self._tell(None)

    def finish(self, entry: Entry, measured: Measured) -> None:
        self._first.setdefault(entry.name, 1.0)
        self._share[entry.name] = 1.0
        self._running.pop(entry.name, None)
        self._done += 1
        self._tell(measured)

    def _tell(self, finished: Measured | None) -> None:
        if self._show is None:
            return
        work = sum(self._cost[n] * (self._share[n] - self._first[n]) for n in self._first)
        left = sum(self._cost[n] * (1 - share) for n, share in self._share.items())
        seconds = left * (time.monotonic() - self._began) / work if work > 0 else None
        self._show(
            Progress(
                running=dict(sorted(self._running.items())),
                finished=finished,
                done=self._done,
                total=len(self._cost),
                seconds_left=0.0 if left == 0 else seconds,
            )
        )
