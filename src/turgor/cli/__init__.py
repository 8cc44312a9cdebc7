"""The command line: a file a story, a function a command. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import sys

import turgor
from turgor.cli.bench import BENCH
from turgor.cli.champion import EVALUATE, VIDEO
from turgor.cli.command import Command, Interrupted, Parser, did_you_mean
from turgor.cli.crosscheck import CROSSCHECK
from turgor.cli.evolve import EVOLVE, RESUME
from turgor.cli.export import EXPORT
from turgor.cli.reproduce import REPRODUCE
from turgor.cli.view import VIEW
from turgor.cli.words import say
from turgor.errors import InvalidInput, one_line

INTERRUPTED = 130  # exit status, as shells have it for Ctrl-C

COMMANDS: dict[str, Command] = {
    "evolve": EVOLVE,
    "resume": RESUME,
    "evaluate": EVALUATE,
    "video": VIDEO,
    "view": VIEW,
    "export": EXPORT,
    "reproduce": REPRODUCE,
    "crosscheck": CROSSCHECK,
    "bench": BENCH,
}


def main(argv: list[str] | None = None) -> int:
    """Runs the command in `argv`, by default the process's; returns the exit status: 0, 2 for an error that is told
    in one line, 130 for Ctrl-C, 1 where a command was asked to check something that is not so."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        return _run(argv)
    except InvalidInput as error:
        return _fail(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}")
    except MemoryError:
        return _fail("expected a smaller task or fewer agents: there is not enough memory")
    except KeyboardInterrupt:
        print("turgor: interrupted", file=sys.stderr)
        return INTERRUPTED
    except SystemExit as end:  # of --help
        return end.code if isinstance(end.code, int) else 0


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        say(_help())
        return 0
    name, rest = argv[0], argv[1:]
    if name == "--version":
        say(f"turgor {turgor.__version__}")
        return 0
    if name not in COMMANDS:
        if name.startswith("-"):
            raise InvalidInput("expected a command first, as in turgor evolve", name)
        raise InvalidInput(f"there is no command {name!r}{did_you_mean(name, COMMANDS)}")
    command = COMMANDS[name]
    parser = Parser(f"turgor {name}", command.summary, command.examples)
    command.options(parser)
    try:
        return command.run(parser.parse(rest)) or 0
    except Interrupted as end:
        print(f"turgor: interrupted; {end}", file=sys.stderr)
        return INTERRUPTED


def _fail(message: str) -> int:
    print(f"turgor: error: {' '.join(one_line(message).split())}", file=sys.stderr)
    return 2


def _help() -> str:
    lines = "\n".join(f"  {name:<12}{command.summary}" for name, command in COMMANDS.items())
    return f"""usage: turgor COMMAND [options]

Simulates and evolves pressure-based soft agents: bodies of gas inside a ring of masses and springs.

commands:
{lines}

'turgor COMMAND --help' lists a command's options and their defaults; --version tells the version.

examples:
  turgor evolve                                     a small body on hilly ground, 10,000 evaluations
  turgor evolve --task escape --body large --seed 3
  turgor evaluate runs/hilly-small-pressure-s0
  turgor video runs/hilly-small-pressure-s0 --out champion.webm"""
