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

import msgspec


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One figure. Fields that do not apply are empty."""

    name: str
    body: str = ""
    task: str = ""
    controllers: str = ""
    batch: int | None = None  # agents at once
    threads: int | None = None
    value: float
    unit: str
    what: str


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
    names = Row.__struct_fields__
    lines = [cells(row) for row in rows]
    if sys.stdout.isatty():
        from rich import box
        from rich.console import Console
        from rich.table import Table

        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
        for name in names:
            right = name in ("batch", "threads", "value")
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
