"""Crosschecks of runs: a champion, or all champions of a campaign, and the folder that they leave.

RUN/crosscheck/crosscheck.json                 every number, and what it came from
RUN/crosscheck/crosscheck.svg, .pdf, .png
RUN/crosscheck/replay.html                     this engine and another one, side by side

CAMPAIGN/crosscheck/runs/NAME.json             of each run, written as soon as it is known
CAMPAIGN/crosscheck/rows.csv, summary.csv
CAMPAIGN/crosscheck/crosscheck.svg, .pdf, .png
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from turgor.errors import InvalidInput, WorkLost
from turgor.experiments.rows import write_rows
from turgor.experiments.sheets import write_drawing
from turgor.fidelity.compare import (
    CONTROLLERS,
    MOVED,
    Case,
    Crosscheck,
    controllers_for,
    crosschecks,
    engines_for,
    name_of,
)
from turgor.fidelity.engines import Crew, check_engine
from turgor.fidelity.figures import draw_campaign, draw_run
from turgor.fidelity.records import (
    Record,
    Row,
    Settings,
    Subject,
    Summary,
    read_record,
    rows_of,
    subject_of,
    summarise,
    versions_of,
    write_record,
)
from turgor.files import FolderLock, write_whole, writing
from turgor.records import RECORD
from turgor.runs import Run, machine
from turgor.task import Task
from turgor.web.export import export_replays
from turgor.web.replay import facts_of_run, replay_of_recording

FOLDER = "crosscheck"  # in a run's or a campaign's
RESULT = "crosscheck.json"


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """Where crosschecks stand."""

    share: float  # of the work that is done [1]
    done: int  # runs
    total: int
    finished: Record | None  # that was finished just now
    seconds_left: float | None  # None: nothing to go by yet


Show = Callable[[Progress], object]


# --- one run ------------------------------------------------------------------------------------------------------


def crosscheck_run(
    path: Path,
    out: Path | None = None,
    *,
    repeats: int = 30,
    moved: float = MOVED,
    controllers: int = CONTROLLERS,
    engines: Sequence[str] | None = None,
    seed: int = 0,
    processes: int | None = None,
    replay: bool = True,
    progress: Show | None = None,
) -> Record:
    """The `Record` of the champion of the run in the folder `path`, written with figure and replay to `out`, by default
    PATH/crosscheck. The other arguments are those of `crosscheck`. Raises `InvalidInput`."""
    run = Run.open(path)
    champion, names = run.checked_champion(), engines_for(engines)
    case = Case(run.task, champion.theta, controllers_for(run.task, controllers, seed))
    out = path / FOLDER if out is None else out
    settings = Settings(repeats=repeats, moved=moved, controllers=len(case.ranked), seed=seed, engines=names)
    with Crew(processes) as crew, _claimed(out):
        clock = _Clock([case.task], progress)
        found = next(crosschecks([case], repeats, moved, names, crew, clock.tick))
        record = _record(subject_of(run, path.resolve().name), settings, found)
        again = (out / RESULT).exists()
        write_record(out / RESULT, record)
        write_drawing(draw_run(record, run.task.scene, found.recordings), out)
        if replay:
            write_whole(out / "replay.html", _side_by_side(run, record, found).encode())
        elif again:  # it may be an earlier champion's
            with writing(out / "replay.html"):
                (out / "replay.html").unlink(missing_ok=True)
        clock.finish(record)
    return record


def _record(subject: Subject, settings: Settings, found: Crosscheck) -> Record:
    return Record(
        subject=subject,
        settings=settings,
        versions=versions_of(settings.engines),
        machine=machine(),
        samples=found.samples,
        comparisons=found.comparisons,
    )


def _side_by_side(run: Run, record: Record, found: Crosscheck) -> str:
    """The page of the champion here and in the first other engine; the player has room for two."""
    facts, replays = facts_of_run(run), []
    for sample in record.samples[:2]:
        recording = found.recordings[sample.engine]
        facts |= {"title": name_of(sample.engine), "fitness": sample.own, "robust": float(np.median(sample.fitness))}
        replays.append(replay_of_recording(recording, run.task, solved=recording.solved, **facts))
    return export_replays(replays, f"{record.subject.title} in two engines")


# --- a campaign ---------------------------------------------------------------------------------------------------


class Found(msgspec.Struct, frozen=True, kw_only=True):
    """What the crosscheck of a campaign found."""

    rows: list[Row]
    summaries: list[Summary]
    left_out: list[str]  # a line for each run that could not be crosschecked


class _Candidate(NamedTuple):
    """A champion that waits for its crosscheck, or had it before."""

    subject: Subject
    case: Case


def crosscheck_campaign(
    folder: Path,
    out: Path | None = None,
    *,
    repeats: int = 30,
    moved: float = MOVED,
    engines: Sequence[str] | None = None,
    processes: int | None = None,
    progress: Show | None = None,
    say: Callable[[str], object] = lambda text: None,
) -> Found:
    """What the champions of all runs below `folder` are worth in other engines, as tables and a figure in `out`, by
    default FOLDER/crosscheck.

    Every run is kept as soon as it is known: the same call goes on where it was stopped, and does not run again what
    is there of the same champion, settings and versions. `say` gets a line for every run that is left out. Raises
    `InvalidInput` where there is none at all.
    """
    names = engines_for(engines)
    settings = Settings(repeats=repeats, moved=moved, controllers=0, seed=0, engines=names)
    candidates, left_out = _find(folder, names)
    for line in left_out:
        say(f"left out: {line}")
    if not candidates:
        raise InvalidInput(f"{folder}: expected runs with a champion", left_out[0])
    out = folder / FOLDER if out is None else out
    with _claimed(out):
        records = {c.subject.run: _kept(out, c.subject, settings) for c in candidates}
        waiting = [c for c in candidates if records[c.subject.run] is None]
        if len(waiting) < len(candidates):
            say(f"{len(candidates) - len(waiting)} of {len(candidates)} runs are known already")
        for name, outcome in _work(out, waiting, settings, processes, progress):
            if isinstance(outcome, Record):
                records[name] = outcome
            else:
                left_out.append(f"{name}: {outcome}")
                say(f"left out: {left_out[-1]}")
        if not any(records.values()):
            raise InvalidInput(f"{folder}: expected champions that another engine can run", left_out[-1])
        rows = [row for record in records.values() if record is not None for row in rows_of(record)]
        summaries = summarise(rows)
        write_rows(out / "rows.csv", Row, rows)
        write_rows(out / "summary.csv", Summary, summaries)
        write_drawing(draw_campaign(rows, summaries), out)
    return Found(rows=rows, summaries=summaries, left_out=left_out)


def _find(folder: Path, engines: Sequence[str]) -> tuple[list[_Candidate], list[str]]:
    """The champions of all runs below `folder`, and a line for each run that has none or cannot be crosschecked."""
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "nothing there"
        raise InvalidInput(f"{folder}: expected the folder of a run or of runs", kind)
    paths = sorted(path.parent for path in folder.rglob(RECORD))
    if not paths:
        raise InvalidInput(f"{folder}: expected the folder of a run or of runs", f"no {RECORD} in it or below")
    candidates, problems = [], []
    for path in paths:
        try:
            candidates.append(_candidate(path, path.relative_to(folder).as_posix(), engines))
        except InvalidInput as problem:
            text = str(problem)
            problems.append(text if str(path) in text else f"{path}: {text}")
    return candidates, problems


def _candidate(path: Path, name: str, engines: Sequence[str]) -> _Candidate:
    run = Run.open(path)
    if run.status == "running":
        raise InvalidInput(f"{path}: expected a run that has ended; turgor resume {path} ends one that was killed")
    subject = subject_of(run, name)
    for engine in engines:
        check_engine(engine, run.task)
    return _Candidate(subject, Case(run.task, run.checked_champion().theta, controllers_for(run.task, 0, 0)))


def _place(out: Path, subject: Subject) -> Path:
    return out / "runs" / f"{subject.run}.json"


def _kept(out: Path, subject: Subject, settings: Settings) -> Record | None:
    """The record of an earlier call; None where there is none, or it is of something else."""
    try:
        record = read_record(_place(out, subject))
    except InvalidInput:
        return None
    now = (subject, settings, versions_of(settings.engines))
    return record if (record.subject, record.settings, record.versions) == now else None


def _work(
    out: Path, candidates: Sequence[_Candidate], settings: Settings, processes: int | None, progress: Show | None
) -> Iterator[tuple[str, Record | InvalidInput]]:
    """The record of every candidate by the name of its run, once it is on disk; or why there is none."""
    clock = _Clock([c.case.task for c in candidates], progress)
    with Crew(processes) as crew:
        for subject, case in candidates:
            try:
                found = next(crosschecks([case], settings.repeats, settings.moved, settings.engines, crew, clock.tick))
            except WorkLost:
                raise
            except InvalidInput as problem:  # as where an engine loses its numbers
                clock.finish(None)
                yield subject.run, problem
                continue
            record, path = _record(subject, settings, found), _place(out, subject)
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            write_record(path, record)
            clock.finish(record)
            yield subject.run, record


# --- folders, clocks ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _claimed(out: Path) -> Generator[None]:
    """Makes the folder `out`, and keeps other processes from it; one that stays empty is taken back."""
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    lock = FolderLock(out)
    try:
        yield
    finally:
        lock.release()
        with contextlib.suppress(OSError):
            out.rmdir()


class _Clock:
    """Turns the agents of the run in hand into `Progress` of all."""

    def __init__(self, tasks: Sequence[Task], show: Show | None) -> None:
        self._work = [task.body.mass_count * task.steps for task in tasks]  # of a run, in units of its own
        self._done, self._show, self._began = 0, show, time.monotonic()

    def tick(self, agents: int, total: int) -> None:
        self._tell(sum(self._work[: self._done]) + self._work[self._done] * agents / total, None)

    def finish(self, record: Record | None) -> None:
        self._done += 1
        self._tell(sum(self._work[: self._done]), record)

    def _tell(self, work: float, finished: Record | None) -> None:
        if self._show is None:
            return
        share, seconds = work / sum(self._work), time.monotonic() - self._began
        self._show(
            Progress(
                share=share,
                done=self._done,
                total=len(self._work),
                finished=finished,
                seconds_left=seconds * (1 / share - 1) if share > 0 else None,
            )
        )
