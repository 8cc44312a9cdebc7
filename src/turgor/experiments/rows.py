"""Rows: what a campaign found, as tables of plain rows that are written as CSV files and read back.

Figures and report know nothing but these rows. None stands for what does not apply, an empty cell in the file. Nothing
in a row depends on the clock, on the number of cores, or on whether the campaign was interrupted.
"""

from __future__ import annotations

import csv
import io
import types
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec

from turgor.errors import InvalidInput
from turgor.files import write_whole


class Inflated(msgspec.Struct, frozen=True, kw_only=True):
    """A body under a prescribed pressure, at one moment."""

    body: str
    gas: str  # author: the amount of the published program; text: the 0.1 kg of the text
    time: float  # [s]
    pressure_ratio: float  # p / p_max [1]
    area_ratio: float  # rho = area / (pi r^2) [1]
    height: float  # of the highest above the lowest mass centre [m]


class QuasiStatic(msgspec.Struct, frozen=True, kw_only=True):
    """A body whose pressure rises slowly, at one pressure."""

    body: str
    pressure: float  # [Pa]
    lift_off: float  # n m g / (2 r) [Pa]
    pressure_max: float  # [Pa]
    area_ratio: float  # measured, under gravity on the ground [1]
    analytic: float | None  # without gravity [1]; None where it has no finite radius


class Champion(msgspec.Struct, frozen=True, kw_only=True):
    """The best agent of one run, and what is left of it when its start moves by a millionth of a metre."""

    run: str  # name of its folder; of a passive body: the name that it would have
    question: str  # rq1, rq2, studies
    task: str
    body: str
    condition: str
    change: str  # what differs from the paper preset, as in window=15; empty: nothing
    seed: int
    evaluations: int  # 0: passive, nothing evolved
    generation: int | None  # in which it was found
    best: float  # its fitness [m/s]
    robust: float  # median of its fitness over the moved starts [m/s]
    robust_low: float  # lower quartile
    robust_high: float
    starts: int  # moved starts
    solved: bool | None  # escapes from its own start; None: nothing to solve
    solved_starts: int | None  # moved starts from which it escapes
    escape_time: float | None  # median of the time to escape over these [s]
    tangled_starts: int  # moved starts that end with a wall through a spring
    tangled_steps: int  # steps with a wall through a spring, from its own start
    steps: int  # that its own evaluation took


class Start(msgspec.Struct, frozen=True, kw_only=True):
    """A champion from one moved start."""

    run: str
    start: int
    fitness: float  # [m/s]
    solved: bool | None
    time: float  # until the end [s]
    tangled: bool  # at the end


class CurvePoint(msgspec.Struct, frozen=True, kw_only=True):
    """Best fitness so far over the seeds of a cell, after a number of evaluations."""

    question: str
    task: str
    body: str
    condition: str
    change: str
    evaluations: int
    seeds: int
    median: float  # [m/s]
    std: float  # sample standard deviation [m/s]; 0 for one seed
    low: float  # worst seed
    high: float  # best seed


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Two groups of champions compared: b against a."""

    question: str
    task: str
    body: str
    measure: str  # best or robust
    a: str  # condition
    b: str
    count_a: int
    count_b: int
    median_a: float  # [m/s]
    median_b: float
    difference: float  # of the medians, b - a [m/s]
    low: float  # 95 % bootstrap interval of the difference
    high: float
    u: float  # Mann-Whitney's U of b
    p: float  # two-sided
    p_holm: float  # corrected over the comparisons of the same question and measure
    effect: float  # Vargha and Delaney's A12: how often b is better than a [1]


class Effect(msgspec.Struct, frozen=True, kw_only=True):
    """What one change does to robust fitness."""

    task: str
    change: str
    says: str  # in words
    count: int  # seeds with the change
    count_paper: int  # seeds without
    median: float  # robust fitness with the change [m/s]
    median_paper: float  # without
    difference: float  # with - without [m/s]
    low: float  # 95 % bootstrap interval
    high: float
    effect: float  # A12: how often the change is better [1]
    p: float  # Mann-Whitney, two-sided, not corrected
    solved_starts: float | None  # share of starts that escape with the change
    solved_starts_paper: float | None


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """A claim of the paper against what was measured."""

    question: str
    claim: str
    measured: str
    verdict: str  # holds, does not hold, holds only for ..., not decided


class Tables(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that a campaign found; each field is a file of its name."""

    inflation: list[Inflated] = []
    quasistatic: list[QuasiStatic] = []
    champions: list[Champion] = []
    starts: list[Start] = []
    curves: list[CurvePoint] = []
    comparisons: list[Comparison] = []
    effects: list[Effect] = []
    claims: list[Claim] = []


KINDS: dict[str, type[msgspec.Struct]] = {
    name: get_args(hint)[0] for name, hint in get_type_hints(Tables).items()
}  # row type of each table

R = TypeVar("R", bound=msgspec.Struct)


def write_tables(folder: Path, tables: Tables) -> list[Path]:
    """Writes every table as FOLDER/NAME.csv; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, kind in KINDS.items():
        write_rows(folder / f"{name}.csv", kind, getattr(tables, name))
    return [folder / f"{name}.csv" for name in KINDS]


def read_tables(folder: Path) -> Tables:
    """The tables that `write_tables` wrote. Raises `InvalidInput` that names the file."""
    tables: dict[str, Any] = {name: read_rows(folder / f"{name}.csv", kind) for name, kind in KINDS.items()}
    return Tables(**tables)


def write_rows(path: Path, kind: type[R], rows: Sequence[R]) -> None:
    """Writes a table with one header line; numbers with all their digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(kind.__struct_fields__)
    writer.writerows(["" if v is None else v for v in msgspec.structs.astuple(row)] for row in rows)
    write_whole(path, text.getvalue().encode())


def read_rows(path: Path, kind: type[R]) -> list[R]:
    """The rows of a table that `write_rows` wrote. Raises `InvalidInput` that names the file."""
    try:
        with open(path, encoding="utf-8", newline="") as file:
            lines = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInput(f"{path}: expected a table", getattr(error, "strerror", None) or str(error)) from None
    hints = get_type_hints(kind)
    try:
        return [kind(**{name: _value(line.get(name), hint) for name, hint in hints.items()}) for line in lines]
    except ValueError as error:
        raise InvalidInput(f"{path}: expected rows of {', '.join(hints)}", str(error)) from None


def _value(text: str | None, hint: Any) -> Any:
    """A cell as the type of its field; raises `ValueError`."""
    optional = isinstance(hint, types.UnionType)
    kind = next(h for h in get_args(hint) if h is not type(None)) if optional else hint
    if text is None or (text == "" and kind is not str):
        if optional and text is not None:
            return None
        raise ValueError("an empty cell")
    if kind is bool:
        return {"True": True, "False": False}[text] if text in ("True", "False") else _wrong(text)
    return kind(text)


def _wrong(text: str) -> Any:
    raise ValueError(f"{text!r} for a bool")


def markdown_table(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table of a page: one line of `heads`, then `lines`."""
    rows = [heads, ["---"] * len(heads), *lines]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
