"""Run folders: what is written comes back, what is not a run is told in one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from turgor.errors import InvalidInput
from turgor.evolution.loop import evolve, resume
from turgor.runs import COLUMNS, Run, free_folder, read_arrays, write_arrays, write_whole
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
    assert record["format"] == 1
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

    return change


def champion(**arrays: np.ndarray | None) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        merged = {**read_arrays(folder / "champion.npz"), **arrays}
        write_arrays(folder / "champion.npz", {k: v for k, v in merged.items() if v is not None})

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
        (lambda f: (f / "run.json").write_text("[1]"), "run.json: expected a run of format 1; got format None"),
        (edit("run.json", '"format": 1', '"format": 7'), "run.json: expected a run of format 1; got format 7"),
        (edit("run.json", '"seed":3', '"seed":"x"'), r"run.json: Expected `int`, got `str` - at `\$.settings.seed`"),
        (edit("run.json", '"condition":"pressure"', '"condition":"x"'), "task: Invalid enum value 'x'"),
        (edit("run.json", '"steps":40', '"steps":0'), "steps: expected a whole number, 1 to 10000000; got 0"),
        (lambda f: (f / "history.csv").unlink(), "history.csv: expected a table"),
        (edit("history.csv", "median", "mean"), "history.csv: expected the columns generation, "),
        (edit("history.csv", "\n2,42,", "\n2,many,"), "history.csv: expected 6 numbers in row 2; got 2,many"),
        (edit("history.csv", "\n2,42,", "\n7,42,"), "history.csv: expected generation 2 in row 2; got 7"),
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
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [f.name for f in tmp_path.iterdir()] == ["file"]
