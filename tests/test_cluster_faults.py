"""Clusters: workers that die, are silent or are strangers, and a scheduler that is gone. All of it happens."""

from __future__ import annotations

import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import turgor
from turgor.cluster.connect import connect
from turgor.errors import InvalidInput
from turgor.evolution.loop import evolve, resume
from turgor.evolution.sep_cma_es import SepCMAES
from turgor.experiments.campaign import run_entries
from turgor.experiments.plan import Entry
from turgor.runs import Run
from turgor.task import Task, make_task

pytest.importorskip("distributed", reason="needs the extra cluster")
dask = pytest.importorskip("dask")

from clusters import RealCluster, address_of, errors_of, once_at_work, wait_until  # noqa: E402

POPULATION, GENERATIONS = 1024, 3
SPREAD = partial(SepCMAES, population=POPULATION)
ENTRIES = [Entry(task="escape", body="small", condition="pressure", seed=seed, evaluations=600) for seed in (0, 1)]

can_be_stopped = pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs a signal that stops a process")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[RealCluster]:
    """A cluster of the test's own, without workers."""
    (tmp_path / "cluster").mkdir()
    with RealCluster(tmp_path / "cluster") as started:
        yield started


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RealCluster, Any]]:
    """A cluster with a worker that nothing happens to, and its client."""
    with RealCluster(tmp_path_factory.mktemp("shared")) as started, connect(started.address) as client:
        workers_of(started, client, 1)
        yield started, client


@pytest.fixture
def victim(shared: tuple[RealCluster, Any]) -> Iterator[Any]:
    """The process of a second worker of the shared cluster."""
    (process,) = workers_of(*shared, 1)
    yield process
    process.kill()
    process.wait()
    wait_until(lambda: len(shared[1].nthreads()) == 1)


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("hilly", steps=600)


@pytest.fixture(scope="module")
def alone(task: Task) -> tuple[Any, ...]:
    """What comes out on one machine."""
    return bits_of(evolve(task, GENERATIONS * POPULATION, strategy=SPREAD))


@pytest.fixture(scope="module")
def campaign_alone(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    return what_was_found(run_entries(tmp_path_factory.mktemp("alone"), ENTRIES, 2))


def bits_of(run: Run) -> tuple[Any, ...]:
    assert run.champion is not None
    rows = [row[:-1] for row in run.rows]  # without the seconds
    return rows, run.champion.theta.tobytes(), run.champion.robust.tobytes()


def what_was_found(measured: list[Any]) -> list[Any]:
    return [(m.entry, m.champion, m.starts, m.theta.tobytes()) for m in measured]


def workers_of(cluster: RealCluster, client: Any, count: int) -> list[Any]:
    """Processes of workers that join the cluster."""
    before = len(client.nthreads())
    started = [cluster.add_worker() for _ in range(count)]
    client.wait_for_workers(before + count, timeout=60)
    return started


# --- workers that die ---------------------------------------------------------------------------------------------


def test_a_worker_killed_amid_a_generation_changes_no_bit(
    task: Task, alone: tuple[Any, ...], shared: tuple[RealCluster, Any], victim: Any
) -> None:
    client = shared[1]
    killer = once_at_work(client, victim, victim.kill)
    run = evolve(task, GENERATIONS * POPULATION, strategy=SPREAD, executor=client)
    killer.join()
    assert victim.wait(10) == -signal.SIGKILL
    assert len(client.nthreads()) == 1
    assert bits_of(run) == alone


def test_a_worker_killed_amid_a_campaign_changes_no_bit(
    campaign_alone: list[Any], shared: tuple[RealCluster, Any], victim: Any, tmp_path: Path
) -> None:
    client = shared[1]
    killer = once_at_work(client, victim, victim.kill)
    with dask.config.set({"turgor.segment": "0.3s"}):
        measured = run_entries(tmp_path / "campaign", ENTRIES, executor=client)
    killer.join()
    assert victim.wait(10) == -signal.SIGKILL
    assert what_was_found(measured) == campaign_alone


def test_a_job_that_kills_its_workers_ends_in_one_line(task: Task) -> None:
    def deadly(position: np.ndarray) -> np.ndarray:
        os._exit(1)

    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), connect("local:1") as client:
        fatal = msgspec.structs.replace(task, end=deadly)
        with pytest.raises(InvalidInput, match="expected a job that workers survive") as error:
            evolve(fatal, POPULATION, strategy=SPREAD, executor=client)
    assert "\n" not in str(error.value)


# --- workers that are silent --------------------------------------------------------------------------------------


@can_be_stopped
def test_work_of_a_worker_that_hangs_is_given_to_another(
    task: Task, alone: tuple[Any, ...], shared: tuple[RealCluster, Any], victim: Any, capsys: Any
) -> None:
    client = shared[1]
    address = address_of(client, victim)
    stopper = once_at_work(client, victim, partial(victim.send_signal, signal.SIGSTOP))
    with dask.config.set({"turgor.answer-timeout": "3s"}):
        run = evolve(task, GENERATIONS * POPULATION, strategy=SPREAD, executor=client)
    stopper.join()
    said = capsys.readouterr().err
    assert re.fullmatch(f"turgor: no answer from worker {address} for [0-9]+ s: its work is given to others\n", said)
    assert 3 < run.seconds["simulation"] < 9  # generations after the first one wait for nobody
    assert bits_of(run) == alone


@can_be_stopped
def test_a_run_on_a_worker_that_hangs_goes_on_elsewhere(
    campaign_alone: list[Any], shared: tuple[RealCluster, Any], victim: Any, tmp_path: Path, capsys: Any
) -> None:
    client = shared[1]
    stopper = once_at_work(client, victim, partial(victim.send_signal, signal.SIGSTOP))
    with dask.config.set({"turgor.answer-timeout": "4s", "turgor.segment": "0.3s"}):
        measured = run_entries(tmp_path / "campaign", ENTRIES, executor=client)
    stopper.join()
    assert "its work is given to others" in capsys.readouterr().err
    assert what_was_found(measured) == campaign_alone


@can_be_stopped
def test_a_worker_that_wakes_up_works_again(task: Task, cluster: RealCluster, capsys: Any) -> None:
    with connect(cluster.address) as client, dask.config.set({"turgor.answer-timeout": "1s"}):
        (only,) = workers_of(cluster, client, 1)

        def pause() -> None:
            only.send_signal(signal.SIGSTOP)
            time.sleep(2.5)
            only.send_signal(signal.SIGCONT)

        pauser = once_at_work(client, only, pause)
        run = evolve(task, POPULATION, strategy=SPREAD, executor=client)
        pauser.join()
    assert "there is no other worker; waiting" in capsys.readouterr().err
    assert run.evaluations == POPULATION


def test_without_workers_it_waits_and_then_tells(task: Task, cluster: RealCluster, tmp_path: Path, capsys: Any) -> None:
    with connect(cluster.address) as client, dask.config.set({"turgor.workers-timeout": "2s"}):
        with pytest.raises(InvalidInput, match=r"no worker at tcp://.* for [23] s; 0 generations were done; .* resume"):
            evolve(task, POPULATION, out=tmp_path / "run", strategy=SPREAD, executor=client)
        assert "waiting 2 s for one" in capsys.readouterr().err
        late = threading.Timer(1.0, cluster.add_worker)
        late.start()
        with dask.config.set({"turgor.workers-timeout": "60s"}):
            assert evolve(task, POPULATION, strategy=SPREAD, executor=client).evaluations == POPULATION
        late.join()


# --- a scheduler that is gone -------------------------------------------------------------------------------------


def test_a_scheduler_that_dies_is_told_and_resume_goes_on(
    alone: tuple[Any, ...], cluster: RealCluster, tmp_path: Path
) -> None:
    folder, evaluations = tmp_path / "run", GENERATIONS * POPULATION
    options = ("--population", POPULATION, "--strategy", "sep-cma-es", "--steps", 600, "--no-video")
    cluster.add_worker()
    process = start_turgor(
        "evolve", *options, "--evaluations", evaluations, "--cluster", cluster.address, "--out", folder
    )
    wait_for_rows(folder, process)
    cluster.scheduler.kill()
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert errors_of(error).count("\n") == 1
    assert re.search(f"scheduler at {cluster.address} is gone .* generations were done; turgor resume {folder}", error)
    assert Run.open(folder).status == "interrupted"
    process = start_turgor("resume", folder, "--no-video")
    assert (errors_of(process.communicate(timeout=120)[1]), process.returncode) == ("", 0)
    assert bits_of(Run.open(folder)) == alone


@can_be_stopped
def test_a_scheduler_that_hangs_is_told(task: Task, cluster: RealCluster) -> None:
    with dask.config.set({"turgor.scheduler-timeout": "2s"}), connect(cluster.address) as client:
        (worker,) = workers_of(cluster, client, 1)
        stopper = once_at_work(client, worker, partial(cluster.scheduler.send_signal, signal.SIGSTOP))
        with pytest.raises(
            InvalidInput, match=r"does not answer; . generations were done; the run was in memory alone"
        ):
            evolve(task, GENERATIONS * POPULATION, strategy=SPREAD, executor=client)
        stopper.join()
        cluster.scheduler.kill()


def test_a_campaign_goes_on_after_its_scheduler_died(
    campaign_alone: list[Any], cluster: RealCluster, tmp_path: Path
) -> None:
    folder = tmp_path / "campaign"
    with connect(cluster.address) as client, dask.config.set({"turgor.segment": "0.2s"}):
        workers_of(cluster, client, 1)

        def kill() -> None:
            wait_until(lambda: list(folder.glob("*/checkpoint.npz")))
            cluster.scheduler.kill()

        killer = threading.Thread(target=kill)
        killer.start()
        with pytest.raises(InvalidInput, match=f"gone .* every run is kept in {folder}; the same command goes on"):
            run_entries(folder, ENTRIES, executor=client)
        killer.join()
    states = [Run.open(path.parent) for path in folder.glob("*/run.json")]
    assert {run.status for run in states} == {"interrupted"}
    assert 0 < sum(run.evaluations for run in states) < 1200
    assert what_was_found(run_entries(folder, ENTRIES, 1)) == campaign_alone


# --- strangers ----------------------------------------------------------------------------------------------------


def another_version(folder: Path) -> dict[str, str]:
    """The environment of a process that has turgor 9.9.9."""
    source = Path(turgor.__file__).parent
    shutil.copytree(source, folder / "turgor", ignore=shutil.ignore_patterns("__pycache__"))
    init = folder / "turgor" / "__init__.py"
    init.write_text(init.read_text().replace('__version__ = "0.1.0"', '__version__ = "9.9.9"'))
    (folder / "turgor-9.9.9.dist-info").mkdir()
    (folder / "turgor-9.9.9.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: turgor\nVersion: 9.9.9\n")
    return {"PYTHONPATH": str(folder)}


def test_a_worker_of_another_version_is_refused(task: Task, cluster: RealCluster, tmp_path: Path) -> None:
    with connect(cluster.address) as client:
        stranger = cluster.add_worker(another_version(tmp_path / "other"))
        client.wait_for_workers(1, timeout=60)
        address = address_of(client, stranger)
        with pytest.raises(InvalidInput) as error:
            evolve(task, POPULATION, strategy=SPREAD, executor=client)
        expected = f"cluster: expected turgor 0.1.0 on every worker, as here; got 9.9.9 on {address}"
        assert str(error.value) == expected
        with pytest.raises(InvalidInput, match=re.escape(expected)):
            run_entries(tmp_path / "campaign", ENTRIES, executor=client)
    assert not (tmp_path / "campaign").exists()


def test_a_worker_of_another_version_that_comes_later_is_refused(
    task: Task, cluster: RealCluster, tmp_path: Path
) -> None:
    environment = another_version(tmp_path / "other")
    with connect(cluster.address) as client:
        workers_of(cluster, client, 1)

        def join_late(progress: Any) -> None:
            if progress.generation == 1:
                cluster.add_worker(environment)
                client.wait_for_workers(2, timeout=60)

        with pytest.raises(InvalidInput, match=r"expected turgor 0\.1\.0 .*; got 9\.9\.9 on tcp://"):
            evolve(task, 1000 * POPULATION, strategy=SPREAD, progress=join_late, executor=client)


def test_a_worker_of_edited_sources_is_refused(task: Task, cluster: RealCluster, tmp_path: Path) -> None:
    folder = tmp_path / "edited"
    shutil.copytree(Path(turgor.__file__).parent, folder / "turgor", ignore=shutil.ignore_patterns("__pycache__"))
    springs = folder / "turgor" / "physics" / "springs.py"
    springs.write_text(springs.read_text(encoding="utf-8") + "\n# faster\n", encoding="utf-8")
    with connect(cluster.address) as client:
        cluster.add_worker({"PYTHONPATH": str(folder)})
        client.wait_for_workers(1, timeout=60)
        with pytest.raises(
            InvalidInput, match=r"expected turgor's sources [0-9a-f]{12} .*; got [0-9a-f]{12} on tcp://"
        ):
            evolve(task, POPULATION, strategy=SPREAD, executor=client)


@pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64") or sys.platform == "darwin", reason="needs OpenBLAS on x86-64"
)
def test_a_processor_that_calculates_differently_gets_simulations_but_no_whole_run(
    task: Task, alone: tuple[Any, ...], cluster: RealCluster, tmp_path: Path
) -> None:
    with connect(cluster.address) as client:
        cluster.add_worker({"OPENBLAS_CORETYPE": "Nehalem"})
        client.wait_for_workers(1, timeout=60)
        assert bits_of(evolve(task, GENERATIONS * POPULATION, strategy=SPREAD, executor=client)) == alone
        with pytest.raises(InvalidInput, match=r"the BLAS kernels .*; got .*Nehalem.* on tcp://"):
            run_entries(tmp_path / "campaign", ENTRIES, executor=client)


# --- Ctrl-C -------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(os.name == "nt", reason="sends signals to a group of processes")
@pytest.mark.parametrize("how", ["Ctrl-C", "kill -9"])
def test_a_coordinator_that_is_ended_keeps_the_run_and_leaves_no_process(
    how: str, alone: tuple[Any, ...], tmp_path: Path
) -> None:
    folder, evaluations = tmp_path / "run", GENERATIONS * POPULATION
    options = ("--population", POPULATION, "--strategy", "sep-cma-es", "--steps", 600, "--no-video")
    process = start_turgor("evolve", *options, "--evaluations", evaluations, "--cluster", "local:2", "--out", folder)
    wait_for_rows(folder, process)
    if how == "Ctrl-C":
        os.killpg(process.pid, signal.SIGINT)  # it reaches every process of a terminal
        error = errors_of(process.communicate(timeout=60)[1])
        kept = f"turgor: interrupted; kept in {folder}; turgor resume {folder} goes on\n"
        assert (process.returncode, error) == (130, kept)
    else:
        process.kill()  # the first process alone
        process.communicate(timeout=60)
    with pytest.raises(ProcessLookupError):
        wait_until(lambda: os.killpg(process.pid, 0), 20)
    assert bits_of(resume(Run.open(folder), strategy=SPREAD)) == alone


def start_turgor(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "turgor", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def wait_for_rows(folder: Path, process: subprocess.Popen[str]) -> None:
    """Until the run has a generation behind it."""
    history = folder / "history.csv"
    wait_until(lambda: process.poll() is not None or (history.exists() and history.read_bytes().count(b"\n") > 1))
