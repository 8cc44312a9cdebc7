"""What lies in a folder: runs and campaigns, their summaries, and what is wrong with a broken one.

The folder may be a stranger's: only plain files of sane size are read, links are not followed, and nothing is run.
`Library.look` asks the system for the times and sizes of the files and reads what changed, of a history its new rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.experiments.rows import Champion, read_rows
from turgor.records import CHECKPOINT, COLUMNS, PREVIOUS
from turgor.runs import Run
from turgor.web.guard import Refused, check_file
from turgor.web.watch import (
    CHAMPION_BYTES,
    CHECKPOINT_BYTES,
    HISTORY_BYTES,
    RECORD_BYTES,
    Event,
    Record,
    RunSummary,
    RunWatch,
)

MARK = "campaign.json"  # as in experiments/reproduce.py, which would load the figures too
DEPTH = 4  # folders below the served one in which runs are looked for
MOST_FOLDERS, MOST_RUNS = 20_000, 5_000
TABLE_BYTES = 5_000_000
MOST_ROWS = 4_000  # of a history that are handed to the page


class CampaignSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A campaign of `turgor reproduce`, or its tables alone."""

    path: str
    runs: int
    done: int
    running: int
    tables: bool


class Group(msgspec.Struct, kw_only=True):
    """The runs of one cell of the paper's grid."""

    task: str
    body: str
    condition: str
    change: str
    fitness: list[float | None] = []
    robust: list[float | None] = []
    runs: list[str | None] = []  # their paths; None: only in the tables


class Library:
    """The runs and campaigns in a folder, and what is wrong with the others, as of the last `look`."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder).resolve()
        self.problems: dict[str, str] = {}
        self._watches: dict[str, RunWatch] = {}
        self._campaigns: dict[str, bool] = {}  # whether it has tables

    @property
    def runs(self) -> dict[str, RunSummary]:
        """Their summaries by path."""
        return {path: watch.summary for path, watch in list(self._watches.items()) if watch.summary is not None}

    @property
    def campaigns(self) -> list[CampaignSummary]:
        """The campaigns, with how many of their runs are done."""
        runs, found = self.runs, []
        for path, tables in sorted(self._campaigns.items()):
            status = [run.status for run in runs.values() if _below(run.path, path)]
            found.append(
                CampaignSummary(
                    path=path,
                    runs=len(status),
                    done=status.count("done"),
                    running=status.count("running"),
                    tables=tables,
                )
            )
        return found

    def look(self) -> list[Event]:
        """What changed since the last time."""
        problems: dict[str, str] = {}
        campaigns: dict[str, bool] = {}
        seen: set[str] = set()
        events: list[Event] = []
        for path in self._find(problems, campaigns):
            seen.add(path)
            watch = self._watches.setdefault(path, RunWatch(path, self.folder / path))
            events += watch.look()
            if watch.problem is not None:
                problems[path] = watch.problem
        for path in self._watches.keys() - seen:
            if self._watches.pop(path).summary is not None:
                events.append(Event("gone", {"path": path}))
        if (problems, campaigns) != (self.problems, self._campaigns):
            self.problems, self._campaigns = problems, campaigns
            events.append(Event("library", {}))
        return events

    def whole(self) -> dict[str, Any]:
        """All summaries."""
        return {
            "folder": self.folder.name,
            "runs": list(self.runs.values()),
            "campaigns": self.campaigns,
            "problems": [{"path": path, "message": message} for path, message in sorted(self.problems.items())],
        }

    def _find(self, problems: dict[str, str], campaigns: dict[str, bool]) -> Iterator[str]:
        """Paths of the folders that have a run.json; notes campaigns, and what cannot be looked into."""
        waiting, folders, runs = [("", 0)], 0, 0
        while waiting:
            path, depth = waiting.pop()
            folders += 1
            if folders > MOST_FOLDERS or runs >= MOST_RUNS:
                problems[""] = f"expected at most {MOST_RUNS} runs in {MOST_FOLDERS} folders: the rest is left out"
                return
            try:
                with os.scandir(self.folder / path) as entries:
                    names = {entry.name: entry for entry in entries}
            except OSError as error:
                problems[path] = f"expected a folder that can be read; got {error.strerror}"
                continue
            if "run.json" in names:
                runs += 1
                yield path
                continue
            if MARK in names or ("tables" in names and _is_file(self.folder / path / "tables" / "champions.csv")):
                campaigns[path] = _is_file(self.folder / path / "tables" / "champions.csv")
            for name, entry in sorted(names.items(), reverse=True):
                below = f"{path}/{name}" if path else name
                if not _printable(name):
                    problems[describe(ascii(below))] = "expected a name in UTF-8"
                elif entry.is_symlink():
                    if not Path(os.path.realpath(entry.path)).is_relative_to(self.folder):
                        problems[below] = "a link that leads out of the folder is not followed"
                elif depth < DEPTH and not name.startswith(".") and entry.is_dir(follow_symlinks=False):
                    waiting.append((below, depth + 1))

    def details(self, path: str) -> dict[str, Any]:
        """A run's summary, history, settings, task and champion. Raises `Refused`, `InvalidInput`."""
        summary, folder = self.summary(path), self.checked(path)
        found: dict[str, Any] = msgspec.to_builtins(summary)
        try:
            run = Run.open(folder)
        except InvalidInput as error:  # as with a task of the user's own functions: what can be told is
            found["problem"] = str(error).replace(f"{folder}{os.sep}", "")
            record = msgspec.json.decode((folder / "run.json").read_bytes(), type=Record)
            return found | {"settings": record.settings, "history": {name: [] for name in COLUMNS}}
        found["history"] = {name: column.tolist() for name, column in _thinned(run).items()}
        found["settings"] = run.settings
        found["versions"], found["seconds"] = run.versions, run.seconds
        found["task"] = _facts(run)
        champion = run.champion
        if champion is not None:
            found["champion"] = {
                "fitness": champion.fitness,
                "judged": None if run.settings.robust is None else run.settings.robust.told,
                "generation": champion.generation,
                "steps": champion.steps,
                "solved": champion.solved if run.task.end is not None else None,
                "robust": None if champion.robust is None else np.asarray(champion.robust, dtype=float).tolist(),
                "robust_solved": _solved_starts(run),
                "solver": None if run.solver is None else run.solver.fitness,
            }
        return found

    def summary(self, path: str) -> RunSummary:
        """The run's, raises `Refused` where there is none, or a broken one."""
        watch = self._watches.get(path)
        if watch is None:
            raise Refused(404, "expected the path of a run in this folder")
        if watch.summary is None:
            raise Refused(422, watch.problem or "a broken run")
        return watch.summary

    def checked(self, path: str) -> Path:
        """The folder of the run `path`, whose files are plain and not too large. Raises `Refused`."""
        self.summary(path)
        folder = self.folder / path
        try:
            check_file(folder / "run.json", RECORD_BYTES)
            check_file(folder / "history.csv", HISTORY_BYTES)
            check_file(folder / "champion.npz", CHAMPION_BYTES)
            for name in (CHECKPOINT, PREVIOUS):  # read where another file is torn
                check_file(folder / name, CHECKPOINT_BYTES)
        except InvalidInput as error:
            raise Refused(413, str(error)) from None
        return folder

    def grid(self, path: str) -> dict[str, Any]:
        """The groups of the campaign `path`. Raises `Refused`, `InvalidInput`."""
        if path not in self._campaigns:
            raise Refused(404, "expected the path of a campaign in this folder")
        groups: dict[tuple[str, ...], Group] = {}

        def add(key: tuple[str, ...], fitness: float | None, robust: float | None, run: str | None) -> None:
            task, body, condition, change = key
            group = groups.setdefault(key, Group(task=task, body=body, condition=condition, change=change))
            group.fitness.append(fitness)
            group.robust.append(robust)
            group.runs.append(run)

        runs = {run.path: run for run in self.runs.values() if _below(run.path, path)}
        if self._campaigns[path]:
            table = self.folder / path / "tables" / "champions.csv"
            check_file(table, TABLE_BYTES)
            for row in read_rows(table, Champion):
                run = runs.pop(f"{path}/{row.run}" if path else row.run, None)
                where = None if run is None else run.path
                add((row.task, row.body, row.condition, row.change), row.best, row.robust, where)
        for run in sorted(runs.values(), key=lambda run: (run.name, run.seed)):
            add((run.name, run.body, run.condition, run.change), run.fitness, run.robust, run.path)
        return {"path": path, "groups": list(groups.values())}


def _thinned(run: Run) -> dict[str, np.ndarray]:
    """The columns of the history, of a very long one rows at equal distances, the last among them."""
    count = run.generation
    kept = np.unique(np.linspace(0, count - 1, min(count, MOST_ROWS)).astype(int)) if count else slice(0)
    return {name: column[kept] for name, column in run.history.items()}


def _facts(run: Run) -> dict[str, Any]:
    """What a person wants to know of a run's task."""
    task = run.task
    return {
        "masses": task.body.mass_count,
        "springs": len(task.body.springs),
        "chambers": task.body.chamber_count,
        "parameters": task.parameter_count,
        "duration": task.duration,
        "dt": task.physics.dt,
        "fitness": task.fitness,
        "gravity": task.physics.gravity,
        "window": task.sensing.window,
        "segments": len(task.scene.segments),
        "identity": task.identity,
    }


def _solved_starts(run: Run) -> int | None:
    """From how many of the moved starts the champion solves its task; None: nothing to solve, or not measured."""
    champion = run.champion
    if champion is None or champion.robust_solved is None or run.task.end is None:
        return None
    return int(np.sum(champion.robust_solved))


def _below(path: str, folder: str) -> bool:
    return not folder or path.startswith(f"{folder}/")


def _is_file(path: Path) -> bool:
    try:
        return check_file(path, TABLE_BYTES) is not None
    except InvalidInput:
        return False


def _printable(name: str) -> bool:
    try:
        return bool(name.encode("utf-8"))
    except UnicodeEncodeError:
        return False
