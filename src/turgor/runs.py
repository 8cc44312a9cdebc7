"""Runs: one evolution and its durable record.

A run is a folder of files that a person can open:

    run.json          the task, every setting, versions, machine, what came out
    history.csv       a row a generation
    champion.npz      the best controller
    checkpoint.npz    all that the run's future depends on, its history included: arrays, never objects
    checkpoint.previous.npz      the one before, while the run is under way
    fitness.png, champion.mp4    drawn by the command line

Every file has a checksum, and is written under another name in the same folder, synced and renamed; history.csv alone
grows by a row at a time. Whatever happens to it, the checkpoint has what it held.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import importlib.metadata
import os
import platform
import sys
from pathlib import Path
from typing import Any, TextIO

import msgspec
import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.files import FolderLock, is_left_over, log, read_arrays, write_arrays, write_whole, writing
from turgor.records import (
    CHAMPION,
    CHECKPOINT,
    COLUMNS,
    FORMAT,
    HISTORY,
    PREVIOUS,
    RECORD,
    Champion,
    Checkpoint,
    Record,
    Row,
    Settings,
    Status,
    champion_arrays,
    checked_rows,
    history_text,
    read_champion,
    read_history,
    read_record,
    record_text,
)
from turgor.task import Task, task_from_json, task_to_json

PACKAGES = ("turgor", "numpy", "numba", "cma")


class Run:
    """One evolution: task, settings, history and champion. With a `path`, also the files that record it."""

    def __init__(self, task: Task, settings: Settings, path: Path | None = None) -> None:
        self.task = task
        self.settings = settings
        self.path = path  # None: in memory alone
        self.status: Status = "running"
        self.note: str | None = None  # why it ended early
        self.rows: list[Row] = []
        self.champion: Champion | None = None
        self.solver: Champion | None = None  # the best of those that solved the task, where it can be solved
        self.seconds: dict[str, float] = {}  # where the time went, `total` included
        self.versions = current_versions()
        self._checksums = True  # its files have some
        self._lock: FolderLock | None = None
        self._growing: TextIO | None = None

    def __repr__(self) -> str:
        where = "in memory" if self.path is None else f"in {self.path}"
        return f"Run({self.task.name}, {self.status}, {self.evaluations} evaluations, {self.champion}, {where})"

    @classmethod
    def create(cls, task: Task, settings: Settings, path: str | os.PathLike[str] | None) -> Run:
        """A new run that records itself in `path`, a new or empty folder, and keeps other processes from it until
        `close`; None: in memory alone. Raises `InvalidInput` for a folder that holds something, or cannot be written.
        """
        if path is None:
            return cls(task, settings)
        folder = Path(path)
        check_new(folder)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        run = cls(task, settings, folder)
        run._lock = FolderLock(folder)
        try:
            check_new(folder)  # another process may have been faster
            run.write_record()
            run.rewind(0)
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def open(cls, path: str | os.PathLike[str], task: Task | None = None) -> Run:
        """The run in the folder `path`. `task` is needed, and must be the same, where the run's has functions of your
        own. A history or champion that is torn is taken from the last checkpoint, and a warning logged. Raises
        `InvalidInput` that names the file, what was expected and what was found."""
        folder = Path(path)
        record = read_record(folder)
        run = cls(task_from_json(record.task) if task is None else task, record.settings, folder)
        run._load(record)
        return run

    def claim(self) -> None:
        """Keeps other processes from writing this run until `close`, and reads what they wrote of it meanwhile.

        Raises `InvalidInput` with the process id of the one that writes it now, or as `open` does.
        """
        if self.path is None:
            return
        self._lock = FolderLock(self.path)
        try:
            self._load(read_record(self.path))
        except BaseException:
            self.close()
            raise

    def _load(self, record: Record) -> None:
        assert self.path is not None
        if msgspec.json.decode(task_to_json(self.task)) != record.task:
            raise InvalidInput(f"task: expected the one of {self.path}", f"another one, {self.task.name}")
        self.settings, self.status, self.note = record.settings, record.status, record.note
        self.seconds, self.versions = record.seconds, record.versions
        self._checksums = record.format > 1
        try:
            self.rows = read_history(self.path / HISTORY, record.history)
        except InvalidInput as error:
            checkpoint = self._rescue(error)
            if checkpoint is None and self.status != "running":
                raise
            self.rows = [] if checkpoint is None else checkpoint.rows  # none yet: it had only just begun
        self.champion = self.solver = None
        path = self.path / CHAMPION
        if not path.exists():
            return
        try:
            arrays = read_arrays(path, checksum=self._checksums)
            self.champion, self.solver = (read_champion(arrays, prefix, self.task, path) for prefix in ("", "solver_"))
            if self.champion is None:
                raise InvalidInput(f"{path}: expected the arrays of a champion", "no theta")
        except InvalidInput as error:
            checkpoint = self._rescue(error)
            if checkpoint is None or checkpoint.champion is None:
                raise
            self.champion, self.solver = checkpoint.champion, checkpoint.solver

    def _rescue(self, error: InvalidInput) -> Checkpoint | None:
        """The checkpoint that has what the file of `error` should have had; None where none can be read."""
        try:
            checkpoint = self.read_checkpoint()
        except InvalidInput:
            return None
        if checkpoint.state is None:
            return None
        log.warning("note: %s; taken from the checkpoint of generation %d instead", error, checkpoint.generation)
        return checkpoint

    @property
    def history(self) -> dict[str, np.ndarray]:
        """A column of history.csv by its name, shape [generation]: generation, evaluations, best (so far), median (of
        the generation), sigma (that the generation was drawn with), seconds (since the start)."""
        columns = list(zip(*self.rows, strict=True)) or [()] * len(COLUMNS)
        kinds = (np.int64, np.int64, *[np.float64] * 4)
        return {name: np.array(c, dtype=k) for name, c, k in zip(COLUMNS, columns, kinds, strict=True)}

    @property
    def generation(self) -> int:
        """Generations done."""
        return len(self.rows)

    @property
    def evaluations(self) -> int:
        """Evaluations done."""
        return self.rows[-1][1] if self.rows else 0

    def checked_champion(self) -> Champion:
        """The champion; raises `InvalidInput` where there is none yet."""
        if self.champion is None:
            raise InvalidInput(f"{self.path or 'run'}: expected a run with a champion", "none yet (no champion.npz)")
        return self.champion

    def add(self, row: Row) -> None:
        """Adds a generation to the history, in memory and on disk."""
        self.rows.append(row)
        if self._growing is not None and self.path is not None:
            with writing(self.path / HISTORY):
                csv.writer(self._growing, lineterminator="\n").writerow(row)

    def rewind(self, generation: int) -> None:
        """Drops the history after `generation`, and has history.csv grow from there."""
        self.rows = self.rows[:generation]
        if self.path is None:
            return
        self._stop_growing()
        path = self.path / HISTORY
        write_whole(path, history_text(self.rows))
        with writing(path):
            self._growing = open(path, "a", buffering=1, encoding="ascii", newline="")  # noqa: SIM115

    def _stop_growing(self) -> None:
        if self._growing is not None:
            with contextlib.suppress(OSError):  # a row that found no room is tried once more
                self._growing.close()
            self._growing = None

    def close(self) -> None:
        """Ends the writing, and lets other processes in."""
        self._stop_growing()
        if self._lock is not None and self.path is not None:
            if self.status == "done":
                with contextlib.suppress(OSError):
                    (self.path / PREVIOUS).unlink(missing_ok=True)
            self._lock.release()
            self._lock = None

    def write_champion(self) -> None:
        """Writes champion.npz."""
        if self.path is not None and self.champion is not None:
            arrays = {**champion_arrays(self.champion, ""), **champion_arrays(self.solver, "solver_")}
            write_arrays(self.path / CHAMPION, arrays)

    def write_checkpoint(self, state: dict[str, np.ndarray]) -> None:
        """Writes checkpoint.npz: from what `resume` goes on. The one before is kept beside it."""
        if self.path is None:
            return
        arrays = {f"strategy_{name}": value for name, value in state.items()}
        arrays |= {**champion_arrays(self.champion, "champion_"), **champion_arrays(self.solver, "solver_")}
        arrays["history"] = np.array(self.rows, dtype=np.float64).reshape(-1, len(COLUMNS))
        with writing(self.path / CHECKPOINT):
            if self._growing is not None:
                os.fsync(self._growing.fileno())
            if (self.path / CHECKPOINT).exists():
                os.replace(self.path / CHECKPOINT, self.path / PREVIOUS)
        write_arrays(self.path / CHECKPOINT, arrays)

    def read_checkpoint(self) -> Checkpoint:
        """The last checkpoint that is whole; where there is none at all, the state before the first generation.

        Raises `InvalidInput` where there are some and none of them can be read.
        """
        if self.path is None:
            return Checkpoint()
        problem = None
        for path in (self.path / CHECKPOINT, self.path / PREVIOUS):
            try:
                checkpoint = self._parse_checkpoint(path) if path.exists() else None
            except InvalidInput as error:
                problem = problem or error
                continue
            if checkpoint is not None and problem is not None:
                log.warning("note: %s; taken instead: %s, generation %d", problem, path.name, checkpoint.generation)
            if checkpoint is not None:
                return checkpoint
        if problem is not None:
            raise InvalidInput(f"{problem}; no other is there; without that file the run would be evolved anew")
        return Checkpoint()

    def _parse_checkpoint(self, path: Path) -> Checkpoint:
        arrays = read_arrays(path, checksum=self._checksums)
        if "history" in arrays:
            history = arrays["history"]
            if history.ndim != 2 or history.dtype != np.float64:
                raise InvalidInput(f"{path}: expected a table of float64 in history", str(history.dtype))
            if not np.array_equal(history[:, :1], np.arange(1, len(history) + 1)[:, None]):  # before it becomes a list
                raise InvalidInput(f"{path}: expected generations 1 to {len(history)} in history", "others")
            rows = checked_rows(history.tolist(), path)
        else:  # of format 1
            generation = arrays.get("generation", np.array(-1))
            if generation.shape or not 0 <= generation <= self.generation:
                expected = f"{path}: expected a generation of history.csv, 0 to {self.generation}"
                raise InvalidInput(expected, describe(generation))
            rows = self.rows[: int(generation)]
        return Checkpoint(
            rows=rows,
            champion=read_champion(arrays, "champion_", self.task, path),
            solver=read_champion(arrays, "solver_", self.task, path),
            state={name.removeprefix("strategy_"): a for name, a in arrays.items() if name.startswith("strategy_")},
            is_previous=path.name == PREVIOUS,
        )

    def go_back(self, checkpoint: Checkpoint) -> None:
        """Makes the files what they were at `checkpoint`; run.json last, because it says in which format they are."""
        self.rows, self.champion, self.solver = checkpoint.rows, checkpoint.champion, checkpoint.solver
        self.rewind(checkpoint.generation)
        if self.path is None:
            return
        if self.champion is None:
            with writing(self.path / CHAMPION):
                (self.path / CHAMPION).unlink(missing_ok=True)
        if checkpoint.is_previous:  # the last one is torn, and must not take this one's place
            with writing(self.path / CHECKPOINT):
                (self.path / CHECKPOINT).unlink(missing_ok=True)
        self.write_champion()
        if checkpoint.state is not None and not self._checksums:
            self.write_checkpoint(checkpoint.state)
        self._checksums = True
        self.write_record()

    def write_record(self) -> None:
        """Writes run.json."""
        if self.path is None:
            return
        champion = self.champion
        result: dict[str, Any] = {"generations": self.generation, "evaluations": self.evaluations}
        if champion is not None:
            result |= {"fitness": champion.fitness, "robust_fitness": champion.robust_fitness}
        grown = self.status != "running"
        record = Record(
            format=FORMAT,
            history=hashlib.sha256(history_text(self.rows)).hexdigest() if grown else None,
            status=self.status,
            note=self.note,
            settings=self.settings,
            result=result,
            seconds={name: round(value, 3) for name, value in self.seconds.items()},
            versions=self.versions,
            machine=machine(),
            task=msgspec.json.decode(task_to_json(self.task)),
        )
        write_whole(self.path / RECORD, record_text(record))


def check_new(folder: Path) -> None:
    """Raises `InvalidInput` unless `folder` is new or empty."""
    if folder.exists() and not folder.is_dir():
        raise InvalidInput("out: expected a new or empty folder", f"{folder}, which is a file")
    if folder.is_dir() and not all(is_left_over(path) for path in folder.iterdir()):
        raise InvalidInput("out: expected a new or empty folder", f"{folder}, which is not empty")


def free_folder(stem: str, parent: str | os.PathLike[str] = "runs") -> Path:
    """A folder in `parent` that does not exist: `stem`, or `stem`-2, `stem`-3, ..."""
    path, k = Path(parent) / stem, 1
    while path.exists():
        k += 1
        path = Path(parent) / f"{stem}-{k}"
    return path


def current_versions() -> dict[str, str]:
    """Versions that a run's bits depend on."""
    return {"python": platform.python_version(), **{name: importlib.metadata.version(name) for name in PACKAGES}}


def machine() -> dict[str, Any]:
    """The processor's model, the cores that this process may use, the platform."""
    from turgor.simulate import available_cores

    model = platform.processor() or platform.machine()
    if sys.platform == "linux":
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        model = names[0] if names else model
    return {"cpu": model, "cores": available_cores(), "platform": platform.platform()}
