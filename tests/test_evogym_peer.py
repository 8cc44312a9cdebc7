"""EvoGym beside the engine. What needs EvoGym itself takes the Python that EVOGYM names, and is skipped without one:

EVOGYM=../evogym/bin/python ./run pytest tests/test_evogym_peer.py
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from turgor import bench
from turgor.bench import evogym, page, peers
from turgor.bench.report import Row, rows_of
from turgor.errors import InvalidInput
from turgor.task import make_task

BESIDE = {"large": (20, 55, 12), "small": (10, 21, 4)}  # masses, springs, actuators of a robot
PLAN = bench.Plan(
    controllers=("inflated",),
    steps=20,
    seconds=0.0,
    repeats=2,
    peer_bodies=("small",),
    peer_agents=1,
    peer_batch=20,
    evogym_robots=2,
    evogym_steps=30,
)


@pytest.fixture(scope="module")
def python() -> str:
    """A Python that has EvoGym."""
    named = evogym.find_python(os.environ.get("EVOGYM"))
    if named is None:
        pytest.skip("needs a Python that has EvoGym, named by EVOGYM (benchmarks/README.md)")
    return named


@pytest.fixture(scope="module")
def rows(python: str) -> list[Row]:
    return list(peers.peer(msgspec.structs.replace(PLAN, evogym=python)))


# --- with EvoGym ------------------------------------------------------------------------------------------------------


def test_rows_beside_the_engine(rows: list[Row]) -> None:
    mine = [row for row in rows if "evogym" in row.name]
    one_world = ["peer.evogym", "peer.evogym.life", "peer.evogym.simulator"]
    one_world += 2 * ["peer.ratio.evogym", "peer.ratio.evogym.life"]
    assert [(row.task, row.name) for row in mine] == [(world, name) for world in evogym.WORLDS for name in one_world]
    assert len({bench.report.identity(row) for row in rows}) == len(rows)
    engine = {row.batch: row.value for row in rows_of(rows, "peer.engine")}
    assert list(engine) == [1, 20]
    for world in evogym.WORLDS:
        (rate,), (life,) = rows_of(mine, "peer.evogym", task=world), rows_of(mine, "peer.evogym.life", task=world)
        (inside,) = rows_of(mine, "peer.evogym.simulator", task=world)
        assert life.value == pytest.approx(rate.value * 1e6 * 0.003)
        assert 20 < inside.value < 100
        for row in rows_of(mine, "peer.ratio.evogym", task=world):
            assert row.value == pytest.approx(engine[row.batch] / rate.value)
    (plane,), (walker,) = (rows_of(mine, "peer.evogym", task=world) for world in evogym.WORLDS)
    assert plane.value > 2 * walker.value  # 10 masses against 212
    assert "10 masses, 21 springs; 212 masses in its world" in walker.what


def test_without_box2d_there_are_still_rows(
    python: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peers, "PEER", Path("nowhere/box2d_peer.py"))
    peers.load_peer.cache_clear()
    plan = msgspec.structs.replace(PLAN, evogym=python, controllers=("random", "inflated"), evogym_steps=5, repeats=1)
    rows = list(peers.peer(plan))
    assert {row.name.partition(".evogym")[0] for row in rows} == {"peer.engine", "peer", "peer.ratio"}
    assert len(rows) == 2 + 2 * 7
    assert "no rows for Box2D" in capsys.readouterr().err


def test_time_in_falls(rows: list[Row]) -> None:
    """A step of EvoGym is 3.3 times as much of a fall from mass to mass as one of turgor."""
    (fast, *_), (falls, *_) = rows_of(rows, "peer.ratio.evogym"), rows_of(rows, "peer.ratio.evogym.life")
    assert fast.value / falls.value == pytest.approx(3.3, abs=0.05)
    assert peers.falls_a_step(make_task("hilly", body="small")) == pytest.approx(0.021, abs=0.0005)


def test_page_has_a_line_for_each_world(rows: list[Row]) -> None:
    text = page.page_text(page.Record(facts=bench.environment(), rows=rows))
    lines = text[text.index("## EvoGym") :].splitlines()
    assert [line.split(" | ")[:2] for line in lines[-2:]] == [["| small", world] for world in evogym.WORLDS]
    assert text.count("## EvoGym") == 1


@pytest.mark.parametrize("world", evogym.WORLDS)
@pytest.mark.parametrize("body", BESIDE)
def test_robots_are_what_the_page_says(python: str, body: str, world: str) -> None:
    """Their sizes; the same turn again and again; and that they move."""
    with evogym.robots_at_work(python, body, world, robots=2, steps=200) as robots:
        facts = robots.facts
        assert (facts.masses, facts.springs, facts.actuators) == BESIDE[body]
        assert facts.masses_in_world == facts.masses + (202 if world == "Walker-v0" else 0)
        robots.turn()
        robots.turn()
    first, again = robots.turns
    assert first.voxels == again.voxels
    assert first.steps == 400
    assert min(abs(np.array(first.voxels))) > 0.01
    assert len(set(first.voxels)) == 2
    assert 0 < first.simulator < first.seconds
    assert robots.process.poll() is not None


FALL = """
import json, sys
sys.path.insert(0, sys.argv[1])
import evogym, evogym_peer as peer, numpy
world = evogym.EvoWorld()
world.add_from_array("robot", numpy.full((1, 1), 3), 1, 60)
sim = evogym.EvoSim(world)
for _ in range(40):
    peer.Sim.step(sim)
at, speed = peer.Sim.object_pos_at_time, peer.Sim.object_vel_at_time
fallen = at(sim, 0, "robot")[1].mean() - at(sim, 40, "robot")[1].mean()
print(json.dumps([fallen, -speed(sim, 40, "robot")[1].mean(), 40 * peer.STEP, peer.GRAVITY, peer.VOXEL,
                  float(numpy.ptp(at(sim, 0, "robot")[0]))]), file=sys.stderr)
"""


def test_a_step_is_as_long_as_its_sources_say(python: str) -> None:
    """A voxel in free fall: d = g t² / 2 and v = g t tell time and gravity apart. EvoGym's drag takes 1 %."""
    done = subprocess.run(
        [python, "-c", FALL, str(evogym.PROGRAM.parent)], env=evogym.surroundings(python),
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    fallen, speed, seconds, gravity, voxel, side = json.loads(done.stderr.splitlines()[-1])
    assert 2 * fallen / speed == pytest.approx(seconds, rel=0.02)
    assert speed**2 / (2 * fallen) == pytest.approx(gravity, rel=0.02)
    assert side == pytest.approx(voxel)


def test_no_graphics_are_needed(python: str) -> None:
    """Without a display; and that what EvoGym's C++ prints stays out of the answers."""
    without = {name: value for name, value in evogym.surroundings(python).items() if "DISPLAY" not in name}
    done = subprocess.run(
        [python, str(evogym.PROGRAM), "small", "--robots", "1", "--steps", "5", "--serve"], env=without, input="\n\n",
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert [sorted(json.loads(line))[-1] for line in done.stdout.splitlines()] == ["version", "voxels", "voxels"]


def test_a_program_that_fails_is_told(python: str) -> None:
    with (
        pytest.raises(RuntimeError, match=r"evogym_peer.py ended: .*invalid choice: 'moon'"),
        evogym.robots_at_work(python, "small", "moon", robots=1, steps=1),
    ):
        pass


# --- without ----------------------------------------------------------------------------------------------------------


def test_a_python_without_evogym_is_told_before_measuring(capsys: pytest.CaptureFixture[str]) -> None:
    if evogym.has_evogym(sys.executable):
        pytest.skip("this Python has EvoGym")
    assert evogym.find_python(None) is None
    for named in (sys.executable, "nowhere/python", "", "a\0b"):
        assert bench.main(["--only", "kernel", "--evogym", named]) == 2
        printed = capsys.readouterr()
        assert printed.err.startswith("turgor bench: --evogym: expected a Python that can import evogym; got ")
        assert printed.err.count("\n") == 1
        assert printed.out == ""


def test_without_the_repository_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evogym, "PROGRAM", Path("nowhere/evogym_peer.py"))
    with pytest.raises(InvalidInput, match=r"^--evogym: expected turgor's repository"):
        evogym.find_python(sys.executable)


def test_a_program_that_cannot_import_evogym_ends_with_its_last_line() -> None:
    if evogym.has_evogym(sys.executable):
        pytest.skip("this Python has EvoGym")
    with (
        pytest.raises(RuntimeError, match=r"^evogym_peer.py ended: ModuleNotFoundError: No module named 'evogym'$"),
        evogym.robots_at_work(sys.executable, "small", "plane", robots=1, steps=1),
    ):
        pass


def test_another_python_does_not_get_the_paths_of_this_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "somewhere")
    assert "PYTHONPATH" not in evogym.surroundings("another/python")
    assert evogym.surroundings(sys.executable)["PYTHONPATH"] == "somewhere"
    assert evogym.surroundings("another/python")["OPENBLAS_NUM_THREADS"] == "1"
