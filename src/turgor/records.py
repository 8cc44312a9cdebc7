"""Records: what the files of a run hold, how it is laid out, and what is refused when it is read.

What is read may be a stranger's: everything is checked before it is used.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from turgor.errors import LARGEST_INTEGER, InvalidInput, describe
from turgor.files import read_whole
from turgor.task import Task
from turgor.variants import Robust

FORMAT = 2  # 1: without checksums, and without the history in the checkpoint
FORMATS = (1, 2)
RECORD, HISTORY, CHAMPION = "run.json", "history.csv", "champion.npz"
CHECKPOINT, PREVIOUS = "checkpoint.npz", "checkpoint.previous.npz"
COLUMNS = ("generation", "evaluations", "best", "median", "sigma", "seconds")

MOST_REPEATS = 100_000
_RANGES = {
    "evaluations": (1, LARGEST_INTEGER),
    "seed": (0, LARGEST_INTEGER),
    "population": (1, LARGEST_INTEGER),
    "threads": (1, LARGEST_INTEGER),
    "robust_repeats": (1, MOST_REPEATS),
}
RECORD_BYTES, HISTORY_BYTES = 50_000_000, 1_000_000_000  # larger files are not read: 10 million generations

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
    robust: Robust | None = None  # in which changed worlds candidates are judged; None: in the task's own

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
                raise InvalidInput(f"{name}: expected a whole number, {low} to {high}", describe(value))
        if self.sigma is not None and not 0 < self.sigma < math.inf:
            raise InvalidInput("sigma: expected a positive number", describe(self.sigma))
        if self.robust is not None and not isinstance(self.robust, Robust):
            raise InvalidInput("robust: expected a turgor.Robust, as in Robust(worlds=5)", describe(self.robust))


class Champion(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """The best agent so far."""

    theta: Any  # float64 [parameter]
    fitness: float  # that it was chosen for: in the task's world or, of a robust run, in its generation's worlds
    steps: int  # of the run with that fitness, as is `solved`
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
        with np.errstate(over="ignore"):
            return None if self.robust is None else float(np.median(np.asarray(self.robust, dtype=np.float64)))


class Checkpoint(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A run after one of its generations."""

    rows: list[Row] = []  # its history
    champion: Champion | None = None
    solver: Champion | None = None
    state: dict[str, Any] | None = None  # of the strategy; None: before its first generation
    is_previous: bool = False  # the one before the last, which cannot be read

    @property
    def generation(self) -> int:
        return len(self.rows)


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
    history: str | None = None  # checksum of history.csv; None: it grows, or the format is 1
    result: dict[str, Any] = {}  # for readers; champion.npz and history.csv are what counts


# --- run.json -----------------------------------------------------------------------------------------------------


def record_text(record: Record) -> bytes:
    """What run.json says: a field a line, the checksum of all others last."""
    fields = msgspec.to_builtins(record)
    if record.settings.robust is None:  # so that other runs' files stay what they were before there was any
        del fields["settings"]["robust"]
    fields["checksum"] = _checksum(fields)
    lines = [f'  "{name}": {msgspec.json.encode(value).decode()}' for name, value in fields.items()]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def read_record(folder: Path) -> Record:
    """What the run.json of `folder` says; raises `InvalidInput`."""
    path = folder / RECORD
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "nothing there"
        raise InvalidInput(f"{folder}: expected the folder of a run", kind)
    try:
        raw = msgspec.json.decode(read_whole(path, RECORD_BYTES))
    except FileNotFoundError:
        raise InvalidInput(f"{folder}: expected the folder of a run", f"no {RECORD} in it") from None
    except OSError as error:
        raise InvalidInput(f"{path}: expected a file that can be read", error.strerror) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidInput(f"{path}: expected JSON", describe(error)) from None
    found = raw.get("format") if isinstance(raw, dict) else None
    if found not in FORMATS:
        formats = " or ".join(str(known) for known in FORMATS)
        raise InvalidInput(f"{path}: expected a run of format {formats}", f"format {describe(found)}")
    if found > 1 and raw.pop("checksum", None) != _checksum(raw):
        raise InvalidInput(f"{path}: expected the file that turgor wrote", "a changed one: its checksum differs")
    try:
        return msgspec.convert(raw, Record)
    except msgspec.ValidationError as error:
        raise InvalidInput(f"{path}: {error}") from None


def _checksum(fields: dict[str, Any]) -> str:
    """Of what run.json holds, however it is laid out."""
    return hashlib.sha256(msgspec.json.encode(fields)).hexdigest()


# --- history.csv --------------------------------------------------------------------------------------------------


def history_text(rows: Sequence[Row]) -> bytes:
    """What history.csv says."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
    return text.getvalue().encode()


def read_history(path: Path, checksum: str | None) -> list[Row]:
    """The rows of history.csv; a last line without an end was being written, and is left out. Raises `InvalidInput`,
    also where the `checksum` is another one."""
    try:
        data = read_whole(path, HISTORY_BYTES)
        lines = data.decode("ascii").split("\n")
        found = list(csv.reader(lines[:-1]))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInput(f"{path}: expected a table in ASCII", getattr(error, "strerror", None) or "else") from None
    header = found[0] if found else []
    if tuple(header) != COLUMNS:
        raise InvalidInput(f"{path}: expected the columns {', '.join(COLUMNS)}", describe(",".join(header)))
    rows = checked_rows(found[1:], path)
    if checksum is not None and hashlib.sha256(data).hexdigest() != checksum:
        raise InvalidInput(f"{path}: expected the table that turgor wrote", "a changed one: its checksum differs")
    return rows


def checked_rows(found: list[list[Any]], path: Path) -> list[Row]:
    """Rows of a history, of text or numbers; raises `InvalidInput` that names `path`."""
    rows: list[Row] = []
    for k, row in enumerate(found, start=1):
        try:
            generation, evaluations, *numbers = row
            best, median, sigma, seconds = (float(number) for number in numbers)
            rows.append((int(generation), int(evaluations), best, median, sigma, seconds))
        except (ValueError, TypeError, OverflowError):
            text = describe(",".join(str(value) for value in row) if isinstance(row, list) else row)
            raise InvalidInput(f"{path}: expected {len(COLUMNS)} numbers in row {k}", text) from None
        if rows[-1][0] != k:
            raise InvalidInput(f"{path}: expected generation {k} in row {k}", describe(rows[-1][0]))
        if rows[-1][1] <= (rows[-2][1] if k > 1 else 0):
            raise InvalidInput(f"{path}: expected more evaluations in row {k} than before", describe(rows[-1][1]))
    return rows


# --- champion.npz, and the champions in checkpoint.npz ------------------------------------------------------------


def champion_arrays(champion: Champion | None, prefix: str) -> dict[str, np.ndarray]:
    """The fields of a champion that are known, each as an array of its name after `prefix`; none for None."""
    fields = {} if champion is None else msgspec.structs.asdict(champion)
    return {prefix + name: np.asarray(value) for name, value in fields.items() if value is not None}


def read_champion(arrays: dict[str, np.ndarray], prefix: str, task: Task, path: Path) -> Champion | None:
    """The champion that `champion_arrays` took apart, if there was one. Raises `InvalidInput` that names `path`."""
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
        if value.shape or value.dtype.kind not in "biuf":
            raise InvalidInput(f"{path}: expected one number in {prefix}{name}", f"shape {list(value.shape)}")
        number = value.item()
        if name != "fitness" and not 0 <= number <= LARGEST_INTEGER:
            raise InvalidInput(f"{path}: expected 0 or more in {prefix}{name}", describe(number))
        fields[name] = {"fitness": float, "solved": bool}.get(name, int)(number)
    for name in ("robust", "robust_solved"):
        value = fields.get(name, np.zeros(1))
        if value.ndim != 1 or not 0 < len(value) <= MOST_REPEATS or value.dtype.kind not in "biuf":
            found = f"{value.dtype} {list(value.shape)}"
            raise InvalidInput(f"{path}: expected numbers of shape [repeat] in {prefix}{name}", found)
    if not (np.isfinite(theta).all() and np.isfinite(fields["fitness"])):
        raise InvalidInput(f"{path}: expected finite numbers in {prefix}theta and {prefix}fitness", "NaN or infinity")
    return Champion(**fields)
