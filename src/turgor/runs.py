"""Runs: one evolution and its durable record.

A run is a folder of files that a person can open:

    run.json          the task, every setting, versions, machine, what came out
    history.csv       a row a generation
    champion.npz      the best controller
    checkpoint.npz    the strategy's whole state: arrays, never objects
    fitness.png, champion.mp4    drawn by the command line

Every file is written under another name in the same folder, synced and renamed; history.csv grows by a row at a time.
"""

from __future__ import annotations

import csv
import importlib.metadata
import io
import os
import platform
import sys
import zipfile
import zlib
from pathlib import Path
from typing import Any, Literal, TextIO

import msgspec
import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.task import Task, task_from_json, task_to_json

FORMAT = 1
COLUMNS = ("generation", "evaluations", "best", "median", "sigma", "seconds")
PACKAGES = ("turgor", "numpy", "numba", "cma")

Row = tuple[int, int, float, float, float, float]
Status = Literal["running", "done", "interrupted", "failed"]


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """How a run evolves."""

    evaluations: int  # at least; whole generations
    seed: int
    strategy: str
    population: int
    threads: int
    sigma: float | None = None  # of the strategy at the start [1]; None: its default
    robust_repeats: int = 30
    recipe: dict[str, Any] | None = None  # arguments of `make_task`, where known


class Champion(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """The best agent so far."""

    theta: Any  # float64 [parameter]
    fitness: float
    steps: int
    solved: bool
    generation: int  # it was found in
    robust: Any = None  # [repeat], its fitness from slightly moved starts; None: not measured yet
    robust_solved: Any = None  # [repeat], bool

    def __repr__(self) -> str:
        robust = "" if self.robust_fitness is None else f", robust {self.robust_fitness:.3f}"
        return f"Champion(fitness {self.fitness:.3f}{robust}, generation {self.generation})"

    @property
    def robust_fitness(self) -> float | None:
        """Median fitness from slightly moved starts."""
        return None if self.robust is None else float(np.median(self.robust))


class Checkpoint(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A run after one of its generations."""

    generation: int
    champion: Champion | None = None
    solver: Champion | None = None
    state: dict[str, Any] | None = None  # of the strategy; None: before its first generation


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What run.json holds."""

    format: int
    status: Status
    note: str | None
    settings: Settings
    seconds: dict[str, float]
    versions: dict[str, str]
    machine: dict[str, Any]
    task: dict[str, Any]
    result: dict[str, Any] = {}  # for readers; champion.npz and history.csv are what counts


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
        self._growing: TextIO | None = None

    def __repr__(self) -> str:
        where = "in memory" if self.path is None else f"in {self.path}"
        return f"Run({self.task.name}, {self.status}, {self.evaluations} evaluations, {self.champion}, {where})"

    @classmethod
    def create(cls, task: Task, settings: Settings, path: str | os.PathLike[str] | None) -> Run:
        """A new run that records itself in `path`, a new or empty folder; None: in memory alone.

        Raises `InvalidInput` for a folder that holds something.
        """
        if path is None:
            return cls(task, settings)
        folder = Path(path)
        check_new(folder)
        folder.mkdir(parents=True, exist_ok=True)
        run = cls(task, settings, folder)
        run.write_record()
        run.rewind(0)
        return run

    @classmethod
    def open(cls, path: str | os.PathLike[str], task: Task | None = None) -> Run:
        """The run in the folder `path`. `task` is needed, and must be the same, where the run's has functions of your
        own. Raises `InvalidInput` that names the file, what was expected and what was found."""
        folder = Path(path)
        record = _read_record(folder)
        if task is None:
            task = task_from_json(record.task)
        elif msgspec.json.decode(task_to_json(task)) != record.task:
            raise InvalidInput(f"task: expected the one of {folder}", f"another one, {task.name}")
        run = cls(task, record.settings, folder)
        run.status, run.note, run.seconds, run.versions = record.status, record.note, record.seconds, record.versions
        run.rows = _read_history(folder / "history.csv")
        if (folder / "champion.npz").exists():
            arrays = read_arrays(folder / "champion.npz")
            run.champion = _champion(arrays, "", task, folder / "champion.npz")
            run.solver = _champion(arrays, "solver_", task, folder / "champion.npz")
            if run.champion is None:
                raise InvalidInput(f"{folder / 'champion.npz'}: expected the arrays of a champion", "no theta")
        return run

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
        if self._growing is not None:
            csv.writer(self._growing, lineterminator="\n").writerow(row)

    def rewind(self, generation: int) -> None:
        """Drops the history after `generation`, and has history.csv grow from there."""
        self.rows = self.rows[:generation]
        if self.path is None:
            return
        self.close()
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *self.rows])
        write_whole(self.path / "history.csv", text.getvalue().encode())
        self._growing = open(self.path / "history.csv", "a", buffering=1, encoding="ascii", newline="")  # noqa: SIM115

    def close(self) -> None:
        """Ends the growing of history.csv."""
        if self._growing is not None:
            self._growing.close()
            self._growing = None

    def write_champion(self) -> None:
        """Writes champion.npz."""
        if self.path is not None and self.champion is not None:
            arrays = {**_arrays(self.champion, ""), **_arrays(self.solver, "solver_")}
            write_arrays(self.path / "champion.npz", arrays)

    def write_checkpoint(self, state: dict[str, np.ndarray]) -> None:
        """Writes checkpoint.npz: from what `resume` goes on."""
        if self.path is not None:
            if self._growing is not None:
                os.fsync(self._growing.fileno())
            strategy = {f"strategy_{name}": value for name, value in state.items()}
            champions = {**_arrays(self.champion, "champion_"), **_arrays(self.solver, "solver_")}
            generation = np.asarray(self.generation)
            write_arrays(self.path / "checkpoint.npz", {"generation": generation, **champions, **strategy})

    def read_checkpoint(self) -> Checkpoint:
        """What checkpoint.npz holds; where there is none, the state before the first generation.

        Raises `InvalidInput`.
        """
        if self.path is None or not (self.path / "checkpoint.npz").exists():
            return Checkpoint(generation=0)
        path = self.path / "checkpoint.npz"
        arrays = read_arrays(path)
        generation = arrays.get("generation", np.array(-1))
        if generation.shape or not 0 <= generation <= self.generation:
            expected = f"{path}: expected a generation of history.csv, 0 to {self.generation}"
            raise InvalidInput(expected, describe(generation))
        return Checkpoint(
            generation=int(generation),
            champion=_champion(arrays, "champion_", self.task, path),
            solver=_champion(arrays, "solver_", self.task, path),
            state={name.removeprefix("strategy_"): a for name, a in arrays.items() if name.startswith("strategy_")},
        )

    def go_back(self, checkpoint: Checkpoint) -> None:
        """Makes history and champion what they were at `checkpoint`."""
        self.champion, self.solver = checkpoint.champion, checkpoint.solver
        self.rewind(checkpoint.generation)

    def write_record(self) -> None:
        """Writes run.json."""
        if self.path is None:
            return
        champion = self.champion
        result: dict[str, Any] = {"generations": self.generation, "evaluations": self.evaluations}
        if champion is not None:
            result |= {"fitness": champion.fitness, "robust_fitness": champion.robust_fitness}
        record = Record(
            format=FORMAT,
            status=self.status,
            note=self.note,
            settings=self.settings,
            result=result,
            seconds={name: round(value, 3) for name, value in self.seconds.items()},
            versions=self.versions,
            machine=machine(),
            task=msgspec.json.decode(task_to_json(self.task)),
        )
        fields = msgspec.to_builtins(record).items()
        lines = [f'  "{name}": {msgspec.json.encode(value).decode()}' for name, value in fields]
        write_whole(self.path / "run.json", ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def check_new(folder: Path) -> None:
    """Raises `InvalidInput` unless `folder` is new or empty."""
    if folder.exists() and not folder.is_dir():
        raise InvalidInput("out: expected a new or empty folder", f"{folder}, which is a file")
    if folder.is_dir() and any(folder.iterdir()):
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


# --- files --------------------------------------------------------------------------------------------------------


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file that is either the old one or the new one, whatever happens meanwhile."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes `arrays` as one .npz file."""
    assert not any(array.dtype.hasobject for array in arrays.values())
    data = io.BytesIO()
    np.savez(data, **arrays)  # ty: ignore[invalid-argument-type]
    write_whole(path, data.getvalue())


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file, never objects; raises `InvalidInput`."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, KeyError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error) as e:
        reason = describe(getattr(e, "strerror", None) or e)
        raise InvalidInput(f"{path}: expected arrays written by turgor", reason) from None


def _read_record(folder: Path) -> Record:
    path = folder / "run.json"
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "nothing there"
        raise InvalidInput(f"{folder}: expected the folder of a run", kind)
    try:
        raw = msgspec.json.decode(path.read_bytes())
    except FileNotFoundError:
        raise InvalidInput(f"{folder}: expected the folder of a run", "no run.json in it") from None
    except OSError as error:
        raise InvalidInput(f"{path}: expected a file that can be read", error.strerror) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{path}: expected JSON", describe(error)) from None
    found = raw.get("format") if isinstance(raw, dict) else None
    if found != FORMAT:
        raise InvalidInput(f"{path}: expected a run of format {FORMAT}", f"format {describe(found)}")
    try:
        return msgspec.convert(raw, Record)
    except msgspec.ValidationError as error:
        raise InvalidInput(f"{path}: {error}") from None


def _read_history(path: Path) -> list[Row]:
    """The rows of history.csv; a last line without an end was being written, and is left out."""
    try:
        lines = path.read_text(encoding="ascii").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "other characters"
        raise InvalidInput(f"{path}: expected a table in ASCII", reason) from None
    rows = list(csv.reader(line for line in lines if line.endswith("\n")))
    header = rows[0] if rows else []
    if tuple(header) != COLUMNS:
        raise InvalidInput(f"{path}: expected the columns {', '.join(COLUMNS)}", describe(",".join(header)))
    history: list[Row] = []
    for k, row in enumerate(rows[1:], start=1):
        try:
            generation, evaluations, *numbers = row
            best, median, sigma, seconds = (float(number) for number in numbers)
            history.append((int(generation), int(evaluations), best, median, sigma, seconds))
        except ValueError:
            raise InvalidInput(f"{path}: expected {len(COLUMNS)} numbers in row {k}", describe(",".join(row))) from None
        if history[-1][0] != k:
            raise InvalidInput(f"{path}: expected generation {k} in row {k}", describe(history[-1][0]))
    return history


def _arrays(champion: Champion | None, prefix: str) -> dict[str, np.ndarray]:
    fields = {} if champion is None else msgspec.structs.asdict(champion)
    return {prefix + name: np.asarray(value) for name, value in fields.items() if value is not None}


def _champion(arrays: dict[str, np.ndarray], prefix: str, task: Task, path: Path) -> Champion | None:
    """The inverse of `_arrays`; raises `InvalidInput` that names `path`."""
    fields: dict[str, Any] = {
        name: arrays[prefix + name] for name in Champion.__struct_fields__ if prefix + name in arrays
    }
    if "theta" not in fields:
        return None
    theta, shape = fields["theta"], (task.parameter_count,)
    if theta.shape != shape or theta.dtype != np.float64:
        found = f"{theta.dtype} {list(theta.shape)}"
        raise InvalidInput(f"{path}: expected {prefix}theta as float64 {list(shape)}", found)
    for name in ("fitness", "steps", "solved", "generation"):
        value = fields.get(name, np.zeros(0))
        if value.shape:
            raise InvalidInput(f"{path}: expected one number in {prefix}{name}", f"shape {list(value.shape)}")
        fields[name] = value.item()
    if not (np.isfinite(theta).all() and np.isfinite(fields["fitness"])):
        raise InvalidInput(f"{path}: expected finite numbers in {prefix}theta and {prefix}fitness", "NaN or infinity")
    return Champion(**fields)
