"""The terminal: options and their errors, output that may be piped away, progress."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from turgor.errors import InvalidInput

if TYPE_CHECKING:
    from turgor.evolution.loop import Progress
    from turgor.experiments.campaign import Progress as Campaign
    from turgor.experiments.measure import Measured

LINE_INTERVAL = 2.0  # [s], between lines of progress in a pipe
LIVE_INTERVAL = 0.1  # [s], between redraws on a terminal


def say(text: str = "") -> None:
    """Prints a line. Where nobody reads any more, the rest is lost in silence and the work goes on."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


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
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected {name} that is finite; got {text!r}")
    return value


def add_variants(parser: Parser) -> None:
    """An option for every variant of `make_task`, with the text that stands beside its field."""
    from turgor.variants import VARIANT_GROUPS

    for group in VARIANT_GROUPS:
        options = parser.add_argument_group(f"variants: {group.__name__.lower()}")
        defaults = group()
        for name, hint in get_type_hints(group, include_extras=True).items():
            kind, text = hint.__origin__, hint.__metadata__[0].replace("None:", "default:")
            default = getattr(defaults, name)
            if default is not None:
                text += f" (default: {default if isinstance(default, str) else format(default, '.6g')})"
            options.add_argument("--" + name.replace("_", "-"), default=None, help=text, **_kind(kind))


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


class ProgressDisplay:
    """Shows the `Progress` of an evolution: a live line on a terminal, a line now and then in a pipe."""

    def __init__(self) -> None:
        self._live: Any = None
        self._bar: Any = None
        self._shown = time.monotonic()

    def __enter__(self) -> ProgressDisplay:
        if sys.stdout.isatty():
            from rich.progress import BarColumn, TextColumn
            from rich.progress import Progress as Bars

            self._live = Bars(BarColumn(bar_width=14), TextColumn("{task.description}"), auto_refresh=False)
            self._bar = self._live.add_task("starting ...", total=None)
            self._live.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._live is not None:
            self._live.refresh()
            self._live.stop()

    def __call__(self, progress: Progress) -> None:
        text = (
            f"{progress.evaluations:,}/{progress.budget:,}  best {progress.best:.3f}  median {progress.median:.3f}  "
            f"sigma {progress.sigma:.3f}  {progress.evaluations_per_second:,.0f}/s  "
            f"{_clock(progress.seconds_left)} left"
        )
        now, last = time.monotonic(), progress.evaluations >= progress.budget
        if self._live is not None:
            self._live.update(self._bar, description=text, completed=progress.evaluations, total=progress.budget)
            if last or now - self._shown > LIVE_INTERVAL:
                self._live.refresh()
                self._shown = now
        elif last or now - self._shown > LINE_INTERVAL:
            say(text)
            self._shown = now


class CampaignDisplay:
    """Shows the `Progress` of a campaign: a bar for every run under way and one for all, above them a line for each
    that is finished; in a pipe the lines alone."""

    def __init__(self) -> None:
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._whole: Any = None

    def __enter__(self) -> CampaignDisplay:
        if sys.stdout.isatty():
            from rich.progress import BarColumn, TextColumn
            from rich.progress import Progress as Bars

            self._bars = Bars(BarColumn(bar_width=14), TextColumn("{task.description}"), auto_refresh=False)
            self._whole = self._bars.add_task("starting ...", total=None)
            self._bars.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bars is not None:
            self._bars.refresh()
            self._bars.stop()

    def __call__(self, progress: Campaign) -> None:
        left = "" if progress.seconds_left is None else f"  {_clock(progress.seconds_left)} left"
        if progress.finished is not None:
            self._say(f"[{progress.done}/{progress.total}] {_outcome(progress.finished)}", left)
        if self._bars is None:
            return
        for name in [name for name in self._tasks if name not in progress.running]:
            self._bars.remove_task(self._tasks.pop(name))
        for name, (done, budget, best) in progress.running.items():
            if name not in self._tasks:
                self._tasks[name] = self._bars.add_task(name, total=budget)
            text = f"{name}  {done:,}/{budget:,}  best {best:.3f}"
            self._bars.update(self._tasks[name], completed=done, description=text)
        waiting = progress.total - progress.done - len(progress.running)
        text = f"{progress.done} of {progress.total} done, {waiting} waiting{left}"
        self._bars.update(self._whole, completed=progress.done, total=progress.total, description=text)
        self._bars.refresh()

    def _say(self, text: str, left: str) -> None:
        if self._bars is None:
            say(text + left)
        else:
            self._bars.console.print(text, markup=False, highlight=False)


def _outcome(measured: Measured) -> str:
    champion = measured.champion
    text = f"{champion.run}  best {champion.best:.3f}  robust {champion.robust:.3f} m/s"
    if champion.solved_starts is not None:
        text += f"  escapes {champion.solved_starts}/{champion.starts}"
    return text + (f"  {measured.seconds['total']:.1f} s" if measured.seconds else "")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
