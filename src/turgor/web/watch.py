"""One run's folder, watched: its summary, and what changed since it was last looked at.

Only plain files of sane size are read, and of a history its new rows. What run.json says is checked field by field,
because it may be anything.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from turgor.body import SIZES
from turgor.errors import LARGEST_INTEGER, InvalidInput, describe
from turgor.files import read_arrays
from turgor.records import COLUMNS, FORMATS, Row, Settings, Status
from turgor.web.guard import check_file

RECORD_BYTES, HISTORY_BYTES, CHAMPION_BYTES, CHECKPOINT_BYTES = 5_000_000, 50_000_000, 50_000_000, 500_000_000
TAIL_BYTES, NEWS_BYTES = 4_096, 200_000  # of a history: read for its last row, and of its new rows at most
QUIET = 180.0  # [s] without a new generation after which a run that does not say it ended is taken for interrupted


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A run in one row."""

    path: str  # of its folder in the served one, "" for that itself
    name: str  # of the task
    body: str  # small, medium, large, custom
    condition: str
    controller: str
    strategy: str
    seed: int
    change: str  # what the recipe has besides, as in window=15
    unit: str  # of the fitness
    fitness: float | None
    robust: float | None
    solved: bool | None  # None: nothing to solve, or not known yet
    kept: float | None  # fitness of the champion that is in its file by now
    status: Status
    note: str | None
    generation: int
    evaluations: int
    budget: int
    sigma: float | None
    modified: float  # [s] since 1970


class Event(NamedTuple):
    """What the page is told: run, rows, gone, library (ask for all of it anew)."""

    kind: str
    data: Any


# --- what is read of run.json, the rest of which may be anything ----------------------------------------------------


class RunWatch:
    """A run's folder: what it was when last looked at."""

    def __init__(self, path: str, folder: Path) -> None:
        self.summary: RunSummary | None = None
        self.problem: str | None = None
        self._path, self._folder = path, folder
        self._record: Record | None = None
        self._solved: bool | None = None
        self._kept: float | None = None
        self._row: Row | None = None  # the last one of the history
        self._offset = 0  # in the history, after its last whole row
        self._marks: tuple[Any, ...] = (None, None, None)  # times and sizes of the files

    def look(self) -> list[Event]:
        """What changed: the summary, and new rows."""
        events = []
        try:
            files = [
                check_file(self._folder / "run.json", RECORD_BYTES),
                check_file(self._folder / "history.csv", HISTORY_BYTES),
                check_file(self._folder / "champion.npz", CHAMPION_BYTES),
            ]
            marks = tuple(None if f is None else (f.st_mtime_ns, f.st_size, f.st_ino) for f in files)
            if marks != self._marks or (self.summary is not None and self.summary.status == "running"):
                events = self._read(files, marks)
        except InvalidInput as error:
            self._fail(str(error).replace(f"{self._folder}{os.sep}", ""))
        except Exception as error:  # a stranger's file, whatever is wrong with it: the others are shown
            self._fail(f"cannot be read; got {type(error).__name__}: {describe(error)}")
        return events

    def _fail(self, problem: str) -> None:
        self.summary, self.problem, self._marks = None, describe_long(problem), (None, None, None)
        self._offset, self._row = 0, None

    def _read(self, files: list[os.stat_result | None], marks: tuple[Any, ...]) -> list[Event]:
        rows: list[Row] = []
        if self._record is None or marks[0] != self._marks[0]:
            self._record = _read_record(self._folder / "run.json")
        if marks[1] != self._marks[1]:
            rows = self._read_history(files[1], self._marks[1] and marks[1] and marks[1][2] == self._marks[1][2])
        if marks[2] != self._marks[2]:
            self._kept, solved = _read_champion(self._folder / "champion.npz")
            self._solved = None if self._record.task.end is None else solved
        known = self.summary is not None
        self._marks, self.problem = marks, None
        summary = self._summarise(max(f.st_mtime for f in files if f is not None))
        events = [Event("run", summary)] if summary != self.summary else []
        self.summary = summary
        if rows and known:
            events.append(Event("rows", {"path": self._path, "rows": rows, "first": rows[0][0] - 1}))
        return events

    def _read_history(self, found: os.stat_result | None, same: bool) -> list[Row]:
        """The new rows; of a history that was not seen before, or was written anew, the last one."""
        if found is None:
            self._offset, self._row = 0, None
            return []
        with open(self._folder / "history.csv", "rb") as file:
            more = found.st_size - self._offset
            anew = not (same and self._offset and 0 <= more <= NEWS_BYTES)
            if anew:
                header = ",".join(COLUMNS).encode() + b"\n"
                if (begin := file.read(len(header))) != header[: len(begin)]:
                    raise InvalidInput(f"history.csv: expected the columns {', '.join(COLUMNS)}")
                self._row, self._offset = None, max(len(header), found.st_size - TAIL_BYTES)
            file.seek(self._offset - 1)
            before, data = file.read(1), file.read(max(found.st_size - self._offset, 0))
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        lines = whole.decode("ascii", "replace").splitlines()
        if anew:
            lines = lines[-1:] if len(lines) > 1 or before == b"\n" else []
        rows = [_parse(line) for line in lines]
        self._row = rows[-1] if rows else self._row
        return rows

    def _summarise(self, modified: float) -> RunSummary:
        record, row = self._record, self._row
        assert record is not None
        status = record.status
        if status == "running" and time.time() - modified > max(QUIET, 5 * _pace(row)):
            status = "interrupted"  # it was killed, or it would write
        recipe = record.settings.recipe or {}
        change = {
            name: v for name, v in recipe.items() if name not in ("name", "body", "condition", "seed", "controller")
        }
        robust = record.settings.robust
        changes = [f"{name}={value}" for name, value in change.items()]
        return RunSummary(
            path=self._path,
            name=describe(record.task.name),
            body=_size(record),
            condition=describe(record.task.condition),
            controller=describe(record.task.controller.type).lower(),
            strategy=describe(record.settings.strategy),
            seed=record.settings.seed,
            change=describe(", ".join([*changes, *([f"robust: {robust.told}"] if robust else [])])),
            unit="m/s" if record.task.fitness in ("progress", "distance", "elapsed") else "",
            fitness=record.result.fitness if row is None else row[2],
            robust=record.result.robust_fitness,
            solved=self._solved,
            kept=self._kept,
            status=status,
            note=None if record.note is None else describe_long(record.note),
            generation=0 if row is None else row[0],
            evaluations=0 if row is None else row[1],
            budget=record.settings.evaluations,
            sigma=record.settings.sigma if row is None else row[4],
            modified=modified,
        )


# --- what is read of run.json, the rest of which may be anything ----------------------------------------------------


class _Body(msgspec.Struct, frozen=True):
    position: list[Any] = []
    gas_amount: list[float] = []


class _Controller(msgspec.Struct, frozen=True):
    type: str = "linear"


class _Task(msgspec.Struct):
    name: str
    condition: str
    body: _Body = _Body()
    controller: _Controller = _Controller()
    fitness: str = ""
    end: Any = None


class _Result(msgspec.Struct, frozen=True):
    fitness: float | None = None
    robust_fitness: float | None = None


class Record(msgspec.Struct):
    format: int
    status: Status
    settings: Settings
    task: _Task
    note: str | None = None
    result: _Result = _Result()


# --- the library --------------------------------------------------------------------------------------------------


def _read_record(path: Path) -> Record:
    try:
        record = msgspec.json.decode(path.read_bytes(), type=Record)
    except OSError as error:
        raise InvalidInput("run.json: expected a file that can be read", error.strerror) from None
    except msgspec.ValidationError as error:
        raise InvalidInput(f"run.json: {error}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidInput("run.json: expected JSON", describe(error)) from None
    if record.format not in FORMATS:
        formats = " or ".join(str(known) for known in FORMATS)
        raise InvalidInput(f"run.json: expected a run of format {formats}", f"format {describe(record.format)}")
    return record


def _parse(line: str) -> Row:
    """A row of a history; raises `InvalidInput`."""
    try:
        generation, evaluations, *numbers = line.split(",")
        best, median, sigma, seconds = (float(number) for number in numbers)
        row = int(generation), int(evaluations), best, median, sigma, seconds
        if 0 < row[0] <= row[1] <= LARGEST_INTEGER:
            return row
    except ValueError:
        pass
    raise InvalidInput("history.csv: expected rows of six numbers", describe(line))


def _read_champion(path: Path) -> tuple[float | None, bool | None]:
    """The champion's fitness and whether it solved its task; None where the file does not tell."""
    if not path.exists():
        return None, None
    arrays = read_arrays(path, checksum=False)
    for name in ("fitness", "solved"):
        if name in arrays and (arrays[name].shape or arrays[name].dtype.kind not in "biuf"):
            raise InvalidInput(f"{path.name}: expected one number in {name}", describe(arrays[name]))
    found = {name: arrays[name].item() for name in ("fitness", "solved") if name in arrays}
    fitness, solved = found.get("fitness"), found.get("solved")
    return None if fitness is None else float(fitness), None if solved is None else bool(solved)


def _size(record: Record) -> str:
    """The name of the body's size, by the recipe or, where there is none, by masses and gas."""
    recipe, body = record.settings.recipe or {}, record.task.body
    if isinstance(recipe.get("body"), str) and recipe["body"] in SIZES:
        return recipe["body"]
    for name, size in SIZES.items():
        if len(body.position) == size["mass_count"] and body.gas_amount == [size["gas_amount"]]:
            return name
    return "custom"


def _pace(row: Row | None) -> float:
    """Mean time of a generation [s]."""
    return 0.0 if row is None else min(row[5] / row[0], 3600.0)


def describe_long(text: str) -> str:
    """`text` in one line of at most 300 characters."""
    line = " ".join(text.split())
    return line if len(line) <= 300 else line[:297] + "..."
