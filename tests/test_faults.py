"""Faults for real: killed processes, full disks. A run that was hit goes on to the bits of one that was not."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from turgor.errors import InvalidInput
from turgor.evolution import loop
from turgor.evolution.loop import evolve, resume
from turgor.files import NotWritten, read_arrays
from turgor.runs import Run
from turgor.task import make_task

KILLS = int(os.environ.get("TURGOR_KILLS", "50"))
RUN: dict[str, Any] = {"evaluations": 420, "seed": 3, "strategy": "sep-cma-es", "robust_repeats": 3}
FILES = ["champion.npz", "checkpoint.npz", "history.csv", "run.json"]


def evolve_with_many_checkpoints(folder: str, begun: Any = None, strategy: str = RUN["strategy"]) -> None:
    """In a process of its own, in which every generation leaves a checkpoint."""
    loop.CHECKPOINT_INTERVAL = 0.0
    task = make_task("flat", steps=40)
    if begun is not None:
        loop._load_engine(task)
        begun.set()
    evolve(task, out=folder, **{**RUN, "strategy": strategy})


def bits(folder: Path) -> dict[str, Any]:
    """Everything in a run's folder that does not tell the time."""
    checkpoint = read_arrays(folder / "checkpoint.npz")
    checkpoint["history"] = checkpoint["history"][:, :-1]
    return {
        "champion": (folder / "champion.npz").read_bytes(),
        "history": [row.rpartition(",")[0] for row in (folder / "history.csv").read_text().splitlines()],
        "checkpoint": {name: array.tobytes() for name, array in checkpoint.items()},
        "pictures": {path.name: path.read_bytes() for path in sorted(folder.glob("[!.]*.[mp][pn][4g]"))},
    }


@pytest.fixture(scope="module")
def unharmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("faults") / "unharmed"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "CHECKPOINT_INTERVAL", 0.0)
        evolve(make_task("flat", steps=40), out=folder, **RUN)
    return folder


# --- kill -9 ------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(os.name != "posix", reason="kills with SIGKILL")
@pytest.mark.parametrize("strategy", ["cma-es", "sep-cma-es"])
def test_killed_at_random_moments_and_resumed(strategy: str, tmp_path: Path) -> None:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["turgor.evolution.loop", "turgor.evolution.cma_es", "turgor.physics.batch"])

    def begin(folder: Path) -> multiprocessing.process.BaseProcess:
        begun = context.Event()
        process = context.Process(target=evolve_with_many_checkpoints, args=(str(folder), begun, strategy))
        process.start()
        assert begun.wait(60)
        return process

    process, began = begin(tmp_path / "whole"), time.perf_counter()
    process.join()
    took, expected = time.perf_counter() - began, bits(tmp_path / "whole")
    rng, generations = np.random.default_rng(0), list[int]()
    while len(generations) < KILLS // 2:
        folder = tmp_path / "killed"
        process = begin(folder)
        time.sleep(rng.uniform(0, took))
        process.kill()
        process.join()
        if process.exitcode == 0:  # it was done by then
            shutil.rmtree(folder)
            continue
        assert process.exitcode == -signal.SIGKILL
        if (folder / "run.json").exists():
            run = Run.open(folder)
            generations.append(run.generation)
            resume_if_it_can(run)
        else:  # killed before there was anything: the folder can be used again
            generations.append(0)
            evolve(make_task("flat", steps=40), out=folder, **{**RUN, "strategy": strategy})
        assert bits(folder) == expected
        assert sorted(path.name for path in folder.iterdir()) == FILES
        shutil.rmtree(folder)
    assert len(set(generations)) > KILLS // 8  # the moments were not all the same


def resume_if_it_can(run: Run) -> None:
    """Goes on with a run; one that was killed after its last file was written has nothing left to do."""
    if run.status == "done":
        run.claim()
        run.close()
    else:
        resume(run)


@pytest.mark.skipif(os.name != "posix", reason="kills with SIGKILL")
def test_killed_again_and_again_the_command_leaves_the_same_pictures(tmp_path: Path) -> None:
    """`turgor evolve`, then `turgor resume` until it is through, each killed a little later than the last one."""

    def command(*arguments: object) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", "turgor", *map(str, arguments)]
        return subprocess.Popen(words, stdout=subprocess.DEVNULL)

    options = ("--steps", 120, "--evaluations", 2100, "--seed", 5, "--strategy", "sep-cma-es")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    began = time.perf_counter()
    assert command("evolve", *options, "--out", whole).wait() == 0
    took, kills = time.perf_counter() - began, 0
    for patience in np.arange(0.25, 1.6, 0.15) * took:
        words = ("resume", killed) if (killed / "run.json").exists() else ("evolve", *options, "--out", killed)
        process = command(*words)
        try:
            assert process.wait(timeout=patience) == 0
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
    assert kills >= 2
    assert command("resume", killed).wait() == 0  # nothing is left to do
    assert bits(killed) == bits(whole)
    assert sorted(p.name for p in killed.glob("[!.]*")) == sorted([*FILES, "champion.mp4", "fitness.png"])


# --- every write may be the last ----------------------------------------------------------------------------------


class PowerCut(BaseException):
    """The end, in which nobody tidies up."""


class Disk:
    """Calls that write, of which the `last` one and all after it end in an error."""

    def __init__(self, patch: pytest.MonkeyPatch, last: int, error: Callable[[], BaseException]) -> None:
        self.calls, self._last, self._error = 0, last, error
        calls = [(os, "fsync"), (os, "replace"), (Path, "write_bytes"), (Path, "mkdir")]
        if error is PowerCut:  # a full disk lets files be removed
            calls += [(os, "unlink"), (Path, "unlink")]
        for owner, name in calls:
            patch.setattr(owner, name, self._counted(getattr(owner, name), torn=name == "write_bytes"))
        self._locks: list[int] = []
        patch.setattr(os, "open", self._noted(os.open))

    def end(self) -> None:
        """What the system does to locks when a process is gone."""
        for handle in self._locks:
            with contextlib.suppress(OSError):
                os.close(handle)

    def _noted(self, call: Callable[..., int]) -> Callable[..., int]:
        def noted(path: Any, *arguments: Any, **options: Any) -> int:
            handle = call(path, *arguments, **options)
            if Path(path).name == ".lock":
                self._locks.append(handle)
            return handle

        return noted

    def _counted(self, call: Callable[..., Any], torn: bool) -> Callable[..., Any]:
        def counted(*arguments: Any, **options: Any) -> Any:
            self.calls += 1
            if self.calls >= self._last:
                if torn:  # half of it is on the disk
                    path, data = arguments
                    call(path, data[: len(data) // 2])
                raise self._error()
            return call(*arguments, **options)

        return counted


def full_disk() -> OSError:
    return OSError(28, "No space left on device")


@pytest.mark.parametrize("error", [full_disk, PowerCut])
def test_whichever_write_is_the_last_the_run_goes_on(
    unharmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Callable[[], BaseException]
) -> None:
    monkeypatch.setattr(loop, "CHECKPOINT_INTERVAL", 0.0)
    task, expected, rng = make_task("flat", steps=40), bits(unharmed), np.random.default_rng(1)
    with monkeypatch.context() as patch:
        disk = Disk(patch, 10**9, error)
        evolve(task, out=tmp_path / "whole", **RUN)
    assert disk.calls > 100
    for last in sorted({*range(1, 16), *range(disk.calls - 12, disk.calls + 1), *rng.integers(16, disk.calls, 12)}):
        folder = tmp_path / str(last)
        with monkeypatch.context() as patch:
            disk = Disk(patch, last, error)
            with pytest.raises((NotWritten, PowerCut)) as raised:
                evolve(task, out=folder, **RUN)
        if error is PowerCut:
            disk.end()
        if error is full_disk and (folder / "run.json").exists():
            assert f"turgor resume {folder} goes on" in str(raised.value)
            assert "No space left on device" in str(raised.value)
        if not (folder / "run.json").exists():
            evolve(task, out=folder, **RUN)
        else:
            history = folder / "history.csv"
            if error is PowerCut and history.exists() and Run.open(folder).status == "running":
                os.truncate(history, rng.integers(history.stat().st_size + 1))  # what was not synced may be gone
            resume_if_it_can(Run.open(folder))
        assert bits(folder) == expected, last
        assert sorted(path.name for path in folder.iterdir()) == FILES
        shutil.rmtree(folder)


# --- a disk that is full, a folder that is read-only ---------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Generator[Path]:
    """A disk of 1 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    if mount is None or subprocess.run([mount, "-t", "tmpfs", "-o", "size=1m", "none", folder], check=False).returncode:
        pytest.skip("expected to be allowed to mount a small disk")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_full_disk_is_told_in_one_line_and_costs_nothing(unharmed: Path, small_disk: Path) -> None:
    room = small_disk / "room"
    script = (
        "import sys, turgor\n"
        "from turgor.evolution import loop\n"
        "from turgor.cli import main\n"
        "loop.CHECKPOINT_INTERVAL = 0.0\n"
        "sys.exit(main(sys.argv[1:]))"
    )

    def command(*arguments: object) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "-c", script, *map(str, arguments), "--no-video"]
        return subprocess.run(words, capture_output=True, text=True, timeout=120)

    folder, options = (
        small_disk / "run",
        ("--task", "flat", "--steps", 40, "--seed", 3, "--evaluations", 420, "--strategy", "sep-cma-es"),
    )
    room.write_bytes(bytes(1_000_000))
    done = command("evolve", *options, "--out", folder)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "No space left on device; all written before is whole, and turgor resume" in done.stderr
    assert Run.open(folder).status in ("running", "interrupted")
    again = command("resume", folder)
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
    room.unlink()
    assert command("resume", folder).returncode == 0
    assert bits(folder)["history"] == bits(unharmed)["history"]
    room.write_bytes(bytes(small_disk_left(small_disk)))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for arguments in (("video", folder), ("evaluate", folder, "--json", small_disk / "a.json")):
        done = subprocess.run([sys.executable, "-m", "turgor", *map(str, arguments)], capture_output=True, text=True)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def small_disk_left(folder: Path) -> int:
    return shutil.disk_usage(folder).free


def test_read_only_folder_is_told(unharmed: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(unharmed, tmp_path / "run"))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    mount = shutil.which("mount")
    bound = mount is not None and not subprocess.run([mount, "--bind", folder, folder], check=False).returncode
    if bound:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
    elif os.name == "posix" and os.getuid() != 0:
        folder.chmod(0o555)
    else:
        pytest.skip("expected to be allowed to make a folder read-only")
    try:
        with pytest.raises(InvalidInput, match=r"\.lock: expected to be able to write it; got (Read-only|Permission)"):
            resume(Run.open(folder), 840)
        assert Run.open(folder).generation == 20  # reading needs no writing
        with pytest.raises(InvalidInput, match="expected to be able to write it"):
            evolve(make_task("flat", steps=40), out=folder / "below", **RUN)
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    finally:
        if bound:
            subprocess.run(["umount", folder], check=True)
        else:
            folder.chmod(0o755)
