"""`turgor view`: a page that shows a folder of runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from turgor.cli.command import Command, Parser, whole
from turgor.cli.words import say


def _view_options(parser: Parser) -> None:
    add = parser.add_argument
    add(
        "folder",
        type=Path,
        nargs="?",
        default=Path("runs"),
        metavar="FOLDER",
        help="of runs, of one run, or a campaign's (default: runs)",
    )
    add(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="to listen at; others than this machine need the token that is printed (default: 127.0.0.1)",
    )
    add("--port", type=_port, metavar="N", help="to listen at (default: 8417, or the next that is free)")
    add("--no-browser", action="store_true", help="do not open the page")


def _port(text: str) -> int:
    value = whole(text)
    if not 0 <= value <= 65535:
        raise argparse.ArgumentTypeError(f"expected a port, 1 to 65535 (0: any); got {value}")
    return value


def _view(options: argparse.Namespace) -> None:
    import webbrowser

    from turgor.web.server import serve

    open_page = None if options.no_browser else webbrowser.open
    serve(options.folder, host=options.host, port=options.port, say=say, open_page=open_page)


VIEW = Command(
    "Show runs in the browser, live while they evolve.",
    "examples:\n"
    "  turgor view\n"
    "  turgor view runs/paper\n"
    "  turgor view runs/hilly-small-pressure-s0 --no-browser\n"
    "  turgor view --host 0.0.0.0          for the phone beside you: with a token",
    _view_options,
    _view,
)
