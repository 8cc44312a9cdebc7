"""A command: what it is called with, how its options are read, and every error in one line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from turgor.cli.words import say
from turgor.errors import LARGEST_INTEGER, InvalidInput

if TYPE_CHECKING:
    import msgspec

    from turgor.variants import Robust


class Command(NamedTuple):
    """What a command is called with, and what it does."""

    summary: str
    examples: str
    options: Callable[[Parser], None]
    run: Callable[[argparse.Namespace], int | None]  # exit status; None: 0


class Interrupted(Exception):
    """Ctrl-C, with what became of the work."""


class Parser(argparse.ArgumentParser):
    """Options of one command; every error is an `InvalidInput` of one line."""

    def __init__(self, prog: str, summary: str, examples: str) -> None:
        super().__init__(
            prog=prog,
            description=summary,
            epilog=examples,
            formatter_class=lambda prog: _Formatter(prog, max_help_position=34),
            allow_abbrev=False,
        )

    def parse(self, argv: list[str]) -> argparse.Namespace:
        """The options in `argv`; raises `InvalidInput`."""
        if any("\0" in argument for argument in argv):
            raise InvalidInput(f"{self.prog}: expected text and names of files", "a NUL character")
        for argument in argv:
            if argument.startswith("--") and argument.endswith("=--"):  # argparse would hand out an empty list
                raise InvalidInput(f"{argument[:-3]}: expected a value", "--")
        options, unknown = self.parse_known_args(argv)
        if unknown:
            name = unknown[0].partition("=")[0]
            if not name.startswith("-"):
                raise InvalidInput(f"{self.prog}: expected options", repr(name))
            raise InvalidInput(
                f"{self.prog}: there is no option {name}" + did_you_mean(name, self._option_string_actions)
            )
        return options

    def error(self, message: str) -> Any:
        message = message.replace("the following arguments are required:", f"{self.prog}: expected")
        raise InvalidInput(message.removeprefix("argument "))

    def print_help(self, file: Any = None) -> None:
        say(self.format_help().rstrip())


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """One metavar for all names of an option; no list of all options in the usage, where there are too many."""

    def add_usage(self, usage: Any, actions: Any, groups: Any, prefix: Any = None) -> None:
        positional = [action for action in actions if not action.option_strings]
        super().add_usage(
            "%(prog)s " + "".join(f"{a.metavar} " for a in positional) + "[options]", actions, groups, prefix
        )


def did_you_mean(name: str, known: Any) -> str:
    """A hint at what was meant, or at where it is told."""
    import difflib

    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else "; --help lists them"


# --- kinds of values ----------------------------------------------------------------------------------------------


def number(text: str) -> float:
    """The number in `text`."""
    return _parsed(float, text, "a number")


def whole(text: str) -> int:
    """The whole number in `text`."""
    return _parsed(int, text.replace(",", "").replace("_", ""), "a whole number")


def count(text: str) -> int:
    """The whole number from 1 on in `text`."""
    value = whole(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number, at least 1; got {value}")
    return value


def _parsed(kind: Callable[[str], Any], text: str, name: str) -> Any:
    try:
        value = kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected {name}; got {text!r}") from None
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        raise argparse.ArgumentTypeError(f"expected {name} up to 2^53; got {text!r}")
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected {name} that is finite; got {text!r}")
    return value


# --- options ------------------------------------------------------------------------------------------------------


def add_threads(parser: Parser) -> None:
    """An option for the number of threads."""
    parser.add_argument("--threads", type=count, metavar="N", help="of the simulator (default: all cores)")


def add_cluster(parser: Parser, text: str) -> None:
    """An option for the cluster that does the work; `text` says what it is given."""
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help=f"{text}: tcp://HOST:PORT of a Dask scheduler, or local:N for N processes here; the same bits, whatever "
        "the workers (docs/cluster.md) (default: none)",
    )


def connected(address: str | None) -> AbstractContextManager[Any]:
    """A Dask client of the cluster at `address`; None where none is asked for. Raises `InvalidInput`."""
    if address is None:
        return nullcontext()
    from turgor.cluster.connect import connect

    return connect(address)


def add_variants(parser: Parser) -> None:
    """An option for every variant of `make_task`, with the text that stands beside its field."""
    from turgor.variants import VARIANT_GROUPS

    for group in VARIANT_GROUPS:
        _add_fields(parser.add_argument_group(f"variants: {group.__name__.lower()}"), group)


def add_robust(parser: Parser) -> None:
    """The option --robust, and one for each number of `Robust`."""
    from turgor.variants import Robust

    options = parser.add_argument_group(
        "robust evolution: each candidate runs in worlds that differ a little (docs/robustness.md)"
    )
    options.add_argument(
        "--robust", action="store_true", help="judge candidates so, as any of the options below does (default: no)"
    )
    _add_fields(options, Robust, "robust-")


def robust_of(options: argparse.Namespace) -> Robust | None:
    """The `Robust` that `options` ask for; None where they do not. Raises `InvalidInput`."""
    from turgor.variants import Robust

    given = {name: getattr(options, f"robust_{name}") for name in Robust.__struct_fields__}
    given = {name: value for name, value in given.items() if value is not None}
    return Robust(**given) if options.robust or given else None


def _add_fields(options: argparse._ArgumentGroup, group: type[msgspec.Struct], prefix: str = "") -> None:
    """An option for every field of `group`, with the text that stands beside it and its default."""
    defaults = group()
    for name, hint in get_type_hints(group, include_extras=True).items():
        kind, text = hint.__origin__, hint.__metadata__[0].replace("None:", "default:")
        default = getattr(defaults, name)
        if default is not None:
            text += f" (default: {default if isinstance(default, str) else format(default, '.6g')})"
        options.add_argument(f"--{prefix}{name.replace('_', '-')}", default=None, help=text, **_kind(kind))


def _kind(hint: Any) -> dict[str, Any]:
    """How an option of type `hint` is read and shown: float, int, Literal, or one of them or None."""
    hints = [hint, *get_args(hint)]
    for h in hints:
        if get_origin(h) is Literal:
            return {"type": _choice(get_args(h)), "metavar": "{" + ",".join(get_args(h)) + "}"}
    return {"type": whole, "metavar": "N"} if int in hints else {"type": number, "metavar": "X"}


def _choice(names: tuple[str, ...]) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in names:
            raise argparse.ArgumentTypeError(f"expected one of {', '.join(names)}; got {text!r}")
        return text

    return read
