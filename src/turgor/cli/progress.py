"""Progress: a live picture on a terminal, a line now and then where the output is piped away."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from turgor.cli.words import say

if TYPE_CHECKING:
    from turgor.evolution.loop import Progress
    from turgor.experiments.campaign import Progress as Campaign
    from turgor.experiments.measure import Measured
    from turgor.fidelity.campaign import Progress as Crosschecks

LINE_INTERVAL = 2.0  # [s], between lines of progress in a pipe
LIVE_INTERVAL = 0.1  # [s], between redraws on a terminal


class Display:
    """A bar on a terminal, lines in a pipe; what they say is the business of the kinds below."""

    def __init__(self, *, quiet: bool = False) -> None:
        """`quiet`: shows nothing at all."""
        self._quiet = quiet
        self._bars: Any = None  # None: not on a terminal
        self._whole: Any = None  # the bar of all
        self._shown = time.monotonic()

    def __enter__(self) -> Self:
        if sys.stdout.isatty() and not self._quiet:
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

    def say(self, text: str) -> None:
        """Prints a line, above the bar where there is one."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        elif not self._quiet:
            say(text)


class ProgressDisplay(Display):
    """Shows the `Progress` of an evolution: a live line on a terminal, a line now and then in a pipe."""

    def __call__(self, progress: Progress) -> None:
        text = (
            f"{progress.evaluations:,}/{progress.budget:,}  best {progress.best:.3f}  median {progress.median:.3f}  "
            f"sigma {progress.sigma:.3f}  {progress.evaluations_per_second:,.0f}/s  "
            f"{_clock(progress.seconds_left)} left"
        )
        now, last = time.monotonic(), progress.evaluations >= progress.budget
        if self._bars is not None:
            self._bars.update(self._whole, description=text, completed=progress.evaluations, total=progress.budget)
            if last or now - self._shown > LIVE_INTERVAL:
                self._bars.refresh()
                self._shown = now
        elif last or now - self._shown > LINE_INTERVAL:
            say(text)
            self._shown = now


class CampaignDisplay(Display):
    """Shows the `Progress` of a campaign: a bar for every run under way and one for all, above them a line for each
    that is finished; in a pipe the lines alone."""

    def __init__(self) -> None:
        super().__init__()
        self._tasks: dict[str, Any] = {}

    def __call__(self, progress: Campaign) -> None:
        left = "" if progress.seconds_left is None else f"  {_clock(progress.seconds_left)} left"
        if progress.finished is not None:
            text = f"[{progress.done}/{progress.total}] {_outcome(progress.finished)}"
            self.say(text if self._bars is not None else text + left)
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


class CrosscheckDisplay(Display):
    """Shows the `Progress` of crosschecks: a bar on a terminal, above it a line for each run of a campaign that is
    finished; in a pipe these lines, and of a single run a line now and then."""

    def tick(self, done: int, total: int) -> None:
        """Shows a share of what is under way, of which nobody knows how long it takes."""
        self._show(done / max(total, 1), f"{done:,} of {total:,}")

    def __call__(self, progress: Crosschecks) -> None:
        left = "" if progress.seconds_left is None else f"  {_clock(progress.seconds_left)} left"
        if progress.total == 1:
            self._show(progress.share, f"{progress.share:.0%}{left}")
            return
        if progress.finished is not None:
            verdicts = "; ".join(str(c.verdict) for c in progress.finished.comparisons)
            text = f"[{progress.done}/{progress.total}] {progress.finished.subject.run}  {verdicts}"
            self.say(text if self._bars is not None else text + left)
        if self._bars is not None:
            self._show(progress.share, f"{progress.done} of {progress.total} runs{left}")

    def _show(self, share: float, text: str) -> None:
        """Brings the bar up to date; in a pipe, says so now and then."""
        if self._bars is not None:
            self._bars.update(self._whole, completed=share, total=1.0, description=text)
            self._bars.refresh()
        elif time.monotonic() - self._shown > LINE_INTERVAL:
            self.say(text)
            self._shown = time.monotonic()


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
