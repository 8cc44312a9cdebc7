"""Benchmarks: how fast the engine is, how much memory it takes, how soon it starts, how long an evolution lasts.

    turgor bench                                   everything, some minutes
    turgor bench --only kernel peer --csv results.csv
    turgor bench --compare results.csv             and what changed since then
    turgor bench --quick                           a look, in about a minute

Every row says what was measured. What is to be compared is measured in turn in one run, and the fastest of several
repeats counts: other work on the machine only ever slows things down. benchmarks/README.md explains the rows.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from turgor.bench.measuring import QUICK, Plan, Skipped
from turgor.bench.parts import PARTS
from turgor.bench.report import (
    Row,
    as_csv,
    as_json,
    cells,
    environment,
    machine_seconds,
    own_seconds,
    read_record,
    say,
    show,
    show_comparison,
)
from turgor.errors import InvalidInput, describe


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `turgor bench` to `parser`."""
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help=f"measure these: {', '.join(PARTS)}")
    parser.add_argument("--skip", nargs="+", choices=PARTS, metavar="PART", default=[], help="leave these out")
    parser.add_argument("--quick", action="store_true", help="fewer rows and shorter: for a look, not for a record")
    parser.add_argument("--csv", metavar="FILE", help="write the rows there; in a folder, to MACHINE.csv")
    parser.add_argument("--json", metavar="FILE", help="the same as JSON; in a folder, to MACHINE.json")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="show what changed since FILE, of --csv or --json")


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status of `turgor bench` with the options `argv` (None: the program's own); 2 for invalid ones."""
    parser = argparse.ArgumentParser(prog="turgor bench", description="Measure the engine on this machine.")
    add_arguments(parser)
    try:
        return run(parser.parse_args(argv))
    except InvalidInput as error:
        say(str(error))
        return 2


def run(namespace: argparse.Namespace) -> int:
    """Exit status: 0, 1 where a part failed, 130 after Ctrl-C. Raises `InvalidInput`, before anything is measured."""
    names = [name for name in PARTS if name in (namespace.only or PARTS) and name not in namespace.skip]
    if not names:
        raise InvalidInput(f"--only, --skip: expected to leave one of {', '.join(PARTS)}", "none")
    here = environment()
    files = {kind: target(getattr(namespace, kind), kind, here["machine"]) for kind in ("csv", "json")}
    before = None if namespace.compare is None else read_record(namespace.compare)
    rows: list[Row] = []
    began, busy, own = time.perf_counter(), machine_seconds(), own_seconds()
    status = measure(names, QUICK if namespace.quick else Plan(), rows)
    if busy is not None:
        other = (machine_seconds() or 0) - busy - (own_seconds() - own)
        here["other_load"] = f"{max(other / (time.perf_counter() - began), 0):.2f}"
    if rows:
        show(rows, here)
        if before is not None:
            show_comparison(rows, before, here)
        writers = {"csv": as_csv, "json": as_json}
        for kind, file in files.items():
            if file is not None:
                file.write_text(writers[kind](rows, here), encoding="utf-8")
                say(f"wrote {file}")
    return status


def measure(names: Sequence[str], plan: Plan, rows: list[Row]) -> int:
    """Exit status of measuring the parts `names`; `rows` is filled on the way. A part that fails leaves the others."""
    status = 0
    try:
        for name in names:
            try:
                for row in PARTS[name](plan):
                    rows.append(row)
                    say("  ".join(filter(None, cells(row)[:-1])))
            except Skipped as reason:
                say(f"{name}: skipped, because {reason}")
            except Exception as error:
                say(f"{name}: failed: {type(error).__name__}: {error}")
                status = 1
    except KeyboardInterrupt:
        say("interrupted; what was measured follows")
        status = 130
    return status


def target(path: str | None, kind: str, machine: str) -> Path | None:
    """The file to write; raises `InvalidInput` where that cannot be. Tried, as rights alone do not tell."""
    if path is None:
        return None
    try:
        file = Path(path) / f"{machine}.{kind}" if Path(path).is_dir() else Path(path)
        new = not file.exists()
        file.open("a").close()
        if new:
            file.resolve().unlink()  # what a link leads to, not the link
    except OSError as error:
        raise InvalidInput(
            f"--{kind}: expected a file that can be written", f"{describe(path)} ({error.strerror})"
        ) from None
    return file
