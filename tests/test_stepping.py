"""Agents driven step by step from outside: restarts one by one, scenes of their own, copies in mid-course."""

import copy
import pickle
from collections.abc import Callable
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from turgor.errors import InvalidInput
from turgor.scene import Scene, hills, polyline
from turgor.simulate import Simulator, Step
from turgor.task import Task, make_task

pytestmark = pytest.mark.usefixtures("all_threads")
FIELDS = ("observation", "position", "velocity", "touch", "pressure", "area", "solved")


def commands(agents: int, steps: int, seed: int = 0) -> np.ndarray:
    """[step, agent, output]: slow waves, so that bodies roll, let their gas go and touch themselves."""
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0, 7, (2, agents, 11))
    wave = np.sin(phase + 0.05 * speed * np.arange(steps)[:, None, None])
    wave[:, :, 10] = -np.abs(wave[:, :, 10]) * 20
    return wave.astype(np.float32)


def task_on(scene: Scene) -> Task:
    return msgspec.structs.replace(make_task("hilly"), scene=scene)


def same(one: Step, two: Step, agents: object = slice(None), others: object = None) -> None:
    others = agents if others is None else others
    for name in FIELDS:
        mine, theirs = getattr(one, name)[agents], getattr(two, name)[others]
        assert mine.tobytes() == theirs.tobytes(), name


@pytest.mark.parametrize("name", ["hilly", "escape"])
def test_a_restarted_agent_does_what_a_new_one_does_and_its_neighbours_go_on(name: str) -> None:
    """At all ages of the window, in blocks whose agents are of different ages, over two threads."""
    task, agents, steps = make_task(name), 37, 260
    rng, drive = np.random.default_rng(1), commands(agents, steps)
    together, born = Simulator(task, threads=2), np.zeros(agents, dtype=int)
    together.reset(agents)
    alone = {k: Simulator(task, threads=1) for k in (0, 5, 15, 16, 20, 36)}
    for simulator in alone.values():
        simulator.reset(1)
    for t in range(steps):
        seen = together.step(drive[t])
        for k, simulator in alone.items():
            same(simulator.step(drive[t, k][None]), seen, [0], [k])
        which = rng.uniform(size=agents) < 0.02
        born[which] = t
        if which.any():
            seen = together.restart(which)
            for k in alone:
                if which[k]:
                    alone[k] = Simulator(task, threads=1)
                    same(alone[k].reset(1), seen, [0], [k])
    assert len(np.unique(born[list(alone)] % task.sensing.window)) > 3  # of different ages
    assert seen.touch[:, :].sum(axis=1).max() >= 5


def test_a_restart_may_be_anywhere() -> None:
    task = make_task("flat")
    elsewhere = task.position + [3.0, 0.5]
    simulator = Simulator(task)
    simulator.reset(3)
    for row in commands(3, 30):
        simulator.step(row)
    seen = simulator.restart(np.array([False, True, False]), elsewhere[None])
    np.testing.assert_allclose(seen.position[1], elsewhere, rtol=1e-6)
    same(Simulator(task).reset(1, elsewhere[None]), seen, [0], [1])


def test_every_agent_on_a_scene_of_its_own() -> None:
    agents, steps = 19, 150
    scenes, drive = [hills(k, height=1 + k % 3) for k in range(agents)], commands(agents, steps)
    task = make_task("hilly")
    together = Simulator(task, threads=2)
    path = [together.reset(agents, scenes=scenes)]
    path += [together.step(row) for row in drive]
    for k in (0, 7, 15, 16, 18):
        alone = Simulator(task_on(scenes[k]), threads=1)
        same(alone.reset(1), path[0], [0], [k])
        for before, after, row in zip(path, path[1:], drive, strict=False):
            same(alone.step(row[k][None]), after, [0], [k])
            assert before is not after


def test_a_restart_on_another_scene_however_large() -> None:
    """A scene with ten times the segments does not fit the room that there was: all agents move house."""
    agents, drive = 18, commands(18, 90)
    fine = polyline(np.stack([np.linspace(-20, 400, 500), np.tile([0.0, 0.3], 250)], axis=1))
    scenes, task = [hills(k) for k in range(agents)], make_task("hilly")
    untouched, moved = Simulator(task, threads=1), Simulator(task, threads=1)
    for simulator in (untouched, moved):
        simulator.reset(agents, scenes=scenes)
        for row in drive[:40]:
            simulator.step(row)
    which = np.zeros(agents, dtype=bool)
    which[[3, 17]] = True
    seen = moved.restart(which, scenes=[fine, hills(99)])
    alone = [Simulator(task_on(scene), threads=1) for scene in (fine, hills(99))]
    for simulator, k in zip(alone, (3, 17), strict=True):
        same(simulator.reset(1), seen, [0], [k])
    for row in drive[40:]:
        seen, before = moved.step(row), untouched.step(row)
        same(seen, before, ~which)
        for simulator, k in zip(alone, (3, 17), strict=True):
            same(simulator.step(row[k][None]), seen, [0], [k])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda simulator: pickle.loads(pickle.dumps(simulator))])
def test_a_copy_goes_on_by_itself(copied: Callable[[Simulator], Simulator]) -> None:
    drive = commands(20, 60)
    first = Simulator(make_task("hilly"), threads=2)
    first.reset(20, scenes=[hills(k) for k in range(20)])
    for row in drive[:30]:
        first.step(row)
    second = copied(first)
    for row in drive[30:]:
        one, two = first.step(row), second.step(row)
        same(one, two)
    first.step(drive[0])
    same(second.restart(np.zeros(20, dtype=bool)), two)


def test_what_a_step_tells() -> None:
    task = make_task("escape")
    simulator = Simulator(task)
    seen = [simulator.reset(4)] + [simulator.step(row) for row in commands(4, 80)]
    for before, after in pairwise(seen):
        assert after.position.shape == after.velocity.shape == (4, 10, 2)
        np.testing.assert_allclose(after.position - before.position, after.velocity / 60, atol=0.25)
        np.testing.assert_allclose(after.area, task.body.area(after.position.astype(np.float64)), rtol=1e-4)
    last = seen[-1]
    assert set(np.unique(last.touch)) == {0, 1}
    assert last.solved.dtype == bool
    low, high = task.pressure_range[0]
    assert (last.pressure >= low * 0.999).all()
    assert (last.pressure <= high * 1.001).all()


def test_a_step_is_written_over_where_it_is_given_back() -> None:
    simulator, drive = Simulator(make_task("flat")), commands(3, 3)
    first = simulator.reset(3)
    was = first.position.copy()
    assert simulator.step(drive[0], out=first) is first
    assert not np.array_equal(first.position, was)
    kept = first.position.copy()
    simulator.step(drive[1])
    np.testing.assert_array_equal(first.position, kept)


def test_a_push_changes_the_momentum_as_said_and_nobody_else() -> None:
    """In the air, where gravity alone acts besides; over two threads and a block that is not full."""
    agents, pushed, mass = 19, 17, 3
    task = make_task("flat", gravity=0.0)
    high = np.broadcast_to(task.position + [0.0, 40.0], (agents, 10, 2))
    untouched, moved = Simulator(task, threads=2), Simulator(task, threads=2)
    for simulator in (untouched, moved):
        simulator.reset(agents, high)
    change = np.zeros((agents, 10, 2))
    change[pushed, mass] = [2.0, -0.5]
    others = np.arange(agents) != pushed
    for k, row in enumerate(commands(agents, 40)):
        if k % 10 == 0:
            moved.push(change)
        before, seen = untouched.step(row), moved.step(row)
        same(before, seen, others)
        gained = (seen.velocity - before.velocity)[pushed].astype(np.float64).sum(axis=0)
        np.testing.assert_allclose(gained, (k // 10 + 1) * change[pushed, mass], atol=1e-3)


def test_a_push_of_nothing_leaves_every_bit() -> None:
    simulator, plain = Simulator(make_task("hilly")), Simulator(make_task("hilly"))
    for one in (simulator, plain):
        one.reset(3)
    for row in commands(3, 120):
        simulator.push(np.zeros((3, 10, 2)))
        same(simulator.step(row), plain.step(row))


def test_solved_agents_start_again() -> None:
    simulator = Simulator(make_task("escape", cage_width=0.5))
    outside = simulator.task.position + [40.0, 0.0]
    simulator.reset(2, np.stack([outside, simulator.task.position]))
    assert simulator.step(np.zeros((2, 11))).solved.tolist() == [True, False]
    seen = simulator.restart(np.array([True, False]))
    assert not seen.solved.any()
    assert not simulator.step(np.zeros((2, 11))).solved.any()


REFUSED = {
    "restart before reset": (lambda s: Simulator(s.task).restart(np.ones(2, bool)), "call reset first"),
    "another number of agents": (lambda s: s.restart(np.ones(3, bool)), "bools of shape [2]"),
    "indices in place of bools": (lambda s: s.restart([0, 1]), "bools of shape [2]"),
    "scenes after a reset without": (lambda s: s.restart(np.ones(2, bool), scenes=[hills(0)] * 2), "reset with scenes"),
    "too few scenes": (lambda s: s.reset(2, scenes=[hills(0)]), "one for each of 2 agents; got 1"),
    "a push before reset": (
        lambda s: Simulator(s.task).push(np.zeros((2, 10, 2))),
        "push: expected agents at the start",
    ),
    "a push of others": (lambda s: s.push(np.zeros((1, 10, 2))), "shape [2, 10, 2]; got shape [1, 10, 2]"),
    "a push of NaN": (lambda s: s.push(np.full((2, 10, 2), np.nan)), "finite numbers of shape [2, 10, 2]; got NaN"),
    "a push beyond float32": (lambda s: s.push(np.full((2, 10, 2), 1e39)), "NaN, infinity or too large"),
    "a step of others": (lambda s: s.step(np.zeros((2, 11)), out=Simulator(s.task).reset(3)), "these 2 agents"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(case: str) -> None:
    make, expected = REFUSED[case]
    simulator = Simulator(make_task("hilly"))
    simulator.reset(2)
    with pytest.raises(InvalidInput) as error:
        make(simulator)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_few_agents_are_one_threads_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waking another thread takes longer than their step."""
    monkeypatch.undo()
    for body, agents, parts in (("small", 1999, 1), ("small", 2000, 2), ("large", 1000, 2), ("large", 4000, 3)):
        simulator = Simulator(make_task(body=body), threads=3)
        simulator.reset(agents)
        assert len(simulator._stepping) == parts
