"""Run folders: what is written comes back, what is not a run is told in one line."""

from __future__ import annotations

import json
import logging
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from sealing import seal

from turgor.errors import InvalidInput
from turgor.evolution import loop
from turgor.evolution.loop import Progress, evolve, resume
from turgor.files import NotWritten, read_arrays, write_arrays, write_whole
from turgor.records import COLUMNS, FORMATS
from turgor.runs import Run, free_folder
from turgor.simulate import Simulator
from turgor.task import Task, make_task


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("flat", steps=40, gravity=9.81)


@pytest.fixture(scope="module")
def made(task: Task, tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("runs") / "made"
    return evolve(task, 60, seed=3, out=out, robust_repeats=5, recipe={"name": "flat", "gravity": 9.81})


@pytest.fixture
def folder(made: Run, tmp_path: Path) -> Path:
    assert made.path is not None
    return Path(shutil.copytree(made.path, tmp_path / "run"))


def turgor(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "turgor", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_what_is_written_comes_back(made: Run, task: Task, folder: Path) -> None:
    run = Run.open(folder)
    assert run.task.identity == task.identity
    assert run.settings == made.settings
    assert run.settings.recipe == {"name": "flat", "gravity": 9.81}
    assert run.rows == made.rows
    assert list(run.history) == list(COLUMNS)
    for name, value in msgspec.structs.asdict(made.checked_champion()).items():
        assert np.array_equal(getattr(run.checked_champion(), name), value), name
    assert run.seconds == pytest.approx(made.seconds, abs=1e-3)


def test_files_can_be_opened_by_a_person(folder: Path) -> None:
    assert sorted(f.name for f in folder.iterdir()) == ["champion.npz", "checkpoint.npz", "history.csv", "run.json"]
    record = json.loads((folder / "run.json").read_text())
    assert record["format"] == 2
    assert record["status"] == "done"
    assert set(record["versions"]) == {"python", "turgor", "numpy", "numba", "cma"}
    assert set(record["machine"]) == {"cpu", "cores", "platform"}
    assert record["settings"]["population"] == 21
    assert record["task"]["physics"]["gravity"] == 9.81
    assert (folder / "history.csv").read_text().splitlines()[0] == ",".join(COLUMNS)
    for name in ("champion.npz", "checkpoint.npz"):
        assert all(not array.dtype.hasobject for array in read_arrays(folder / name).values())


def test_folder_that_holds_something_is_refused(task: Task, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(InvalidInput, match=r"expected a new or empty folder; got .*full, which is not empty"):
        evolve(task, 30, out=tmp_path / "full")
    with pytest.raises(InvalidInput, match="which is a file"):
        evolve(task, 30, out=tmp_path / "full" / "notes.txt")
    assert [f.name for f in (tmp_path / "full").iterdir()] == ["notes.txt"]


def test_empty_folder_is_taken(task: Task, tmp_path: Path) -> None:
    assert evolve(task, 21, out=tmp_path, robust_repeats=1).path == tmp_path


def test_free_folder_counts_on(tmp_path: Path) -> None:
    names = []
    for _ in range(3):
        path = free_folder("a", tmp_path)
        path.mkdir()
        names.append(path.name)
    assert names == ["a", "a-2", "a-3"]


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))
        if name == "run.json":
            seal(folder)

    return change


def champion(**arrays: np.ndarray | None) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        merged = {**read_arrays(folder / "champion.npz"), **arrays}
        write_arrays(folder / "champion.npz", {k: v for k, v in merged.items() if v is not None})

    return change


def flip(name: str, where: float) -> Callable[[Path], None]:
    """Turns one bit, `where` [1] of the file along."""

    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[int(where * len(data))] ^= 4
        (folder / name).write_bytes(data)

    return change


def cut(name: str, where: float) -> Callable[[Path], None]:
    """Leaves the first `where` [1] of a file, as a power cut may."""

    def change(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(where * len(data))])

    return change


def without(*names: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return change


def pickled(folder: Path) -> None:
    np.savez(folder / "champion.npz", theta=np.array([{"a": 1}], dtype=object))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda f: shutil.rmtree(f), "expected the folder of a run; got nothing there"),
        (lambda f: (f / "run.json").unlink(), "expected the folder of a run; got no run.json in it"),
        (lambda f: (f / "run.json").write_text("hello"), "run.json: expected JSON; got "),
        (lambda f: (f / "run.json").write_bytes(b"\xff\xfe{"), "run.json: expected JSON; got "),
        (lambda f: (f / "run.json").write_text("[1]"), "run.json: expected a run of format 1 or 2; got format None"),
        (edit("run.json", '"format": 2', '"format": 7'), "run.json: expected a run of format 1 or 2; got format 7"),
        (flip("run.json", 0.5), "run.json: expected (the file that turgor wrote; got a changed one|JSON)"),
        (cut("run.json", 0.9), "run.json: expected JSON"),
        (edit("run.json", '"seed":3', '"seed":"x"'), r"run.json: Expected `int`, got `str` - at `\$.settings.seed`"),
        (edit("run.json", '"condition":"pressure"', '"condition":"x"'), "task: Invalid enum value 'x'"),
        (edit("run.json", '"steps":40', '"steps":0'), "steps: expected a whole number, 1 to 10000000; got 0"),
        (without("history.csv"), "history.csv: expected a table in ASCII; got No such file"),
        (edit("history.csv", "median", "mean"), "history.csv: expected the columns generation, "),
        (edit("history.csv", "\n2,42,", "\n2,many,"), "history.csv: expected 6 numbers in row 2; got 2,many"),
        (edit("history.csv", "\n2,42,", "\n7,42,"), "history.csv: expected generation 2 in row 2; got 7"),
        (edit("history.csv", "\n2,42,", "\n2,43,"), "history.csv: expected the table that turgor wrote; got a changed"),
        (cut("history.csv", 0.9), "history.csv: expected the table that turgor wrote; got a changed one"),
        (lambda f: (f / "champion.npz").write_bytes(b"PK no"), "champion.npz: expected arrays written by turgor"),
        (lambda f: (f / "champion.npz").write_bytes(b""), "champion.npz: expected arrays written by turgor"),
        (pickled, "champion.npz: expected arrays written by turgor"),
        (champion(theta=None), "champion.npz: expected the arrays of a champion; got no theta"),
        (champion(theta=np.zeros(7)), r"champion.npz: expected theta as float64 \[374\]; got float64 \[7\]"),
        (
            champion(theta=np.full(374, np.nan)),
            "champion.npz: expected finite numbers in theta and fitness; got NaN or infinity",
        ),
        (champion(fitness=np.array(np.nan)), "champion.npz: expected finite numbers in theta and fitness"),
        (champion(solver_theta=np.zeros(374)), r"expected one number in solver_fitness; got shape \[0\]"),
        (champion(steps=np.zeros(2)), "champion.npz: expected one number in steps"),
    ],
)
def test_what_is_not_a_run_is_told_in_one_line(folder: Path, change: Callable[[Path], None], text: str) -> None:
    (folder / "checkpoint.npz").unlink()  # it has what history.csv and champion.npz lack
    change(folder)
    with pytest.raises(InvalidInput, match=text) as error:
        Run.open(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda f: (f / "checkpoint.npz").write_bytes(b"PK no"), "checkpoint.npz: expected arrays written by turgor"),
        (
            lambda f: write_arrays(f / "checkpoint.npz", {"generation": np.array(99)}),
            "expected a generation of history",
        ),
        (lambda f: write_arrays(f / "checkpoint.npz", {"generation": np.array(2)}), "state of cma-es: expected"),
        (
            lambda f: write_arrays(f / "checkpoint.npz", {"history": np.zeros((2, 6))}),
            "generations 1 to 2 in history; got others",
        ),
        (flip("checkpoint.npz", 0.5), "checkpoint.npz: expected (the )?arrays"),
        (cut("checkpoint.npz", 0.5), "checkpoint.npz: expected arrays written by turgor"),
        (lambda f: np.savez(f / "checkpoint.npz", history=np.zeros((0, 6))), "checkpoint.npz: .*; got no checksum"),
    ],
)
def test_checkpoint_that_cannot_be_read_is_told(folder: Path, change: Callable[[Path], None], text: str) -> None:
    change(folder)
    before = (folder / "run.json").read_bytes()
    with pytest.raises(InvalidInput, match=text):
        resume(Run.open(folder), 200)
    assert (folder / "run.json").read_bytes() == before


def test_run_without_a_champion_opens(folder: Path) -> None:
    (folder / "champion.npz").unlink()
    with pytest.raises(InvalidInput, match="expected a run with a champion; got none yet"):
        Run.open(folder).checked_champion()


def test_task_with_functions_has_to_be_passed(task: Task, tmp_path: Path) -> None:
    own = msgspec.structs.replace(task, fitness=lambda out: out.com[:, 0])
    evolve(own, 21, out=tmp_path / "own", robust_repeats=1)
    with pytest.raises(InvalidInput, match="expected the task to be passed"):
        Run.open(tmp_path / "own")
    assert Run.open(tmp_path / "own", own).generation == 1
    with pytest.raises(InvalidInput, match="task: expected the one of"):
        Run.open(tmp_path / "own", task)


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    write_whole(path, b"old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(NotWritten, match=r"file: expected to be able to write it; got No space left on device"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [f.name for f in tmp_path.iterdir()] == ["file"]


# --- what is torn is taken from where it is whole ------------------------------------------------------------------


@pytest.fixture
def halfway(task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that was ended from outside after its fourth generation, each of which left a checkpoint."""
    monkeypatch.setattr(loop, "CHECKPOINT_INTERVAL", 0.0)

    def stop(progress: Progress) -> None:
        if progress.generation == 5:
            shutil.copytree(tmp_path / "under way", tmp_path / "halfway")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evolve(task, 147, seed=3, out=tmp_path / "under way", robust_repeats=5, progress=stop)
    (tmp_path / "halfway" / ".lock").unlink()
    return tmp_path / "halfway"


@pytest.fixture(scope="module")
def whole(task: Task) -> Run:
    return evolve(task, 147, seed=3, robust_repeats=5)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ([], None),
        ([cut("history.csv", 0.5)], None),
        ([without("history.csv")], "history.csv: expected a table in ASCII"),
        ([flip("history.csv", 0.5)], "|expected"),
        ([lambda f: (f / "history.csv").write_bytes(b"\0" * 500)], "history.csv: expected the columns"),
        ([cut("champion.npz", 0.5)], "champion.npz: expected arrays written by turgor"),
        ([flip("champion.npz", 0.5)], "champion.npz: expected"),
        ([cut("checkpoint.npz", 0.99)], "taken instead: checkpoint.previous.npz, generation 3"),
        ([flip("checkpoint.npz", 0.3)], "taken instead: checkpoint.previous.npz, generation 3"),
        ([without("checkpoint.npz")], None),
        ([cut("checkpoint.npz", 0.5), cut("champion.npz", 0.2), cut("history.csv", 0.3)], "generation 3"),
        ([without("checkpoint.npz", "checkpoint.previous.npz", "champion.npz")], None),
        ([without("checkpoint.npz", "checkpoint.previous.npz", "champion.npz", "history.csv")], None),
    ],
)
def test_last_state_that_is_whole_goes_on_to_the_same_bits(
    halfway: Path, whole: Run, changes: list[Callable[[Path], None]], told: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    for change in changes:
        change(halfway)
    with caplog.at_level(logging.WARNING, "turgor"):
        run = resume(Run.open(halfway))
    said = " ".join(record.getMessage() for record in caplog.records)
    assert not said if told is None else re.search(told, said)
    assert [row[:-1] for row in run.rows] == [row[:-1] for row in whole.rows]
    again = Run.open(halfway)
    for name, value in msgspec.structs.asdict(whole.checked_champion()).items():
        assert np.array_equal(getattr(again.checked_champion(), name), value), name
    files = ["champion.npz", "checkpoint.npz", "history.csv", "run.json"]
    assert sorted(f.name for f in halfway.iterdir()) == files


def test_when_no_checkpoint_is_whole_nothing_is_thrown_away(halfway: Path) -> None:
    for name in ("checkpoint.npz", "checkpoint.previous.npz"):
        cut(name, 0.7)(halfway)
    before = {f.name: f.read_bytes() for f in halfway.iterdir()}
    with pytest.raises(InvalidInput, match=r"checkpoint.npz: expected .* no other is there; without that file the run"):
        resume(Run.open(halfway))
    assert {f.name: f.read_bytes() for f in halfway.iterdir()} == before


def test_torn_checkpoint_never_takes_the_place_of_a_whole_one(halfway: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cut("checkpoint.npz", 0.5)(halfway)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop, "_carry_on", killed)
        with pytest.raises(KeyboardInterrupt):
            resume(Run.open(halfway))
    assert Run.open(halfway).read_checkpoint().generation == 3


# --- one writer ---------------------------------------------------------------------------------------------------


def test_second_writer_is_refused_with_the_process_id_of_the_first(task: Task, tmp_path: Path) -> None:
    script = (
        "import sys, time, turgor\n"
        "def wait(progress):\n"
        "    print('under way', flush=True); sys.stdin.readline()\n"
        "turgor.evolve(turgor.make_task('flat', steps=40), 63, out=sys.argv[1], progress=wait, robust_repeats=1)\n"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path / "run")], **pipes) as first:
        assert first.stdout.readline() == "under way\n"
        before = (tmp_path / "run" / "history.csv").read_bytes()
        owner = rf"no other process writes; .* got process {first.pid} on {socket.gethostname()}"
        with pytest.raises(InvalidInput, match=owner):
            resume(Run.open(tmp_path / "run"))
        with pytest.raises(InvalidInput, match="is not empty"):
            evolve(task, 30, out=tmp_path / "run")
        done = turgor("resume", tmp_path / "run")
        assert done.returncode == 2
        assert f"got process {first.pid} on" in done.stderr
        assert done.stderr.count("\n") == 1
        assert (tmp_path / "run" / "history.csv").read_bytes() == before
        first.communicate("\n" * 9, timeout=60)
    assert Run.open(tmp_path / "run").status == "done"
    assert resume(Run.open(tmp_path / "run"), 84).generation == 4  # the lock went with its owner


def test_what_another_process_wrote_meanwhile_is_not_undone(folder: Path) -> None:
    stale = Run.open(folder)
    assert resume(Run.open(folder), 105).generation == 5
    assert resume(stale, 126).generation == 6
    assert Run.open(folder).generation == 6


def test_folder_of_a_process_that_was_killed_before_it_wrote_is_taken(task: Task, tmp_path: Path) -> None:
    (tmp_path / ".lock").write_text(" 1 on elsewhere")
    (tmp_path / ".run.1.partial.json").write_text("{")
    evolve(task, 21, out=tmp_path, robust_repeats=1)
    files = ["champion.npz", "checkpoint.npz", "history.csv", "run.json"]
    assert sorted(f.name for f in tmp_path.iterdir()) == files


# --- runs of every version ----------------------------------------------------------------------------------------

VERSIONS = sorted((Path(__file__).parent / "runs").iterdir())


@pytest.mark.parametrize("version", VERSIONS, ids=[path.name for path in VERSIONS])
def test_runs_of_every_format_are_read_and_gone_on_with(version: Path, tmp_path: Path) -> None:
    """They were interrupted after four generations of sep-CMA-ES."""
    kept = Run.open(version)
    assert (kept.status, kept.generation, kept.settings.strategy) == ("interrupted", 4, "sep-cma-es")
    champion = kept.checked_champion()
    assert Simulator(kept.task).rollout(champion.theta[None]).fitness[0] == champion.fitness
    folder = Path(shutil.copytree(version, tmp_path / "run"))
    run = resume(Run.open(folder))
    anew = evolve(kept.task, 210, seed=5, strategy="sep-cma-es", robust_repeats=5)
    assert [row[:-1] for row in run.rows] == [row[:-1] for row in anew.rows]
    assert np.array_equal(Run.open(folder).checked_champion().theta, anew.checked_champion().theta)


def test_there_is_a_run_of_the_format_that_is_written() -> None:
    assert [json.loads((path / "run.json").read_text())["format"] for path in VERSIONS] == list(FORMATS)
