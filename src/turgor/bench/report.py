"""What comes out: rows, what they depend on, and both as a table, as CSV and as JSON."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from turgor.errors import InvalidInput, describe

PEERS = {"box2d": "Box2D 2.3", "box2d-v3": "Box2D v3"}  # other engines that run the same agent, by their rows' names


def ratio_name(peer: str) -> str:
    """The name of the rows that compare with `peer`."""
    return "peer.ratio" if peer == "box2d" else f"peer.ratio.{peer}"


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One figure. Fields that do not apply are empty."""

    name: str
    body: str = ""
    task: str = ""
    controllers: str = ""
    batch: int | None = None  # agents at once
    threads: int | None = None
    size: int | None = None  # masses of the body, or segments of the terrain, where that is what varies
    value: float
    unit: str
    what: str


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What an earlier run wrote."""

    facts: dict[str, str]  # of `environment`
    rows: list[Row]


def say(line: str) -> None:
    """Tells of the progress, on stderr."""
    print(f"turgor bench: {line}", file=sys.stderr, flush=True)


def environment() -> dict[str, str]:
    """What every row depends on: the machine by its processor, the day, the versions, other programs' load (later)."""
    from importlib.metadata import version

    from turgor import __version__
    from turgor.physics.engine import processor
    from turgor.runs import machine

    # "AMD EPYC" alone would name ten years of processors: the compiler's name for it tells them apart
    facts, compiled_for = machine(), processor()[0]
    model = re.sub(r"\((R|TM)\)|\bCPU\b", "", facts["cpu"], flags=re.IGNORECASE)
    return {
        "machine": re.sub(r"[^a-z0-9]+", "-", f"{model} {compiled_for}".lower()).strip("-"),
        "cpu": f"{' '.join(model.split())}, {compiled_for}, {facts['cores']} cores",
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "turgor": __version__,
        "python": ".".join(map(str, sys.version_info[:3])),
        "numba": version("numba"),
        "other_load": "",
    }


def machine_seconds() -> float | None:
    """Core-seconds that the whole machine has worked since it started; None where that is not told."""
    try:
        with open("/proc/stat", encoding="ascii") as file:
            user, nice, system, _, _, irq, soft, steal = map(int, file.readline().split()[1:9])
    except (OSError, ValueError):
        return None
    return (user + nice + system + irq + soft + steal) / os.sysconf("SC_CLK_TCK")


def own_seconds() -> float:
    """Core-seconds that this process and the ended ones that it started have worked."""
    return sum(os.times()[:4])


def cells(row: Row) -> list[str]:
    """A row as text."""
    fields = msgspec.structs.asdict(row) | {"value": f"{row.value:.4g}"}
    return ["" if value is None else str(value) for value in fields.values()]


def show(rows: Sequence[Row], here: dict[str, str]) -> None:
    """Prints the rows: a table on a terminal, aligned plain lines elsewhere."""
    title = f"{here['cpu']}; turgor {here['turgor']}, Python {here['python']}, Numba {here['numba']}; {here['date']}"
    if here["other_load"]:
        title += f"; other programs kept {here['other_load']} of {os.cpu_count()} cores busy"
    show_table(title, Row.__struct_fields__, [cells(row) for row in rows])


def show_comparison(rows: Sequence[Row], before: Record, here: dict[str, str]) -> None:
    """Prints every row that `before` has as well, with both figures and the new one against the old."""
    old = {identity(row): row for row in before.rows}
    pairs = [(old[identity(row)], row) for row in rows if identity(row) in old]
    title = f"against {before.facts.get('date', '?')}, turgor {before.facts.get('turgor', '?')}"
    if before.facts.get("machine") != here["machine"]:
        title += f"; ANOTHER MACHINE: {before.facts.get('cpu') or before.facts.get('machine', '?')}"
    names = ("name", "body", "task", "controllers", "batch", "threads", "size", "unit", "before", "now", "now / before")
    lines = [
        ["" if cell is None else str(cell) for cell in (*identity(now), now.unit)]
        + [f"{was.value:.4g}", f"{now.value:.4g}", f"{now.value / was.value:.3f}" if was.value else ""]
        for was, now in pairs
    ]
    left = len(rows) - len(pairs)
    show_table(title + (f"; without a figure before: {left}" if left else ""), names, lines)


def identity(row: Row) -> tuple[str | int | None, ...]:
    """What a row is a figure of."""
    return row.name, row.body, row.task, row.controllers, row.batch, row.threads, row.size


def rows_of(rows: Sequence[Row], name: str, **wanted: object) -> list[Row]:
    """The rows of a `name` whose fields are as `wanted`."""
    return [row for row in rows if row.name == name and all(getattr(row, k) == v for k, v in wanted.items())]


def show_table(title: str, names: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    if sys.stdout.isatty():
        from rich import box
        from rich.console import Console
        from rich.table import Table

        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
        for name in names:
            right = name in ("batch", "threads", "size", "value", "before", "now", "now / before")
            table.add_column(name, justify="right" if right else "left", no_wrap=name != "what")
        for line in lines:
            table.add_row(*line)
        Console().print(table)
        return
    width = [max(map(len, column)) for column in zip(names, *lines, strict=True)]
    print(title)
    with contextlib.suppress(BrokenPipeError):
        for line in (names, *lines):
            print("  ".join(cell.ljust(w) for cell, w in zip(line, width, strict=True)).rstrip())


def as_csv(rows: Sequence[Row], here: dict[str, str]) -> str:
    """The rows as CSV, each with its machine, day and versions."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*here, *Row.__struct_fields__])
    writer.writerows([*here.values(), *cells(row)] for row in rows)
    return text.getvalue()


def as_json(rows: Sequence[Row], here: dict[str, str]) -> str:
    """The same as JSON: what all rows share, and the rows."""
    return json.dumps({**here, "rows": [msgspec.structs.asdict(row) for row in rows]}, indent=1) + "\n"


def read_record(path: Path) -> Record:
    """What `as_csv` or `as_json` wrote. Raises `InvalidInput`."""
    try:
        return record_of(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInput(f"{path}: expected a file of an earlier run", error.strerror) from None
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidInput(f"{path}: expected what --csv or --json wrote", describe(error)) from None


def record_of(text: str) -> Record:
    """The same from the file's text. Raises errors of many kinds for anything else."""
    if text.lstrip().startswith("{"):
        facts = json.loads(text)
        rows = facts.pop("rows")
    else:
        rows = list(csv.DictReader(io.StringIO(text)))
        facts = {name: value for name, value in rows[0].items() if name not in Row.__struct_fields__}
        rows = [{name: line[name] for name in Row.__struct_fields__ if line.get(name)} for line in rows]
    return msgspec.convert({"facts": facts, "rows": rows}, Record, strict=False)
