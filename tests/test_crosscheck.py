"""Crosschecks with real Box2D: the numbers, the verdicts, the command and the folders that it leaves."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import turgor
from turgor.body import SMALL, Body
from turgor.cli import main
from turgor.control import MLP, Distributed, Sinusoid
from turgor.errors import InvalidInput, WorkLost
from turgor.evolution.loop import evolve
from turgor.experiments.rows import read_rows
from turgor.experiments.statistics import median_difference
from turgor.fidelity import compare
from turgor.fidelity.campaign import crosscheck_campaign, crosscheck_run
from turgor.fidelity.compare import MOVED, Sample, Verdict, crosscheck, kolmogorov_smirnov, rank_correlation
from turgor.fidelity.drive import new_trace, run
from turgor.fidelity.engines import Crew, make_job
from turgor.fidelity.figures import draw_run
from turgor.fidelity.golden import Case, open_loop_cases
from turgor.fidelity.records import Row, Summary, read_record
from turgor.recording import Recording
from turgor.rollout import Rollout
from turgor.runs import Run
from turgor.scene import flat
from turgor.simulate import Simulator, perturbed
from turgor.task import Leave, Physics, Task, make_task
from turgor.web.library import Library
from turgor.web.replay import read_replay

pytest.importorskip("Box2D", reason="needs Box2D 2.3, of the extra box2d")

from turgor.fidelity.box2d import Box2DWorld

BOX2D = ["box2d"]
GOLDEN = {case.name: case for case in open_loop_cases(Path(__file__).parent / "golden")}
THREE = dict.fromkeys(["crosscheck.pdf", "crosscheck.png", "crosscheck.svg"])


def controller_of(task: Task, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, task.parameter_count)


def in_box2d(task: Task, theta: np.ndarray) -> tuple[Rollout, Recording]:
    """What one agent achieves in Box2D 2.3, and its recording."""
    with Crew(1) as crew:
        done = next(crew.run([make_job("box2d", task, theta[None], record=True)]))
    assert done.recording is not None
    return done.rollout, done.recording


# --- the engine ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GOLDEN)
def test_box2d_replays_the_golden_data_bit_for_bit(name: str) -> None:
    """The data were made with Box2D 2.3.2 by another program."""
    case: Case = GOLDEN[name]
    task = Task(
        name=name,
        body=case.body,
        scene=case.scene,
        position=case.position,
        condition="passive",
        physics=Physics(gravity=case.gravity),
        steps=len(case.script.rest_length),
    )
    trace = new_trace()
    run(Box2DWorld, task, np.zeros((1, 0)), case.position[None], script=case.script, trace=trace)
    position = np.array(trace.position)[case.frames]
    assert case.frames[-1] in (120, 300)
    np.testing.assert_array_equal(position.astype(np.float32), case.expected)


def two_chambers() -> Body:
    """Two rings of ten masses side by side that share three of them."""
    ring = SMALL.position
    mirrored = ring[8:1:-1] * [-1, 1] + [2 * ring[1, 0], 0]
    position, loops = np.concatenate([ring, mirrored]), [[*range(10)], [9, *range(10, 17), 1, 0]]
    springs = {(min(pair), max(pair)) for loop in loops for pair in zip(loop, [*loop[1:], loop[0]], strict=True)}
    return Body(position, springs=sorted(springs), chambers=loops, gas_amount=[SMALL.gas_amount[0]] * 2)


TASKS = {
    "linear": lambda: make_task("hilly", steps=30),
    "mlp": lambda: make_task("hilly", controller=MLP(), steps=30),
    "sinusoid": lambda: make_task("hilly", controller=Sinusoid(), steps=30),
    "distributed": lambda: make_task("hilly", controller=Distributed(), steps=30),
    "springs": lambda: make_task("flat", condition="springs", steps=30),
    "passive": lambda: make_task("hilly", condition="passive", steps=30),
    "escape": lambda: make_task("escape", body="medium", steps=30),
    "inflation": lambda: make_task("inflation", steps=30),
    "large": lambda: make_task("hilly", body="large", steps=30),
    "short steps": lambda: make_task("hilly", dt=1 / 120, gravity=3.7, window=5, steps=30),
}


@pytest.mark.parametrize("name", TASKS)
def test_every_controller_condition_and_task_goes_where_it_goes_here(name: str) -> None:
    task = TASKS[name]()
    theta = controller_of(task)
    out, there = in_box2d(task, theta)
    here = Simulator(task).record(theta)
    assert here.touch.any(), "a task in which nothing is touched says little"
    assert there.steps == here.steps == out.steps[0] == 30
    np.testing.assert_allclose(there.position, here.position, atol=1e-4)
    np.testing.assert_array_equal(there.touch, here.touch)
    np.testing.assert_allclose(there.pressure, here.pressure, rtol=1e-5)
    np.testing.assert_allclose(there.rest_length, here.rest_length, atol=1e-4)
    if here.observation is not None and there.observation is not None:
        np.testing.assert_allclose(there.observation, here.observation, atol=1e-4)
    assert there.fitness == pytest.approx(here.fitness, abs=1e-4)


def test_an_end_comes_in_the_same_step() -> None:
    """A start that falls out of a narrow field, and one that stays."""
    task = msgspec.structs.replace(make_task("escape", steps=120), end=Leave(half_width=0.05))
    theta = np.stack([controller_of(task, seed) for seed in range(6)])
    here = Simulator(task).rollout(theta)
    with Crew(1) as crew:
        there = next(crew.run([make_job("box2d", task, theta)])).rollout
    assert here.solved.any()
    np.testing.assert_array_equal(there.solved, here.solved)
    np.testing.assert_array_equal(there.steps, here.steps)
    np.testing.assert_allclose(there.fitness, here.fitness, atol=1e-4)


def test_functions_of_ones_own_stay_here() -> None:
    """They need not travel to the other processes: the end does, fitness does not."""
    task = msgspec.structs.replace(make_task("flat", steps=40), fitness=lambda out: -out.com[:, 1], end=lowered)
    out, there = in_box2d(task, controller_of(task))
    here = Simulator(task).record(controller_of(task))
    assert there.steps == here.steps < 40
    assert there.solved
    assert there.fitness == pytest.approx(here.fitness, abs=1e-4) == pytest.approx(-out.com[0, 1])


def lowered(position: np.ndarray) -> np.ndarray:
    return position[:, :, 1].min(axis=1) < 0.9


def test_two_chambers_keep_their_own_pressures() -> None:
    body = two_chambers()
    task = Task(name="two", body=body, scene=flat(), position=body.position + [0, 7], condition="pressure", steps=30)
    theta = controller_of(task)
    _, there = in_box2d(task, theta)
    here = Simulator(task).record(theta)
    assert np.abs(there.pressure[-1, 0] - there.pressure[-1, 1]) > 1
    np.testing.assert_allclose(there.position, here.position, atol=1e-4)
    np.testing.assert_allclose(there.pressure, here.pressure, rtol=1e-5)


# --- the comparison -----------------------------------------------------------------------------------------------


def test_the_numbers_do_not_depend_on_processes() -> None:
    task = make_task("escape", steps=30)
    told: list[tuple[int, int]] = []
    how: dict[str, Any] = {"repeats": 5, "controllers": 6, "engines": BOX2D}
    one = crosscheck(task, controller_of(task), **how, progress=lambda *p: told.append(p))
    two = crosscheck(task, controller_of(task), **how, processes=2)
    assert one.samples == two.samples
    assert one.comparisons == two.comparisons
    np.testing.assert_array_equal(one.recordings["box2d"].position, two.recordings["box2d"].position)
    assert told[-1] == (12, 12)


def test_a_crosscheck_tells_what_simulators_tell() -> None:
    task = make_task("hilly", steps=60)
    theta, ranked = controller_of(task), np.stack([controller_of(task, seed) for seed in range(2, 9)])
    found = turgor.crosscheck(task, theta, 4, engines=["box2d", "box2d-ccd", "box2d"], controllers=ranked)
    simulator = Simulator(task)
    here, there, ccd = found.samples
    assert (here.engine, there.engine, ccd.engine) == ("turgor", "box2d", "box2d-ccd")
    moved = simulator.rollout(np.tile(theta, (4, 1)), perturbed(task.position, 4, MOVED))
    assert here.own == simulator.record(theta).fitness == found.recordings["turgor"].fitness
    assert here.fitness == moved.fitness.tolist()
    assert here.ranked == simulator.rollout(ranked).fitness.tolist()
    assert here.solved is None
    assert there.own == in_box2d(task, theta)[0].fitness[0] == found.recordings["box2d"].fitness
    assert there.ranked == [in_box2d(task, one)[0].fitness[0] for one in ranked]
    c, other = found.comparisons
    assert (c.difference, c.low, c.high) == median_difference(here.fitness, there.fitness)
    assert c.rank == rank_correlation(here.ranked, there.ranked)
    assert c.parts is None
    assert other.parts is not None, "continuous collision stops masses where they first touch"
    assert (c.holds, found.holds) == (True, other.holds)
    assert repr(found).splitlines() == [f"Box2D 2.3: {c.says}", f"Box2D 2.3 with CCD: {other.says}"]


def test_a_moved_mass_parts_trajectories() -> None:
    recording = Simulator(make_task("flat", steps=3)).record(controller_of(make_task("flat")))
    position = np.array(recording.position, dtype=np.float64)
    position[2, 4] += [0.006, 0.008]
    other = msgspec.structs.replace(recording, position=position)
    assert compare.first_apart(recording, other, 0.0099) == 2
    assert compare.first_apart(recording, other, 0.0101) is None
    shorter = msgspec.structs.replace(recording, position=position[:2])
    assert compare.first_apart(recording, shorter) is None


SPREAD = np.linspace(-1, 1, 30)
VERDICTS: dict[str, tuple[np.ndarray, np.ndarray, Verdict, str]] = {
    "equal": (2 + 0.01 * SPREAD, 2 + 0.01 * SPREAD, "the same", "holds: 2 there, 2 here, not to be told from chance"),
    "wide": (2 + SPREAD, 2.1 + SPREAD, "the same", "holds as far as 30 starts can tell: 2.1 there, 2 here"),
    "near": (2 + 0.01 * SPREAD, 2.05 + 0.01 * SPREAD, "close", "holds: 2.05 there, 2 here, within 5%"),
    "both near nothing": (0.001 * SPREAD, 0.005 + 0.001 * SPREAD, "close", "holds: "),
    "better": (2 + 0.1 * SPREAD, 3 + 0.1 * SPREAD, "stronger", "holds, and does better: 3 there, 2 here"),
    "better than nothing": (
        -1 + 0.1 * SPREAD,
        1 + 0.1 * SPREAD,
        "stronger",
        "holds, and does better: 1 there, -1 here",
    ),
    "wider": (2 + 0.001 * SPREAD, 2 + SPREAD, "mixed", "holds in the median (2 there, 2 here), but the distributions"),
    "less": (2 + 0.1 * SPREAD, 1.7 + 0.1 * SPREAD, "weaker", "holds in part: keeps 85% (1.7 there, 2 here)"),
    "half": (2 + 0.1 * SPREAD, 1 + 0.1 * SPREAD, "does not hold", "does not hold: keeps 50% (1 there, 2 here)"),
    "backwards": (2 + 0.1 * SPREAD, -1 + 0.1 * SPREAD, "does not hold", "does not hold: falls (-1 there, 2 here)"),
    "less than nothing": (-1 + 0.1 * SPREAD, -2 + 0.1 * SPREAD, "does not hold", "does not hold: falls (-2 there"),
}


@pytest.fixture(scope="module")
def floor() -> compare._Floor:
    task = make_task("flat", steps=3)
    return compare._Floor(compare.Case(task, controller_of(task), np.zeros((0, task.parameter_count))), 1)


@pytest.mark.parametrize("name", VERDICTS)
def test_verdicts(name: str, floor: compare._Floor) -> None:
    values_here, values, verdict, says = VERDICTS[name]
    here, there = (
        Sample(engine=engine, version="1", own=0.0, fitness=fitness.tolist(), solved=None, ranked=[])
        for engine, fitness in (("turgor", values_here), ("box2d", values))
    )
    found = compare.compare(here, there, floor, floor.recording)
    assert (found.verdict, found.holds) == (verdict, verdict in ("the same", "close", "stronger"))
    assert found.says.startswith(says)
    assert (found.kept is None) == (np.median(values_here) <= 0)
    assert (found.rank, found.rank_floor, found.solved) == (None, None, None)


def test_every_verdict_is_tried() -> None:
    assert {case[2] for case in VERDICTS.values()} == set(Verdict.__args__)


def test_kolmogorov_smirnov() -> None:
    assert kolmogorov_smirnov([1, 2, 3], [1, 2, 3]) == (0, 1)
    assert kolmogorov_smirnov([0, 0], [1, 1])[0] == 1
    assert kolmogorov_smirnov([1, 2, 3, 4], [3, 4, 5, 6])[0] == 0.5
    distance, p = kolmogorov_smirnov(np.arange(30), np.arange(30) + 100)
    assert distance == 1
    assert p < 1e-15
    assert 0 <= kolmogorov_smirnov(np.zeros(6000), np.ones(6000))[1] < 1e-300  # no warning, where p is not exact


def test_rank_correlation() -> None:
    assert rank_correlation([1, 2, 3], [10, 20, 21]) == pytest.approx(1)
    assert rank_correlation([1, 2, 3], [3, 2, 1]) == pytest.approx(-1)
    assert rank_correlation([1, 1, 2, 3], [5, 5, 6, 6]) == pytest.approx(0.9428, abs=1e-4)  # ties share their rank
    assert rank_correlation([1, 2], [1, 2]) is None
    assert rank_correlation([], []) is None
    assert rank_correlation([1, 1, 1], [1, 2, 3]) is None


FLAT = make_task("flat", steps=3)
THETA = np.zeros(FLAT.parameter_count)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"repeats": 1}, "repeats: expected a whole number, 2 to 10000; got 1"),
        ({"repeats": 20_000}, "repeats: expected a whole number, 2 to 10000; got 20000"),
        ({"engines": ["ode"]}, "engine: expected one of box2d, box2d-ccd, box2d-fine, box2d-v3; got 'ode'"),
        ({"theta": [0.0]}, "theta: expected"),
        ({"controllers": -1}, "controllers: expected a whole number, 0 to 10000; got -1"),
        ({"controllers": [[1.0]]}, "theta: expected"),
        ({"seed": -1}, "seed: expected a whole number, 0 or more; got -1"),
        ({"processes": 0}, "processes: expected a whole number, 1 to 1024; got 0"),
        ({"processes": 5000}, "processes: expected a whole number, 1 to 1024; got 5000"),
        ({"task": make_task("flat", slop=0.01)}, "slop: expected 0.005, which cannot be changed in Box2D; got 0.01"),
    ],
)
def test_what_cannot_be_is_refused(options: dict[str, Any], text: str) -> None:
    given: dict[str, Any] = {"task": FLAT, "theta": THETA, "repeats": 2, "controllers": 0, "engines": BOX2D, **options}
    with pytest.raises(InvalidInput) as error:
        crosscheck(**given)
    assert text in str(error.value)


def test_an_engine_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "turgor.fidelity.box2d", None)
    with pytest.raises(
        InvalidInput, match=r"engine box2d: expected the package box2d \(pip install 'turgor\[box2d\]'\)"
    ):
        crosscheck(FLAT, THETA, 2, engines=BOX2D)
    monkeypatch.setitem(sys.modules, "turgor.fidelity.box2d_v3", None)
    with pytest.raises(InvalidInput, match=r"expected another engine; pip install 'turgor\[box2d\]'; got none"):
        crosscheck(FLAT, THETA, 2)


def test_a_process_that_is_ended_is_told() -> None:
    short, long = (make_job("box2d", make_task("hilly", steps=n), np.zeros((4, len(THETA)))) for n in (5, 5000))
    with Crew(2) as crew:
        answers = crew.run([short, long])
        next(answers)
        pool: Any = crew._pool
        next(iter(pool._processes.values())).kill()
        with pytest.raises(WorkLost, match="one was ended from outside"):
            next(answers)


# --- the command --------------------------------------------------------------------------------------------------

SHORT = ["--repeats", "5", "--threads", "1", "--engines", "box2d"]


def make_run(out: Path, name: str = "hilly", seed: int = 0, steps: int = 60) -> None:
    recipe: dict[str, Any] = {"name": name, "body": "small", "condition": "pressure", "seed": seed, "steps": steps}
    evolve(make_task(**recipe), 21, seed, out, robust_repeats=3, recipe=recipe)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two runs of 1 s on hills and one in the cage."""
    folder = tmp_path_factory.mktemp("crosscheck") / "made"
    make_run(folder / "hilly-0")
    make_run(folder / "hilly-1", seed=1)
    make_run(folder / "deep" / "escape", "escape")
    return folder


@pytest.fixture
def here(tmp_path: Path, made: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An own copy of the runs, in a folder that is the working one."""
    shutil.copytree(made, tmp_path / "runs")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def turgor_process(*argv: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "turgor", *argv]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def complaints(err: str) -> list[str]:
    return [line for line in err.splitlines() if not line.startswith("turgor: compiling the engine")]


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def check_picture(path: Path) -> None:
    from matplotlib.image import imread

    picture = imread(path)
    assert min(picture.shape[:2]) > 400
    assert picture[..., :3].std() > 0.05, "an empty page"


def test_crosscheck_of_a_run(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["crosscheck", "runs/hilly-0", *SHORT, "--controllers", "5", "--json", "found.json"]
    assert main(argv) == 0
    said = capsys.readouterr()
    assert complaints(said.err) == []
    for word in (
        "median ",
        "quartiles ",
        "difference ",
        "KS distance ",
        "ranks of 5 ",
        "1 cm apart ",
        "Box2D 2.3: holds",
    ):
        assert f"\n{word}" in said.out
    assert "hilly, small, pressure, seed 0: champion of generation 1, from 5 starts moved by 0.001 m" in said.out
    out = here / "runs" / "hilly-0" / "crosscheck"
    assert names_in(out) == ["crosscheck.json", *THREE, "replay.html"]
    check_picture(out / "crosscheck.png")
    record, run = read_record(out / "crosscheck.json"), Run.open(here / "runs" / "hilly-0")
    assert msgspec.json.encode(record) == msgspec.json.encode(json.loads((here / "found.json").read_text()))
    assert (record.subject.identity, record.subject.change) == (run.task.identity, "steps=60")
    assert (record.settings.repeats, record.settings.controllers, record.settings.engines) == (5, 5, BOX2D)
    assert record.samples[0].own == run.checked_champion().fitness
    assert record.versions["box2d"].startswith("box2d 2.3")
    again = crosscheck(run.task, run.checked_champion().theta, 5, engines=BOX2D, controllers=5)
    assert (record.samples, record.comparisons) == (again.samples, again.comparisons)


def test_the_figure_of_a_run_shows_every_start_and_where_trajectories_part(here: Path, tmp_path: Path) -> None:
    names, path = ["box2d", "box2d-ccd"], here / "runs" / "deep" / "escape"
    record = crosscheck_run(path, tmp_path / "out", repeats=6, controllers=4, engines=names, processes=1)
    run = Run.open(path)
    found = crosscheck(run.task, run.checked_champion().theta, 6, controllers=4, engines=names)
    fitness, ranks, course, paths = draw_run(record, run.task.scene, found.recordings).figure.axes
    shown = {line.get_label(): line for line in fitness.lines}
    for sample in record.samples:
        assert shown[f"{sample.engine}, starts"].get_xdata().tolist() == sample.fitness
        assert shown[f"{sample.engine}, own start"].get_xdata().tolist() == [sample.own]
    assert [line.get_ydata().tolist() for line in ranks.lines[:2]] == [s.ranked for s in record.samples[1:]]
    parts = [record.comparisons[0].parts_floor, *(c.parts for c in record.comparisons)]
    marks = [line.get_xdata()[0] for line in course.lines if line.get_label() == "_1 cm apart"]
    assert marks == pytest.approx([step / 60 for step in parts if step is not None])
    assert len(marks) >= 1
    colours = [{line.get_color() for line in axes.lines if line.get_label().startswith("Box2D 2.3 with CCD")}
               for axes in (course, paths)]  # fmt: skip
    assert colours[0] == colours[1] == {"#D55E00"}
    check_picture(tmp_path / "out" / "crosscheck.png")


def test_what_an_earlier_crosscheck_left_is_not_kept(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = here / "elsewhere" / "deep"
    argv = ["crosscheck", "runs/deep/escape", *SHORT, "--controllers", "0", "--out", str(out)]
    assert main(argv) == 0
    told = capsys.readouterr().out
    assert "\nsolved " in told
    assert "ranks" not in told
    assert (out / "replay.html").exists()
    assert main([*argv, "--no-replay", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)  # and nothing else
    assert not (out / "replay.html").exists()
    (here / "replay.html").write_text("of something else")
    assert main([*argv[:-1], ".", "--no-replay"]) == 0
    assert (here / "replay.html").read_text() == "of something else"
    assert found["subject"]["task"] == "escape"
    assert names_in(here / "runs" / "deep" / "escape") == names_in(here / "runs" / "hilly-0")  # written elsewhere


def test_check_tells_by_the_exit_status(here: Path) -> None:
    """A champion of 21 evaluations that holds in Box2D 2.3, and in part where its steps are cut into four."""
    argv = ["crosscheck", "runs/hilly-1", "--controllers", "0", "--no-replay", *SHORT]
    assert main([*argv, "--check"]) == 0
    assert main([*argv, "box2d-fine", "--check"]) == 1
    assert main([*argv, "box2d-fine"]) == 0
    record = read_record(here / "runs" / "hilly-1" / "crosscheck" / "crosscheck.json")
    assert [(c.engine, c.holds) for c in record.comparisons] == [("box2d", True), ("box2d-fine", False)]


def test_a_pipe_gets_plain_lines(here: Path) -> None:
    process = turgor_process("crosscheck", "runs/hilly-0", *SHORT, "--threads", "2")
    out, err = process.communicate(timeout=120)
    assert (process.returncode, complaints(err)) == (0, [])
    assert "\x1b" not in out
    assert "\r" not in out
    assert out.splitlines()[-1].startswith("folder ")


def test_the_replay_opens_in_a_browser(browser: Any, here: Path) -> None:
    import base64
    import re

    from browser import until, watched_page

    page_file = here / "runs" / "hilly-0" / "crosscheck" / "replay.html"
    record = crosscheck_run(here / "runs" / "hilly-0", repeats=2, controllers=0, engines=BOX2D, processes=1)
    with watched_page(browser) as page:
        page.goto(page_file.as_uri())
        until(page, "globalThis.player?.stats.firstFrame")
        assert page.evaluate("player.replays.map((r) => r.header.title)") == ["turgor", "Box2D 2.3"]
        assert page.evaluate("player.replays.map((r) => r.steps)") == [60, 60]
    blocks = re.findall(r'class="replay"[^>]*>([^<]+)<', page_file.read_text())
    headers = [read_replay(base64.b64decode(block)).header for block in blocks]
    assert [h.fitness for h in headers] == [sample.own for sample in record.samples]


# --- a campaign ---------------------------------------------------------------------------------------------------


def test_crosscheck_of_a_campaign(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = here / "runs"
    (runs / "broken").mkdir()
    (runs / "broken" / "run.json").write_text("{")
    shutil.copytree(runs / "hilly-0", runs / "young")
    for name in ("champion.npz", "checkpoint.npz"):
        (runs / "young" / name).unlink()
    shutil.copytree(runs / "hilly-0", runs / "slippery")
    task = make_task("flat", slop=0.01, steps=5)
    shutil.rmtree(runs / "slippery")
    evolve(task, 21, out=runs / "slippery", robust_repeats=2)
    shutil.copytree(runs / "hilly-0", runs / "killed")
    killed = Run.open(runs / "killed")
    killed.status = "running"
    killed.write_record()

    assert main(["crosscheck", "runs", *SHORT, "--json", "found.json"]) == 0
    said = capsys.readouterr()
    assert complaints(said.err) == []
    left_out = [line for line in said.out.splitlines() if line.startswith("left out: ")]
    assert [line.split(":")[1].strip() for line in left_out] == [
        str(Path("runs", *name)) for name in (("broken", "run.json"), ("killed",), ("slippery",), ("young",))
    ]
    out = runs / "crosscheck"
    assert names_in(out) == [*THREE, "rows.csv", "runs", "summary.csv"]
    check_picture(out / "crosscheck.png")
    rows, summaries = read_rows(out / "rows.csv", Row), read_rows(out / "summary.csv", Summary)
    assert [row.run for row in rows] == ["deep/escape", "hilly-0", "hilly-1"]
    assert [(s.task, s.champions) for s in summaries] == [("escape", 1), ("hilly", 2), ("all", 3)]
    assert (
        sum((s.same, s.close, s.stronger, s.mixed, s.weaker, s.not_held)[k] for s in summaries for k in range(6)) == 6
    )
    found = json.loads((here / "found.json").read_text())
    assert len(found["left_out"]) == 4
    assert [row["run"] for row in found["rows"]] == [row.run for row in rows]

    row, run = rows[1], Run.open(runs / "hilly-0")
    single = crosscheck(run.task, run.checked_champion().theta, 5, engines=BOX2D, controllers=0)
    sample, comparison = single.samples[1], single.comparisons[0]
    assert (row.median, row.own, row.verdict) == (comparison.median, sample.own, comparison.verdict)
    assert [row.lower, row.upper] == np.percentile(sample.fitness, [25, 75]).tolist()
    assert "all, Box2D 2.3: " in said.out

    # nothing is run again
    times = {path: path.stat().st_mtime_ns for path in (out / "runs").rglob("*.json")}
    assert main(["crosscheck", "runs", *SHORT]) == 0
    assert "3 of 3 runs are known already" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in times} == times
    assert read_rows(out / "rows.csv", Row) == rows
    # but for other settings, another champion, or a record that cannot be read
    (out / "runs" / "hilly-1.json").write_text("{")
    changed = Run.open(runs / "hilly-0")
    changed.champion = msgspec.structs.replace(changed.checked_champion(), theta=changed.checked_champion().theta + 0.5)
    changed.write_champion()
    assert main(["crosscheck", "runs", *SHORT]) == 0
    assert "1 of 3 runs are known already" in capsys.readouterr().out
    assert read_rows(out / "rows.csv", Row)[2] == rows[2]
    assert read_rows(out / "rows.csv", Row)[1] != rows[1]
    assert main(["crosscheck", "runs", *SHORT, "--repeats", "4"]) == 0
    assert "known already" not in capsys.readouterr().out


def test_a_campaign_is_the_same_after_ctrl_c(here: Path, tmp_path: Path) -> None:
    folder = tmp_path / "many"
    for seed in range(3):
        make_run(folder / f"run-{seed}", seed=seed, steps=400)
    argv = ["crosscheck", str(folder), "--repeats", "16", "--threads", "2", "--engines", "box2d"]
    process = turgor_process(*argv)
    first, deadline = folder / "crosscheck" / "runs" / "run-0.json", time.monotonic() + 60
    while not first.exists():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    where = folder / "crosscheck"
    assert process.returncode == 130
    assert complaints(err) == [
        f"turgor: interrupted; every run that was finished is kept in {where}; the same command goes on"
    ]
    assert not (where / "rows.csv").exists()
    kept = first.read_bytes()
    process = turgor_process(*argv)
    out, err = process.communicate(timeout=120)
    assert (process.returncode, complaints(err)) == (0, [])
    assert "of 3 runs are known already" in out
    assert first.read_bytes() == kept
    whole = crosscheck_campaign(folder, tmp_path / "whole", repeats=16, engines=BOX2D, processes=1)
    assert whole.rows == read_rows(where / "rows.csv", Row)
    assert whole.left_out == []


def test_the_folder_disturbs_nothing(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = here / "runs"
    before = Library(runs)
    before.look()
    assert main(["crosscheck", "runs/hilly-0", *SHORT, "--controllers", "0"]) == 0
    assert main(["crosscheck", "runs", *SHORT]) == 0
    after = Library(runs)
    after.look()
    assert (after.runs.keys(), after.campaigns, after.problems) == (before.runs.keys(), before.campaigns, {})
    assert main(["export", "--gallery", "runs", "--out", "gallery.html"]) == 0
    assert main(["resume", "runs/hilly-0", "--evaluations", "40", "--no-video"]) == 0
    assert Run.open(runs / "hilly-0").evaluations == 42
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        ([], "turgor crosscheck: expected RUN, the folder of a run or of a campaign"),
        (["nowhere"], "nowhere: expected the folder of a run or of runs; got nothing there"),
        (["file"], "file: expected the folder of a run or of runs; got a file"),
        (["empty"], "empty: expected the folder of a run or of runs; got no run.json in it or below"),
        (["runs/broken"], "run.json: expected JSON"),
        (["runs/young"], "expected a run with a champion; got none yet (no champion.npz)"),
        (["runs/own"], "expected the task to be passed, because its own function"),
        (["runs/slippery", "--engines", "box2d"], "slop: expected 0.005, which cannot be changed in Box2D; got 0.01"),
        (["useless"], "useless: expected runs with a champion; got "),
        (["runs/hilly-0", "--engines", "ode"], "engine: expected one of box2d, box2d-ccd, box2d-fine, box2d-v3"),
        (["runs/hilly-0", "--engines"], "--engines: expected at least one argument"),
        (["runs/hilly-0", "--repeats", "1"], "--repeats: expected a whole number, at least 2; got 1"),
        (["runs/hilly-0", "--repeats", "20000"], "repeats: expected a whole number, 2 to 10000; got 20000"),
        (["runs/hilly-0", "--controllers", "-1"], "controllers: expected a whole number, 0 to 10000; got -1"),
        (["runs/hilly-0", "--threads", "5000"], "processes: expected a whole number, 1 to 1024; got 5000"),
        (["runs/hilly-0", "--seed", "-1"], "seed: expected a whole number, 0 or more; got -1"),
        (["runs/hilly-0", "--out", "file"], "file: expected to be able to write it; got File exists"),
        (["runs/hilly-0", "--out", "file/deeper"], "file/deeper: expected to be able to write it; got Not a directory"),
        (["runs/hilly-0", "--campaign", "runs"], "--campaign: expected with --suite alone"),
        (["runs", "--controllers", "5"], "--controllers: expected of a single run"),
        (["runs", "--check"], "--check: expected of a single run"),
        (["runs", "--no-replay"], "--no-replay: expected of a single run"),
        (["runs", "--seed", "1"], "--seed: expected of a single run"),
        (["runs/hilly-0", "--suite"], "--suite: expected no RUN beside it"),
        (["--suite", "--engines", "box2d"], "--engines: expected without --suite"),
        (
            ["--suite", "--campaign", "empty"],
            "empty: expected a campaign; turgor reproduce makes one; got no champions",
        ),
    ],
)
def test_errors_are_one_line(argv: list[str], text: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = here / "runs"
    (here / "file").write_text("")
    (here / "empty").mkdir()
    for broken in (runs / "broken", here / "useless" / "broken"):
        broken.mkdir(parents=True)
        (broken / "run.json").write_text("{")
    shutil.copytree(runs / "hilly-0", runs / "young")
    for name in ("champion.npz", "checkpoint.npz"):
        (runs / "young" / name).unlink()
    own = msgspec.structs.replace(make_task("flat", steps=5), fitness=lambda out: out.com[:, 0])
    evolve(own, 21, out=runs / "own", robust_repeats=2)
    evolve(make_task("flat", slop=0.01, steps=5), 21, out=runs / "slippery", robust_repeats=2)
    before = sorted(here.rglob("*"))
    assert main(["crosscheck", *argv]) == 2
    (line,) = complaints(capsys.readouterr().err)
    assert line.startswith("turgor: error: ")
    assert text in line
    assert sorted(here.rglob("*")) == before


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = here / "runs" / "hilly-0"
    run.chmod(0o500)
    try:
        assert main(["crosscheck", str(run), *SHORT]) == 2
    finally:
        run.chmod(0o700)
    assert "crosscheck: expected to be able to write it; got Permission denied" in capsys.readouterr().err
