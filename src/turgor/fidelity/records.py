"""Records of crosschecks: what crosscheck.json and the tables of a campaign hold."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from turgor.cluster.stand import own_versions
from turgor.errors import InvalidInput
from turgor.fidelity.compare import HOLDS, Comparison, Sample, Verdict, rank_correlation
from turgor.fidelity.engines import version_of
from turgor.files import read_whole, write_whole
from turgor.runs import Run
from turgor.web.replay import facts_of_run

FORMAT = 1
MOST_BYTES = 100_000_000  # of a crosscheck.json that is read
ALL = "all"  # tasks of a campaign together


class Subject(msgspec.Struct, frozen=True, kw_only=True):
    """Whose champion is crosschecked."""

    run: str  # its folder
    title: str
    unit: str  # of the fitness, with a space before it
    task: str
    body: str
    condition: str
    controller: str
    change: str  # what differs from the paper preset, as in window=15; empty: nothing
    seed: int | None
    generation: int  # the champion was found in
    dt: float  # [s], of a step
    identity: str  # of the task
    theta: str  # checksum of the champion's


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """How it is crosschecked."""

    repeats: int  # moved starts, as `turgor.perturbed` makes them
    moved: float  # [m], by so much
    controllers: int  # that are ranked: numbers uniform in [-1, 1] from NumPy's default generator
    seed: int  # of these
    engines: list[str]


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """A crosscheck and all that its numbers came from: what crosscheck.json holds."""

    format: int = FORMAT
    subject: Subject
    settings: Settings
    versions: dict[str, str]
    machine: dict[str, Any]
    samples: list[Sample]  # of this engine first
    comparisons: list[Comparison]  # of every other engine with this one

    @property
    def holds(self) -> bool:
        """Whether the champion is worth as much in every other engine."""
        return all(comparison.holds for comparison in self.comparisons)


def subject_of(run: Run, name: str) -> Subject:
    """What a record says of the champion of `run`, called `name`. Raises `InvalidInput` where there is none yet."""
    champion, facts, recipe = run.checked_champion(), facts_of_run(run), run.settings.recipe or {}
    known = ("name", "body", "condition", "seed", "controller")
    changes = [f"{key}={value}" for key, value in recipe.items() if key not in known]
    return Subject(
        run=name,
        task=facts["name"],
        **{key: facts[key] for key in ("title", "unit", "body", "condition", "controller", "seed")},
        change=" ".join([*changes, *(["robust"] if run.settings.robust else [])]),
        generation=champion.generation,
        dt=run.task.physics.dt,
        identity=run.task.identity,
        theta=hashlib.sha256(np.ascontiguousarray(champion.theta, dtype=np.float64).tobytes()).hexdigest(),
    )


def versions_of(engines: Sequence[str]) -> dict[str, str]:
    """Versions that the numbers of a crosscheck depend on, and a hash of turgor's sources."""
    return own_versions() | {engine: version_of(engine) for engine in engines}


def write_record(path: Path, record: Record) -> None:
    """Writes crosscheck.json. Raises `NotWritten`."""
    write_whole(path, msgspec.json.format(msgspec.json.encode(record)) + b"\n")


def read_record(path: Path) -> Record:
    """What a crosscheck.json says. Raises `InvalidInput` that names the file."""
    try:
        record = msgspec.json.decode(read_whole(path, MOST_BYTES), type=Record)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidInput(f"{path}: expected a crosscheck", getattr(error, "strerror", None) or str(error)) from None
    if record.format != FORMAT:
        raise InvalidInput(f"{path}: expected a crosscheck of format {FORMAT}", f"format {record.format}")
    return record


# --- a campaign's tables ------------------------------------------------------------------------------------------


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """A champion in another engine, beside what it is worth here. Medians and quartiles are over moved starts."""

    run: str
    task: str
    body: str
    condition: str
    controller: str
    change: str
    seed: int | None
    engine: str
    version: str
    repeats: int
    own_here: float  # fitness from its own start
    own: float
    median_here: float
    lower_here: float  # quartile
    upper_here: float
    median: float
    lower: float
    upper: float
    difference: float  # of the medians: there - here
    low: float  # ends of its 95 % interval
    high: float
    kept: float | None  # median / median_here; empty where that is not positive
    ks: float
    ks_p: float
    solved_here: int | None  # moved starts; empty: the task has no end
    solved: int | None
    parts: float | None  # [s] after which the trajectories are 1 cm apart; empty: never
    parts_floor: float | None  # [s], of this engine from itself
    verdict: str


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """The champions of a task in another engine."""

    task: str
    engine: str
    champions: int
    hold: int  # the same, close or stronger
    same: int
    close: int
    stronger: int
    mixed: int
    weaker: int
    not_held: int
    kept: float | None  # median over the champions of what their medians keep
    rank: float | None  # Spearman's correlation of the champions' medians; empty: fewer than 3
    solved_here: int | None  # moved starts of all champions
    solved: int | None
    starts: int  # of champions of a task with an end
    worst: str  # run whose median falls by most
    worst_here: float  # its median here
    worst_there: float


def rows_of(record: Record) -> list[Row]:
    """A row for every other engine."""
    subject, here, rows = record.subject, record.samples[0], []
    lower_here, upper_here = quartiles(here)
    same = ("run", "task", "body", "condition", "controller", "change", "seed")
    for there, c in zip(record.samples[1:], record.comparisons, strict=True):
        lower, upper = quartiles(there)
        both = ("engine", "median_here", "median", "difference", "low", "high", "kept", "ks", "ks_p", "verdict")
        row = Row(
            **{name: getattr(subject, name) for name in same},
            **{name: getattr(c, name) for name in (*both, "solved_here", "solved")},
            version=there.version,
            repeats=record.settings.repeats,
            own_here=here.own,
            own=there.own,
            lower_here=lower_here,
            upper_here=upper_here,
            lower=lower,
            upper=upper,
            parts=None if c.parts is None else c.parts * subject.dt,
            parts_floor=None if c.parts_floor is None else c.parts_floor * subject.dt,
        )
        rows.append(row)
    return rows


def quartiles(sample: Sample) -> tuple[float, float]:
    """The lower and the upper quartile of the fitness from moved starts."""
    lower, upper = np.percentile(sample.fitness, [25, 75]).tolist()
    return lower, upper


def summarise(rows: Sequence[Row]) -> list[Summary]:
    """A summary of every task in every engine, and of all tasks where there are several."""
    tasks, engines = (sorted({getattr(row, name) for row in rows}) for name in ("task", "engine"))
    cells = [(task, engine) for task in tasks + ([ALL] if len(tasks) > 1 else []) for engine in engines]
    return [
        _summary(*cell, [row for row in rows if row.engine == cell[1] and cell[0] in (row.task, ALL)]) for cell in cells
    ]


def _summary(task: str, engine: str, mine: Sequence[Row]) -> Summary:
    verdicts: list[Any] = [row.verdict for row in mine]
    kept = [row.kept for row in mine if row.kept is not None]
    worst = min(mine, key=lambda row: row.difference)

    def count(*names: Verdict) -> int:
        return sum(verdict in names for verdict in verdicts)

    def solved(name: str) -> int | None:
        known = [getattr(row, name) for row in mine if getattr(row, name) is not None]
        return sum(known) if known else None

    return Summary(
        task=task,
        engine=engine,
        champions=len(mine),
        hold=count(*HOLDS),
        same=count("the same"),
        close=count("close"),
        stronger=count("stronger"),
        mixed=count("mixed"),
        weaker=count("weaker"),
        not_held=count("does not hold"),
        kept=float(np.median(kept)) if kept else None,
        rank=rank_correlation([row.median_here for row in mine], [row.median for row in mine]),
        solved_here=solved("solved_here"),
        solved=solved("solved"),
        starts=sum(row.repeats for row in mine if row.solved is not None),
        worst=worst.run,
        worst_here=worst.median_here,
        worst_there=worst.median,
    )
