"""Very many agents: rollouts in chunks have the bits of one rollout, and neither way takes memory that grows."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from turgor.control import CONTROLLERS
from turgor.errors import InvalidInput
from turgor.simulate import Rollout, Simulator
from turgor.task import Task, make_task

FIELDS = ("position", "com", "start", "steps", "solved", "fitness")
STEPS = 60


def draw(task: Task, agents: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-3, 3, (agents, task.parameter_count))


def assert_same(one: Rollout, other: Rollout) -> None:
    for field in FIELDS:
        assert getattr(one, field).tobytes() == getattr(other, field).tobytes(), field


@pytest.mark.parametrize("task", [make_task(steps=STEPS), make_task("escape", steps=STEPS)], ids=lambda task: task.name)
@pytest.mark.parametrize("lengths", [[150], [1, 16, 17, 0, 116], [75, 75]], ids=str)
def test_chunks_have_the_bits_of_one_rollout(task: Task, lengths: list[int]) -> None:
    simulator, theta = Simulator(task, threads=2), draw(task, sum(lengths))
    chunks = np.split(theta, np.cumsum(lengths)[:-1])
    outs = list(simulator.rollouts(chunks))
    assert [len(out.fitness) for out in outs] == lengths
    whole = simulator.rollout(theta)
    for field in FIELDS:
        pieces = np.concatenate([getattr(out, field) for out in outs])
        assert pieces.tobytes() == getattr(whole, field).tobytes(), field


def test_a_chunk_is_made_when_it_is_asked_for_and_not_kept() -> None:
    task, made, alive = make_task(steps=1), [], []

    class Chunk(np.ndarray):
        def __del__(self) -> None:
            alive.remove(id(self))

    def chunks() -> Iterator[np.ndarray]:
        for k in range(1_000_000):
            made.append(k)
            chunk = draw(task, 3, seed=k).view(Chunk)
            alive.append(id(chunk))
            yield chunk
            del chunk
            assert not alive

    outs = Simulator(task, threads=1).rollouts(chunks())
    assert not made
    for k in range(5):
        assert len(next(outs).fitness) == 3
        assert made == list(range(k + 1))


@pytest.mark.parametrize(
    ("chunks", "told"),
    [
        (np.zeros((5, 374)), r"chunks: expected several theta, as \[theta\] is; got one, shape \[5, 374\]"),
        (3, "chunks: expected theta after theta; got 3"),
    ],
    ids=["theta", "number"],
)
def test_what_are_no_chunks_is_told_at_once(chunks: object, told: str) -> None:
    with pytest.raises(InvalidInput, match=told):
        Simulator(make_task(steps=1)).rollouts(chunks)


def test_a_wrong_chunk_is_told_after_the_right_ones_before_it() -> None:
    outs = Simulator(make_task(steps=1)).rollouts([np.zeros((2, 374)), np.zeros((2, 340))])
    assert len(next(outs).fitness) == 2
    with pytest.raises(InvalidInput, match=r"theta: expected shape \[agent, 374\]; got shape \[2, 340\]"):
        next(outs)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_theta_in_float32_has_the_bits_of_the_same_numbers_in_float64(controller: str) -> None:
    task = make_task(controller=controller, steps=STEPS)
    simulator, single = Simulator(task), draw(task, 40).astype(np.float32)
    assert_same(simulator.rollout(single), simulator.rollout(single.astype(np.float64)))
    assert_same(simulator.rollout(np.asfortranarray(single)), simulator.rollout(single.astype(">f4")))
    rec, same = simulator.record(single[0]), simulator.record(single[0].astype(np.float64))
    assert rec.position.tobytes() == same.position.tobytes()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("value", "told"),
    [
        (np.nan, "finite numbers; got nan at agent 3, parameter 7"),
        (np.inf, "finite numbers; got inf at agent 3, parameter 7"),
        (-np.inf, "finite numbers; got -inf at agent 3, parameter 7"),
        (2.0**51, "within 1e15; got 2"),
        (-(2.0**51), "within 1e15; got 2"),
    ],
)
def test_numbers_that_are_none_are_told_in_either_precision(dtype: type, value: float, told: str) -> None:
    task = make_task(steps=1)
    theta = draw(task, 5).astype(dtype)
    theta[3, 7] = value
    with pytest.raises(InvalidInput, match=told):
        Simulator(task).rollout(theta)


def test_fitness_by_area_of_many_has_the_bits_of_few() -> None:
    """More agents than are looked at in one piece."""
    task = make_task(fitness="area", steps=1)
    simulator, theta = Simulator(task), draw(task, 4100)
    many = simulator.rollout(theta)
    assert np.concatenate([simulator.rollout(part).fitness for part in (theta[:7], theta[7:])]).tobytes() == (
        many.fitness.tobytes()
    )


# --- memory ---------------------------------------------------------------------------------------------------------

# theta is one row seen many times (a view), so that what grows is the simulator's alone
PEAK = """
import resource, sys, numpy, turgor
way, agents = sys.argv[1], int(sys.argv[2])
task = turgor.make_task("hilly", steps=3)
simulator = turgor.Simulator(task, threads=2)
row = numpy.random.default_rng(0).uniform(-1, 1, (1, task.parameter_count)).astype(way.split("-")[1])
theta = numpy.broadcast_to(row, (agents, row.shape[1]))
simulator.rollout(theta[:2000])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
if way.startswith("stream"):
    kept = sum(len(out.fitness) for out in simulator.rollouts(theta[k : k + 2000] for k in range(0, agents, 2000)))
    size = 0
else:
    kept = simulator.rollout(theta)
    size = sum(getattr(kept, name).nbytes for name in kept.__struct_fields__)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
unit = 1 if sys.platform == "darwin" else 1024
print((after - before) * unit - size)
"""


def grown(way: str, agents: int) -> float:
    """By how many MB a process grows beyond theta and its results."""
    done = subprocess.run([sys.executable, "-c", PEAK, way, str(agents)], capture_output=True, text=True, check=True)
    return int(done.stdout) / 1e6


@pytest.mark.parametrize("way", ["stream-float64", "stream-float32", "whole-float64", "whole-float32"])
def test_memory_does_not_grow_with_the_agents(way: str) -> None:
    """100,000 agents would take 299 MB of theta in float64, 150 in float32, and 37 as one mask of what is finite."""
    pytest.importorskip("resource", reason="peak memory is not told on Windows")
    assert grown(way, 100_000) < grown(way, 20_000) + 8
