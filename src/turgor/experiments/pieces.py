"""A campaign on a cluster: each run in pieces of some seconds, by whichever workers; written down here alone.

A worker takes up a run where its last piece ended, evolves it in memory for a while, and answers with what is new.
Where a piece ends leaves no trace in the bits, as with any run that is resumed; a worker that is lost costs one piece.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import msgspec

from turgor.cluster.crew import Crew
from turgor.evolution.cma_es import CMAES
from turgor.evolution.loop import Progress, begin, evolve_a_while, reopen, save
from turgor.evolution.strategy import hold_blas
from turgor.experiments.measure import Measured, measure
from turgor.experiments.plan import Entry
from turgor.files import NotWritten
from turgor.records import Checkpoint, Settings
from turgor.runs import Run

REPORT_INTERVAL = 0.5  # [s], between two reports of a run


class Stand(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Where a run stands: what a worker needs to go on with it."""

    settings: Settings
    done: bool
    seconds: dict[str, float]
    checkpoint: Checkpoint


class Piece(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """What a worker has done of a run."""

    done: bool
    note: str | None
    seconds: dict[str, float]
    checkpoint: Checkpoint
    measured: Measured | None  # of a run that is done, and of a passive body


class Schedule(Protocol):
    """See `turgor.experiments.campaign.Schedule`."""

    def start(self) -> Entry | None: ...
    def end(self, entry: Entry) -> None: ...


class Display(Protocol):
    """What is told while runs go on."""

    def note(self, name: str, evaluations: int, budget: int, best: float) -> None: ...
    def finish(self, entry: Entry, measured: Measured) -> None: ...


def run_in_pieces(
    folder: Path, open_run: Callable[[Entry], Run | None], schedule: Schedule, crew: Crew, display: Display
) -> dict[Entry, Measured]:
    """What every entry of `schedule` achieved; their runs are in `folder`, where `open_run` finds those begun before.

    Raises what `Crew.wait` raises, once every run has kept what came of it.
    """
    under_way: dict[Entry, Run | None] = {}
    found: dict[Entry, Measured] = {}
    try:
        with _reports(crew) as reports:
            while True:
                while crew.jobs < max(crew.workers, 1) and (entry := schedule.start()) is not None:
                    run, stand = _taken_up(folder, entry, open_run(entry))
                    under_way[entry] = run
                    crew.give(entry, work, crew.topic, entry, stand, crew.segment)
                if not crew.jobs:
                    return found
                for entry, piece in crew.wait(REPORT_INTERVAL):
                    run = under_way[entry]
                    if run is not None:
                        _keep(run, piece)
                    if piece.measured is None:
                        crew.give(entry, work, crew.topic, entry, _stand_of(run, piece.checkpoint), crew.segment)
                        continue
                    del under_way[entry]
                    found[entry] = piece.measured
                    schedule.end(entry)
                    display.finish(entry, piece.measured)
                with contextlib.suppress(queue.Empty):
                    while True:
                        display.note(*reports.get_nowait())
    finally:
        crew.drop()
        for run in under_way.values():
            _leave(run)


def work(topic: str, entry: Entry, stand: Stand | None, seconds: float) -> Piece:
    """The next `seconds` of an entry that stands at `stand`: on a worker. None: a passive body."""
    with _one_at_a_time:
        if stand is None:
            return Piece(done=True, note=None, seconds={}, checkpoint=Checkpoint(), measured=measure(entry, None))
        run = Run(entry.make_task(), stand.settings)
        run.seconds = dict(stand.seconds)
        run.go_back(stand.checkpoint)
        state = None
        if not stand.done:
            hold_blas()
            strategy = partial(CMAES, population=entry.population)
            state = evolve_a_while(run, stand.checkpoint, strategy, seconds, _Reporter(topic, entry))
        done = stand.done or run.status == "done"
        return Piece(
            done=done,
            note=run.note,
            seconds=run.seconds,
            checkpoint=Checkpoint(rows=run.rows, champion=run.champion, solver=run.solver, state=state),
            measured=measure(entry, run) if done else None,
        )


_one_at_a_time = threading.Lock()  # a worker of several threads: BLAS and its limits are the process's own


class _Reporter:
    """Tells the coordinator how far a run is."""

    def __init__(self, topic: str, entry: Entry) -> None:
        from distributed import get_worker

        self._worker, self._topic, self._name, self._told = get_worker(), topic, entry.name, 0.0

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        if now - self._told > REPORT_INTERVAL:
            self._told = now
            report = [self._name, progress.evaluations, progress.budget, progress.best]
            self._worker.log_event(self._topic, report)


@contextlib.contextmanager
def _reports(crew: Crew) -> Any:
    """A queue of what workers tell of their runs."""
    reports: queue.SimpleQueue[tuple[str, int, int, float]] = queue.SimpleQueue()
    with crew.listening(reports.put):
        yield reports


# --- on the coordinator, which alone writes -----------------------------------------------------------------------


def _taken_up(folder: Path, entry: Entry, run: Run | None) -> tuple[Run | None, Stand | None]:
    """An entry's run, new or where it was left, and where it stands; no run for a passive body."""
    if not entry.evaluations:
        return None, None
    if run is None:
        how: dict[str, Any] = {"strategy": partial(CMAES, population=entry.population), "threads": 1}
        out = folder / entry.name
        run, _ = begin(entry.make_task(), entry.evaluations, entry.seed, out, recipe=entry.recipe, **how)
        return run, _stand_of(run, Checkpoint())
    if run.status == "done":
        checkpoint = Checkpoint(rows=run.rows, champion=run.champion, solver=run.solver)
    else:
        run.claim()
        checkpoint = run.read_checkpoint()
        reopen(run, checkpoint, run.settings)
    return run, _stand_of(run, checkpoint)


def _stand_of(run: Run | None, checkpoint: Checkpoint) -> Stand:
    assert run is not None
    return Stand(
        settings=run.settings,
        done=run.status == "done",
        seconds=run.seconds,
        checkpoint=checkpoint,
    )


def _keep(run: Run, piece: Piece) -> None:
    """Writes down what came of `run`."""
    if run.status == "done":
        return
    for row in piece.checkpoint.rows[run.generation :]:
        run.add(row)
    run.champion, run.solver = piece.checkpoint.champion, piece.checkpoint.solver
    run.status, run.note = "done" if piece.done else "running", piece.note
    save(run, piece.checkpoint.state, piece.seconds)
    if piece.done:
        run.close()


def _leave(run: Run | None) -> None:
    """Writes down that `run` was left before its end."""
    if run is not None and run.status != "done":
        run.status = "interrupted"
        with contextlib.closing(run), contextlib.suppress(NotWritten):
            run.write_record()
