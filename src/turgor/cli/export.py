"""`turgor export`: champions as one HTML file that plays offline."""

from __future__ import annotations

import argparse
from pathlib import Path

from turgor.cli.command import Command, Parser
from turgor.cli.words import say
from turgor.errors import InvalidInput


def _options(parser: Parser) -> None:
    parser.add_argument("runs", type=Path, nargs="*", metavar="RUN", help="folder of a run; two: side by side")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the page (default: replay.html or gallery.html)")
    parser.add_argument(
        "--which", choices=("best", "solver"), default="best", help="the best agent, or the best that solved the task"
    )
    parser.add_argument("--gallery", type=Path, metavar="FOLDER", help="all champions of the runs below FOLDER instead")


def _export(options: argparse.Namespace) -> None:
    if (options.gallery is None) == (not options.runs):
        raise InvalidInput("export: expected one run, two runs, or --gallery with a folder of runs")
    if len(options.runs) > 2:
        raise InvalidInput("export: expected at most two runs; --gallery shows more", str(len(options.runs)))
    path = options.out or Path("replay.html" if options.gallery is None else "gallery.html")
    if not path.parent.is_dir() or path.is_dir():
        raise InvalidInput("--out: expected a file in a folder that exists", str(path))
    from turgor.files import write_whole
    from turgor.web.export import export_folder, export_runs

    if options.gallery is None:
        page, problems = export_runs(options.runs, options.which), []
    else:
        page, problems = export_folder(options.gallery, options.which)
    write_whole(path, page.encode())
    for problem in problems:
        say(f"left out: {problem}")
    say(f"{path}, {path.stat().st_size / 1e3:,.0f} kB")


EXPORT = Command(
    "Write a champion's replay, or a gallery of many, as one HTML file that plays offline.",
    "examples:\n"
    "  turgor export runs/hilly-small-pressure-s0 --out replay.html\n"
    "  turgor export runs/hilly-small-pressure-s0 runs/hilly-small-pressure-s1\n"
    "  turgor export --gallery runs/paper --out gallery.html",
    _options,
    _export,
)
