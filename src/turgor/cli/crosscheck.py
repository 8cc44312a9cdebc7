"""`turgor crosscheck`: champions in real Box2D, and what they are worth there."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from turgor.cli.command import Command, Interrupted, Parser, count, number, whole
from turgor.cli.progress import CrosscheckDisplay
from turgor.cli.words import say
from turgor.errors import InvalidInput

if TYPE_CHECKING:
    from turgor.fidelity.campaign import Found
    from turgor.fidelity.records import Record, Summary

NOT_HELD = 1  # exit status of --check
SUITE = Path("runs/fidelity")


def _options(parser: Parser) -> None:
    add = parser.add_argument
    add("path", type=Path, nargs="?", metavar="RUN", help="folder of the run, or of a campaign: all runs below it")
    add("--repeats", type=count, default=30, metavar="N", help="moved starts, at least 2 (default: 30)")
    add("--moved", type=number, metavar="X", help="a mass of each start, by so much [m] (default: 0.001)")
    add(
        "--controllers",
        type=whole,
        metavar="N",
        help="drawn at random, to be ranked (default: 60; of a campaign the champions are ranked)",
    )
    add(
        "--engines",
        nargs="+",
        metavar="NAME",
        help="box2d (2.3, the paper's), box2d-ccd (the same with continuous collision), box2d-fine (in quarter steps), "
        "box2d-v3 (default: box2d and box2d-v3, where they are installed)",
    )
    add("--seed", type=whole, metavar="N", help="draws the controllers (default: 0)")
    add("--threads", type=count, metavar="N", help="cores to use (default: all)")
    add("--json", type=Path, metavar="FILE", help="write the result to FILE as well; - for the terminal")
    add("--no-replay", action="store_true", help="do not write replay.html, both engines side by side")
    add("--check", action="store_true", help="exit status 1 unless the run holds in every engine")
    add("--out", type=Path, metavar="FOLDER", help="for what is found (default: crosscheck in RUN)")
    add(
        "--suite",
        action="store_true",
        help="in place of a run: golden data, contacts, random controllers and a campaign's champions in every engine, "
        "as a report (default of --out: runs/fidelity)",
    )
    add("--campaign", type=Path, metavar="FOLDER", help="with --suite: whose champions (default: runs/paper)")


def _crosscheck(options: argparse.Namespace) -> int | None:
    if options.suite:
        return _suite(options)
    if options.path is None:
        raise InvalidInput("turgor crosscheck: expected RUN, the folder of a run or of a campaign")
    _refuse(options, ["campaign"], "expected with --suite alone")
    if options.repeats < 2:
        raise InvalidInput("--repeats: expected a whole number, at least 2", str(options.repeats))
    if (options.path / "run.json").exists():
        return _run(options)
    if options.path.exists() and not options.path.is_dir():
        raise InvalidInput(f"{options.path}: expected the folder of a run or of runs", "a file")
    _refuse(options, ["controllers", "seed", "check", "no_replay"], "expected of a single run")
    return _campaign(options)


def _refuse(options: argparse.Namespace, names: Sequence[str], expected: str) -> None:
    for name in names:
        value = getattr(options, name)
        if value is not None and value is not False:
            raise InvalidInput(f"--{name.replace('_', '-')}: {expected}")


# --- one run ------------------------------------------------------------------------------------------------------


def _run(options: argparse.Namespace) -> int | None:
    from turgor.fidelity.campaign import FOLDER, crosscheck_run
    from turgor.fidelity.compare import CONTROLLERS, MOVED

    quiet, out = str(options.json) == "-", options.out or options.path / FOLDER
    with CrosscheckDisplay(quiet=quiet) as display:
        record = crosscheck_run(
            options.path,
            out,
            repeats=options.repeats,
            moved=MOVED if options.moved is None else options.moved,
            controllers=CONTROLLERS if options.controllers is None else options.controllers,
            engines=options.engines,
            seed=options.seed or 0,
            processes=options.threads,
            replay=not options.no_replay,
            progress=display,
        )
    if not quiet:
        _tell(record)
        say(f"folder      {out}: {' '.join(sorted(file.name for file in out.iterdir()))}")
    _write_json(options, record)
    return NOT_HELD if options.check and not record.holds else 0


def _tell(record: Record) -> None:
    """The table, an engine a column, and the verdicts."""
    from turgor.fidelity.compare import name_of

    subject, lines = record.subject, [["", *(name_of(sample.engine) for sample in record.samples)]]
    lines += _fitness_lines(record)
    first, dt = record.comparisons[0], record.subject.dt
    lines.append(
        ["difference", "", *(f"{c.difference:+.3f} ({c.low:+.3f} to {c.high:+.3f})" for c in record.comparisons)]
    )
    lines.append(["KS distance", "", *(f"{c.ks:.2f} (p {c.ks_p:.2g})" for c in record.comparisons)])
    if record.settings.controllers:
        ranks = [first.rank_floor, *(c.rank for c in record.comparisons)]
        told = ["-" if rank is None else f"{rank:.2f}" for rank in ranks]
        lines.append([f"ranks of {record.settings.controllers}", f"{told[0]} (itself)", *told[1:]])
    if first.solved is not None:
        lines.append(["solved", f"{first.solved_here}", *(f"{c.solved}" for c in record.comparisons)])
    parts = [first.parts_floor, *(c.parts for c in record.comparisons)]
    after = ["never" if step is None else f"{step * dt:.2f} s" for step in parts]
    lines.append(["1 cm apart", f"{after[0]} (itself)", *after[1:]])
    starts = f"{record.settings.repeats} starts moved by {record.settings.moved:g} m"
    say(f"{subject.title}: champion of generation {subject.generation}, from {starts}")
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        say("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    for c in record.comparisons:
        say(f"{name_of(c.engine)}: {c.says}")


def _fitness_lines(record: Record) -> list[list[str]]:
    import numpy as np

    from turgor.fidelity.records import quartiles

    unit, ends = record.subject.unit, [quartiles(sample) for sample in record.samples]
    return [
        ["median", *(f"{np.median(sample.fitness):.3f}{unit}" for sample in record.samples)],
        ["quartiles", *(f"{lower:.3f} to {upper:.3f}" for lower, upper in ends)],
        ["own start", *(f"{sample.own:.3f}" for sample in record.samples)],
    ]


# --- a campaign ---------------------------------------------------------------------------------------------------


def _campaign(options: argparse.Namespace) -> int | None:
    from turgor.fidelity.campaign import FOLDER, crosscheck_campaign
    from turgor.fidelity.compare import MOVED

    quiet, out = str(options.json) == "-", options.out or options.path / FOLDER
    try:
        with CrosscheckDisplay(quiet=quiet) as display:
            found = crosscheck_campaign(
                options.path,
                out,
                repeats=options.repeats,
                moved=MOVED if options.moved is None else options.moved,
                engines=options.engines,
                processes=options.threads,
                progress=display,
                say=display.say,
            )
    except KeyboardInterrupt:
        raise Interrupted(f"every run that was finished is kept in {out}; the same command goes on") from None
    if not quiet:
        for summary in found.summaries:
            say(_summed_up(summary))
        say(f"folder      {out}: {' '.join(sorted(file.name for file in out.iterdir()))}")
    _write_json(options, found)
    return None


def _summed_up(summary: Summary) -> str:
    from turgor.fidelity.compare import name_of

    counts = {
        "the same": summary.same,
        "close": summary.close,
        "stronger": summary.stronger,
        "mixed": summary.mixed,
        "weaker": summary.weaker,
        "does not hold": summary.not_held,
    }
    verdicts = ", ".join(f"{verdict} {n}" for verdict, n in counts.items() if n)
    text = f"{summary.task}, {name_of(summary.engine)}: {summary.hold} of {summary.champions} hold ({verdicts})"
    if summary.kept is not None:
        text += f"; median kept {summary.kept:.0%}"
    if summary.rank is not None:
        text += f"; ranks {summary.rank:.2f}"
    if summary.solved is not None:
        text += f"; solved {summary.solved} of {summary.starts} starts, here {summary.solved_here}"
    return f"{text}; worst {summary.worst}, {summary.worst_there:.3g} there, {summary.worst_here:.3g} here"


def _write_json(options: argparse.Namespace, found: Record | Found) -> None:
    import msgspec

    from turgor.files import write_whole

    if options.json is None:
        return
    data = msgspec.json.format(msgspec.json.encode(found)) + b"\n"
    if str(options.json) == "-":
        say(data.decode().rstrip())
    else:
        write_whole(options.json, data)


# --- the suite ----------------------------------------------------------------------------------------------------


def _suite(options: argparse.Namespace) -> None:
    if options.path is not None:
        raise InvalidInput(
            "--suite: expected no RUN beside it; --campaign FOLDER says whose champions", str(options.path)
        )
    _refuse(
        options, ["moved", "controllers", "engines", "seed", "json", "check", "no_replay"], "expected without --suite"
    )
    from turgor.fidelity.suite import write_suite

    campaign, out = options.campaign or Path("runs/paper"), options.out or SUITE
    try:
        with CrosscheckDisplay() as display:
            page = write_suite(
                out, campaign=campaign, processes=options.threads, say=display.say, progress=display.tick
            )
    except KeyboardInterrupt:
        raise Interrupted(f"the same command begins again, in {out}") from None
    say(f"report      {page}")


CROSSCHECK = Command(
    "Run champions in real Box2D: are they worth as much there?",
    "examples:\n"
    "  turgor crosscheck runs/hilly-small-pressure-s0\n"
    "  turgor crosscheck runs/hilly-small-pressure-s0 --engines box2d box2d-ccd --repeats 100\n"
    "  turgor crosscheck runs/hilly-small-pressure-s0 --check         exit status 1 unless it holds\n"
    "  turgor crosscheck runs/paper\n"
    "  turgor crosscheck --suite --campaign runs/paper\n\n"
    "pip install 'turgor[box2d]' brings the engines. The crosscheck of a campaign, interrupted, goes on where it\n"
    "stopped.",
    _options,
    _crosscheck,
)
