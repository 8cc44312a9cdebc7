"""Benchmarks: how fast the engine is, how much memory it takes, how soon it starts, how long an evolution lasts.

    turgor bench                                   everything, some minutes
    turgor bench --only kernel peer --csv results.csv
    turgor bench --compare results.csv             and what changed since then
    turgor bench --page FOLDER                     and a page with tables and figures
    turgor bench --from results.csv --page FOLDER  that page from the rows of an earlier run
    turgor bench --evogym PYTHON                   with robots of EvoGym, run by a Python that has it
    turgor bench --quick                           a look, in about a minute

Every row says what was measured. What is to be compared is measured in turn in one run, and the fastest of several
repeats counts: other work on the machine only ever slows things down. benchmarks/README.md explains the rows.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from turgor.bench.evogym import find_python
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
    record_of,
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
    parser.add_argument("--evogym", metavar="PYTHON", help="a Python that has EvoGym, for the part peer")
    parser.add_argument("--csv", metavar="FILE", help="write the rows there; in a folder, to MACHINE.csv")
    parser.add_argument("--json", metavar="FILE", help="the same as JSON; in a folder, to MACHINE.json")
    parser.add_argument("--page", type=Path, metavar="FOLDER", help="write benchmarks.md there, and figures in images")
    parser.add_argument("--from", type=Path, metavar="FILE", dest="source", help="measure nothing; take these rows")
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
    if namespace.page is not None:
        try_page(namespace.page)
    before = None if namespace.compare is None else read_record(namespace.compare)
    rows, status = [], 0
    if namespace.source is not None:
        here, rows = earlier(namespace, here)
    else:
        plan = QUICK if namespace.quick else Plan()
        if "peer" in names or namespace.evogym is not None:
            plan = msgspec.structs.replace(plan, evogym=find_python(namespace.evogym))
        status = measure_all(names, plan, rows, here)
    if rows:
        show(rows, here)
        if before is not None:
            show_comparison(rows, before, here)
        write_files(rows, here, files, namespace.page)
    return status


def earlier(namespace: argparse.Namespace, here: dict[str, str]) -> tuple[dict[str, str], list[Row]]:
    """What the rows of --from depend on, and the rows. Raises `InvalidInput`."""
    given = [name for name in ("only", "skip", "quick", "evogym", "csv", "json") if getattr(namespace, name)]
    if given:
        raise InvalidInput("--from: expected with --page or --compare alone", f"--{given[0]} as well")
    record = read_record(namespace.source)
    missing = here.keys() - record.facts.keys()
    if missing or not record.rows:
        expected = f"{namespace.source}: expected what --csv or --json wrote"
        raise InvalidInput(expected, f"no {', '.join(sorted(missing)) or 'rows'}")
    return record.facts, record.rows


def write_files(rows: Sequence[Row], here: dict[str, str], files: Mapping[str, Path | None], page: Path | None) -> None:
    """Writes the rows and the page; the page has the figures that a file has, so that either gives the same one."""
    writers = {"csv": as_csv, "json": as_json}
    for kind, file in files.items():
        if file is not None:
            file.write_text(writers[kind](rows, here), encoding="utf-8")
            say(f"wrote {file}")
    if page is not None:
        from turgor.bench.page import write_page

        say(f"wrote {write_page(page, record_of(as_csv(rows, here)))}")


def measure_all(names: Sequence[str], plan: Plan, rows: list[Row], here: dict[str, str]) -> int:
    """`measure`; notes in `here` what other programs did meanwhile."""
    began, busy, own = time.perf_counter(), machine_seconds(), own_seconds()
    status = measure(names, plan, rows)
    if busy is not None:
        other = (machine_seconds() or 0) - busy - (own_seconds() - own)
        here["other_load"] = f"{max(other / (time.perf_counter() - began), 0):.2f}"
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


def try_page(folder: Path) -> None:
    """Raises `InvalidInput` where no page can be written to `folder`."""
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput("--page: expected a folder", f"{describe(str(folder))} ({error.strerror})") from None
    target(str(folder / "benchmarks.md"), "page", "")


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
