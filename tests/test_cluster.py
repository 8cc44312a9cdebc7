"""Clusters: the same bits whatever the workers, one writer, and addresses that are understood."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from turgor import cli
from turgor.cli.command import Parser
from turgor.cluster import connect as connections
from turgor.cluster.connect import connect
from turgor.cluster.crew import Patience
from turgor.cluster.shards import LARGEST, SMALLEST, ShardedSimulator, cut_into_shards
from turgor.errors import InvalidInput
from turgor.evolution.loop import evolve, resume
from turgor.evolution.sep_cma_es import SepCMAES
from turgor.evolution.worlds import draw_worlds
from turgor.experiments.campaign import Progress, run_entries
from turgor.experiments.plan import Entry
from turgor.runs import Run
from turgor.simulate import Rollout, Simulator
from turgor.task import Task, make_task
from turgor.variants import Robust

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")
dask = pytest.importorskip("dask")

from clusters import RealCluster, errors_of, wait_until  # noqa: E402

POPULATION = 512
SPREAD = partial(SepCMAES, population=POPULATION)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCluster]:
    """A cluster of one worker, of two threads."""
    with RealCluster(tmp_path_factory.mktemp("cluster")) as started:
        started.add_worker(threads=2)
        yield started


@pytest.fixture(scope="module")
def client(cluster: RealCluster) -> Iterator[Any]:
    with connect(cluster.address) as connected:
        connected.wait_for_workers(1, timeout=60)
        yield connected


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("hilly", steps=150)


def bits_of(run: Run) -> tuple[Any, ...]:
    """All that must not depend on where a run was made."""
    assert run.champion is not None
    rows = [row[:-1] for row in run.rows]  # without the seconds
    return rows, run.champion.theta.tobytes(), run.champion.robust.tobytes()


def turgor(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "turgor", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


# --- the same bits ------------------------------------------------------------------------------------------------


def test_evolution_has_the_same_bits_on_one_two_and_three_workers(
    task: Task, cluster: RealCluster, client: Any
) -> None:
    alone = bits_of(evolve(task, 3 * POPULATION, strategy=SPREAD, threads=2))
    for workers in (1, 2, 3):
        if workers > 1:
            cluster.add_worker()
            wait_until(lambda n=workers: len(client.nthreads()) == n)
        assert bits_of(evolve(task, 3 * POPULATION, strategy=SPREAD, executor=client)) == alone


def test_a_run_may_change_between_cluster_and_one_machine(task: Task, client: Any, tmp_path: Path) -> None:
    alone = bits_of(evolve(task, 4 * POPULATION, strategy=SPREAD))
    evolve(task, 2 * POPULATION, out=tmp_path / "there", strategy=SPREAD, executor=client)
    assert bits_of(resume(Run.open(tmp_path / "there"), 4 * POPULATION)) == alone
    evolve(task, 2 * POPULATION, out=tmp_path / "here", strategy=SPREAD)
    assert bits_of(resume(Run.open(tmp_path / "here"), 4 * POPULATION, executor=client)) == alone


def test_a_robust_evolution_has_the_same_bits_on_a_cluster(task: Task, client: Any, tmp_path: Path) -> None:
    robust = Robust(worlds=3)
    alone = bits_of(evolve(task, 3 * POPULATION, strategy=SPREAD, threads=2, robust=robust))
    assert bits_of(evolve(task, 3 * POPULATION, strategy=SPREAD, executor=client, robust=robust)) == alone
    evolve(task, POPULATION, out=tmp_path / "here", strategy=SPREAD, robust=robust)
    assert bits_of(resume(Run.open(tmp_path / "here"), 3 * POPULATION, executor=client)) == alone


@pytest.mark.parametrize("agents", [2 * SMALLEST - 1, 2 * SMALLEST + 9])  # simulated here, and spread
def test_rollouts_in_many_tasks_have_the_same_bits(agents: int, client: Any) -> None:
    task = make_task("escape", steps=60)
    worlds = draw_worlds(task, Robust(worlds=3, shift=0.3), 0, 1)
    theta = np.random.default_rng(0).normal(0, 2, (agents, task.parameter_count))
    here, there = Simulator(task).rollout_in(worlds, theta), ShardedSimulator(task, client).rollout_in(worlds, theta)
    for one, other in zip(here, there, strict=True):
        for name in Rollout.__struct_fields__:
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name


@pytest.mark.parametrize("controller", ["linear", "mlp", "sinusoid", "distributed"])
def test_every_field_of_a_rollout_has_the_same_bits(controller: str, client: Any) -> None:
    task = make_task("escape", steps=60, controller=controller)
    theta = np.random.default_rng(0).normal(0, 2, (3 * SMALLEST + 7, task.parameter_count))
    here, there = Simulator(task).rollout(theta), ShardedSimulator(task, client).rollout(theta)
    for name in Rollout.__struct_fields__:
        a, b = getattr(here, name), getattr(there, name)
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes(), name


def test_functions_of_the_users_own_see_what_they_see_on_one_machine(client: Any) -> None:
    def rank(out: Rollout) -> np.ndarray:  # of all agents: what no shard can tell
        return np.argsort(np.argsort(out.com[:, 0])) - 0.5 * (out.start[:, 0] < 0)

    def high(position: np.ndarray) -> np.ndarray:
        return position[:, :, 1].max(axis=1) > 4.0

    task = make_task("flat", steps=40)
    task = Task(**{name: getattr(task, name) for name in Task.__struct_fields__} | {"fitness": rank, "end": high})
    theta = np.random.default_rng(0).normal(0, 2, (2 * SMALLEST, task.parameter_count))
    here, there = Simulator(task).rollout(theta), ShardedSimulator(task, client).rollout(theta)
    assert sorted(here.fitness) == sorted(rank(here))
    assert here.fitness.tobytes() == there.fitness.tobytes()
    assert here.steps.tobytes() == there.steps.tobytes()


def test_small_batches_stay_here_and_that_is_said_once(task: Task, client: Any, capsys: Any) -> None:
    simulator, theta = ShardedSimulator(task, client), np.zeros((2 * SMALLEST - 1, task.parameter_count))
    for _ in range(2):
        assert simulator.rollout(theta).fitness.tobytes() == Simulator(task).rollout(theta).fitness.tobytes()
    assert (
        capsys.readouterr().err
        == f"turgor: {2 * SMALLEST - 1} agents are too few to spread (from 256 on); simulated here\n"
    )


@pytest.mark.parametrize("agents", [1, 128, 129, 1000, 10_000])
@pytest.mark.parametrize("threads", [0, 1, 2, 64])
def test_shards_are_whole_blocks_in_order(agents: int, threads: int) -> None:
    theta = np.arange(agents, dtype=np.float32)[:, None]
    shards = cut_into_shards(theta, threads)
    assert np.array_equal(np.concatenate(shards), theta)
    assert all(len(shard) % 16 == 0 and SMALLEST <= len(shard) <= LARGEST for shard in shards[:-1])


# --- campaigns ----------------------------------------------------------------------------------------------------

ENTRIES = [
    Entry(task="hilly", body="small", condition="pressure", seed=0, evaluations=210),
    Entry(task="escape", body="small", condition="springs", seed=1, evaluations=150),
    Entry(task="hilly", body="small", condition="passive", seed=0, evaluations=0),
]


def test_a_campaign_in_many_pieces_is_the_one_in_a_go(client: Any, tmp_path: Path) -> None:
    told: list[Progress] = []
    here = run_entries(tmp_path / "here", ENTRIES, 2)
    with dask.config.set({"turgor.segment": "0.05s"}):
        there = run_entries(tmp_path / "there", ENTRIES, progress=told.append, executor=client)
    for a, b in zip(here, there, strict=True):
        assert (a.entry, a.champion, a.starts) == (b.entry, b.champion, b.starts)
        assert a.theta.tobytes() == b.theta.tobytes()
    assert told[-1].done == told[-1].total == len(ENTRIES)
    for entry in ENTRIES[:2]:
        a, b = (Run.open(tmp_path / where / entry.name) for where in ("here", "there"))
        assert bits_of(a) == bits_of(b)
        assert (a.status, a.settings) == (b.status, b.settings)
        assert_same_arrays(a.path / "checkpoint.npz", b.path / "checkpoint.npz")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*")}
    again = run_entries(tmp_path / "there", ENTRIES, executor=client)
    assert [m.champion for m in again] == [m.champion for m in there]
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*")} == before


def assert_same_arrays(a: Path, b: Path) -> None:
    """But for the seconds in the history, and the checksum over all."""
    with np.load(a) as one, np.load(b) as other:
        assert one.files == other.files
        names = [name for name in one.files if name.startswith(("strategy_", "champion_"))]
        assert len(names) > 10
        assert all(one[name].tobytes() == other[name].tobytes() for name in names)


def test_the_command_writes_the_same_tables(cluster: RealCluster, client: Any, tmp_path: Path) -> None:
    tiny = ("--only", "rq2", "--body", "small", "--seeds", "1", "--evaluations", "100", "--no-videos")
    for where, options in (("here", ()), ("there", ("--cluster", cluster.address))):
        done = turgor("reproduce", *tiny, *options, "--out", tmp_path / where)
        assert (done.returncode, errors_of(done.stderr)) == (0, "")
    tables = [
        {path.name: path.read_bytes() for path in (tmp_path / where / "tables").iterdir()}
        for where in ("here", "there")
    ]
    assert tables[0] == tables[1]


# --- connections --------------------------------------------------------------------------------------------------


def test_the_command_evolves_on_workers_of_its_own(tmp_path: Path) -> None:
    options = ("--strategy", "sep-cma-es", "--population", 512, "--evaluations", 1024, "--steps", 60, "--no-video")
    for where, more in (("here", ()), ("there", ("--cluster", "local:2"))):
        done = turgor("evolve", *options, *more, "--out", tmp_path / where)
        assert (done.returncode, errors_of(done.stderr)) == (0, "")
    assert bits_of(Run.open(tmp_path / "here")) == bits_of(Run.open(tmp_path / "there"))


@pytest.mark.parametrize(
    "text",
    ["", "host:8786", "tcp://host", "tcp://:8786", "tcp://host:port", "http://host:1", "local", "local:0", "local:x"],
)
def test_an_address_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput, match="expected a scheduler, tcp://HOST:PORT, or local:N"), connect(text):
        pass


def test_a_scheduler_that_does_not_answer_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "CONNECT_TIMEOUT", 0.5)
    with (
        pytest.raises(InvalidInput, match=r"expected a Dask scheduler at tcp://127\.0\.0\.1:9 .*; got \w"),
        connect("tcp://127.0.0.1:9"),
    ):
        pass


def test_without_dask_it_is_told_how_to_get_it() -> None:
    code = "import sys; sys.modules['distributed'] = None; from turgor.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "evolve", "--cluster", "local:2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip install 'turgor[cluster]'" in done.stderr


def test_an_executor_that_is_no_client_is_refused(task: Task) -> None:
    with ThreadPoolExecutor(1) as pool, pytest.raises(InvalidInput, match="executor: expected a Dask Client"):
        evolve(task, 100, executor=pool)


def test_a_client_that_is_closed_is_refused(task: Task, cluster: RealCluster) -> None:
    with connect(cluster.address) as closed:
        pass
    with pytest.raises(InvalidInput, match="expected a Dask Client that is connected; got one that is closed"):
        evolve(task, 100, executor=closed)


@pytest.mark.parametrize("value", ["soon", -1, 0, None])
def test_an_impossible_time_out_is_refused(task: Task, client: Any, value: Any) -> None:
    with (
        dask.config.set({"turgor.answer-timeout": value}),
        pytest.raises(InvalidInput, match="answer_timeout: expected a positive number"),
    ):
        evolve(task, 100, executor=client)


def test_dask_is_not_imported_unless_it_is_asked_for() -> None:
    modules = "turgor.cli, turgor.experiments.reproduce, turgor.cluster.connect, turgor.cluster.shards"
    code = f"import sys, {modules}; sys.exit('dask' in sys.modules or 'distributed' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


# --- the page -----------------------------------------------------------------------------------------------------

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
COMMANDS = [
    shlex.split(line)
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
    if line.startswith(("turgor ", "dask "))
]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: "-".join(words[:2]))
def test_the_commands_of_the_page_are_understood(command: list[str]) -> None:
    program, name, *options = command
    if program == "turgor":
        parser = Parser(name, "", "")
        cli.COMMANDS[name].options(parser)
        assert parser.parse(options).cluster.startswith(("tcp://", "local:"))
    else:
        dask_command = importlib.import_module(f"distributed.cli.dask_{name}").main
        assert dask_command.make_context(name, options).params


def test_the_page_tells_the_time_outs_as_they_are() -> None:
    for name, value in msgspec.structs.asdict(Patience()).items():
        setting = name.replace("_", "-")
        assert re.search(rf"\| `{setting}` \| `DASK_TURGOR__{name.upper()}` \| {value:.0f}\b", PAGE)


def test_a_time_out_is_taken_from_the_environment() -> None:
    code = "from turgor.cluster.crew import patience; print(patience().answer_timeout)"
    environment = {**os.environ, "DASK_TURGOR__ANSWER_TIMEOUT": "2 minutes"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert (float(done.stdout), done.stderr) == (120.0, "")


def _job_of(example: Path) -> str:
    """The job that dask-jobqueue would submit; in a process of its own, because its import takes Ctrl-C away."""
    code = (
        "import runpy, sys\n"
        "example = runpy.run_path(sys.argv[1])\n"
        "local = {'host': '127.0.0.1', 'dashboard_address': '127.0.0.1:0'}\n"
        "with example['make_cluster'](scheduler_options=local) as cluster:\n"
        "    print(cluster.job_script())"
    )
    command = [sys.executable, "-W", "error", "-c", code, str(example)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_the_job_files_for_slurm_are_shell() -> None:
    files = [(ROOT / "examples" / "cluster" / "turgor.sbatch").read_text(encoding="utf-8")]
    if importlib.util.find_spec("dask_jobqueue"):
        files.append(_job_of(ROOT / "examples" / "cluster" / "slurm.py"))
        assert "--nthreads 1 " in files[1]
        assert "--nworkers 16 " in files[1]
        assert "OPENBLAS_NUM_THREADS=1" in files[1]
    for text in files:
        assert text.count("\n#SBATCH") > 3
        checked = subprocess.run(["bash", "-n"], input=text, capture_output=True, text=True, timeout=60)
        assert (checked.returncode, checked.stderr) == (0, "")
