"""The same bits for a given agent: whatever the batch, its place, its neighbours, the threads, the processor."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features

from turgor.simulate import Rollout, Simulator, _parts
from turgor.task import Leave, make_task

FIELDS = ("position", "com", "start", "steps", "solved", "fitness")
AGENTS = 130
SIZES = (1, 2, 15, 16, 17, 33, 130)
STEPS = 400

TASKS = {
    "hilly": make_task("hilly", steps=STEPS),
    "hilly-springs": make_task("hilly", condition="springs", seed=1, steps=STEPS),
    "hilly-passive": make_task("hilly", condition="passive", steps=STEPS),
    "hilly-medium": make_task("hilly", body="medium", seed=2, steps=STEPS),
    "hilly-large": make_task("hilly", body="large", steps=STEPS),
    "hilly-large-area": make_task("hilly", body="large", fitness="area", steps=STEPS),
    "rough": make_task("hilly", hill_step=1.0, hill_height=0.7, steps=STEPS),
    "flat": make_task("flat", steps=STEPS),
    "flat-collapsing": make_task("flat", pressure_max=0.2, body="medium", steps=STEPS),
    "escape": make_task("escape", steps=STEPS),
    "escape-large": make_task("escape", body="large", condition="springs", steps=STEPS),
    "escape-authors": make_task("escape-authors", body="medium", steps=STEPS),
    "inflation": make_task("inflation", steps=STEPS, rest_steps=200),
    "inflation-large": make_task("inflation", body="large", steps=STEPS, rest_steps=200),
    "mlp": make_task("hilly", controller="mlp", steps=STEPS),
    "sinusoid": make_task("hilly", controller="sinusoid", steps=STEPS),
    "distributed": make_task("hilly", controller="distributed", steps=STEPS),
    "distributed-large": make_task("escape", body="large", condition="springs", controller="distributed", steps=STEPS),
    # ends while others are under way
    "leaving": msgspec.structs.replace(make_task("flat", steps=STEPS), end=Leave(half_width=0.5), fitness="elapsed"),
}


@functools.cache
def agents(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Controllers and starts: every third agent of strong will, every fourth dropped or squeezed at its start."""
    task, rng = TASKS[name], np.random.default_rng(7)
    theta = rng.uniform(-1, 1, (AGENTS, task.parameter_count))
    theta[::3] *= 20
    position = np.repeat(task.position[None], AGENTS, axis=0)
    position += rng.uniform(-1e-3, 1e-3, position.shape)
    centre = position.mean(axis=1, keepdims=True)
    position[3::4] = (centre + (position - centre) * [0.4, 1.0])[3::4]
    if name == "leaving":
        position[:, :, 0] += rng.uniform(5.6, 7, (AGENTS, 1))
    return theta, position


def rollout(name: str, chosen: np.ndarray, threads: int = 1) -> Rollout:
    theta, position = agents(name)
    return Simulator(TASKS[name], threads=threads).rollout(theta[chosen], position=position[chosen])


@functools.cache
def alone(name: str) -> Rollout:
    """All agents in one batch on one thread: what the others are compared to."""
    return rollout(name, np.arange(AGENTS))


def same(name: str, chosen: np.ndarray, out: Rollout) -> None:
    for field in FIELDS:
        mine, expected = getattr(out, field), getattr(alone(name), field)[chosen]
        assert mine.tobytes() == expected.tobytes(), f"{field}: {np.abs(mine - expected.astype(float)).max()}"


@pytest.mark.parametrize("name", TASKS)
def test_the_agents_differ_and_move(name: str) -> None:
    out = alone(name)
    assert len({x.tobytes() for x in out.position}) == AGENTS
    assert np.isfinite(out.position).all()
    assert (out.steps == STEPS).any()
    if name == "leaving":
        assert len(set(out.steps[out.solved])) > 5


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", TASKS)
def test_the_batch_size_does_not_matter(name: str, size: int) -> None:
    first = np.arange(size)
    same(name, first, rollout(name, first))
    last = np.arange(AGENTS - size, AGENTS)
    same(name, last, rollout(name, last))


@pytest.mark.parametrize("name", TASKS)
def test_place_and_neighbours_do_not_matter(name: str) -> None:
    rng = np.random.default_rng(1)
    for size in (16, 20, 50):
        chosen = rng.integers(0, AGENTS, size)  # some more than once
        same(name, chosen, rollout(name, chosen))
    for lane in (0, 5, 15):
        chosen = np.full(16, 3)
        chosen[lane] = 0
        same(name, chosen, rollout(name, chosen))
    backwards = np.arange(AGENTS)[::-1]
    same(name, backwards, rollout(name, backwards))


@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("name", TASKS)
def test_threads_do_not_matter(name: str, threads: int) -> None:
    for size in (2, 33, 130):
        chosen = np.arange(size)
        same(name, chosen, rollout(name, chosen, threads))


@pytest.mark.parametrize("name", TASKS)
def test_the_default_start_is_the_tasks(name: str) -> None:
    task, theta = TASKS[name], agents(name)[0][:20]
    simulator = Simulator(task, threads=1)
    usual = simulator.rollout(theta)
    given = simulator.rollout(theta, position=np.repeat(task.position[None], 20, axis=0))
    again = simulator.rollout(theta)
    for field in FIELDS:
        for other in (given, again):
            assert getattr(usual, field).tobytes() == getattr(other, field).tobytes(), field


@pytest.mark.parametrize("name", ["hilly", "escape-large", "leaving", "sinusoid", "distributed"])
def test_a_recording_has_the_bits_of_the_rollout(name: str) -> None:
    theta, position = agents(name)
    for agent in (0, 1, 3):
        rec = Simulator(TASKS[name]).record(theta[agent], position=position[agent])
        same(name, np.array([agent]), rollout(name, np.array([agent])))
        assert rec.position[-1].tobytes() == alone(name).position[agent].tobytes()
        assert rec.fitness == alone(name).fitness[agent]


def test_parts_are_worth_a_thread() -> None:
    def sizes(agents: int, threads: int, masses: int = 10, steps: int = 1800) -> list[int]:
        return [part.stop - part.start for part in _parts(agents, agents * masses * steps, threads)]

    assert sizes(1024, 2) == [128] * 8  # blocks enough, no more than 8 at once
    assert sizes(32, 1) == [32]
    assert sizes(32, 2) == [16, 16]
    assert sorted(sizes(25, 2)) == [12, 13]
    assert sizes(32, 2, steps=30) == [32]  # done before another thread is awake
    # a block is shared only where much is to be done
    assert sizes(16, 16) == [8, 8]
    assert sizes(16, 16, steps=600) == [16]
    assert len(sizes(16, 16, masses=20)) == 5
    assert sizes(3, 16, masses=20, steps=10**6) == [1, 1, 1]


@pytest.mark.usefixtures("all_threads")
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_stepping_does_not_depend_on_batch_or_threads(threads: int) -> None:
    task, rng = make_task("hilly"), np.random.default_rng(2)
    commands = rng.uniform(-1, 1, (40, 40, 11))
    one, many = Simulator(task, threads=1), Simulator(task, threads=threads)
    one.reset(3)
    many.reset(40)
    for row in commands:
        few, all_of_them = one.step(row[:3]), many.step(row)
    for field in ("observation", "position", "velocity", "pressure"):
        assert getattr(few, field).tobytes() == getattr(all_of_them, field)[:3].tobytes(), field


# --- instruction sets ---------------------------------------------------------------------------------------


def digest() -> str:
    """Of what 20 agents do in 600 steps on five tasks."""
    found = hashlib.sha256()
    linear = [("hilly", "small", "linear"), ("escape", "medium", "linear"), ("hilly", "large", "linear")]
    for name, body, controller in [*linear, ("hilly", "small", "sinusoid"), ("hilly", "medium", "distributed")]:
        task = make_task(name, body=body, controller=controller, steps=600)
        theta = np.random.default_rng(5).uniform(-1, 1, (20, task.parameter_count))
        theta[::3] *= 10
        found.update(Simulator(task, threads=1).rollout(theta).position.tobytes())
    return found.hexdigest()


ELSEWHERE = """
import sys
sys.path.insert(0, sys.argv[1])
import test_determinism
from turgor.physics.build import optimised
from turgor.physics.engine import target_machine
from turgor.physics.step import ARGUMENTS, run_blocks

print(test_determinism.digest())
code = target_machine().emit_assembly(optimised(run_blocks, ARGUMENTS))
print(*(name for name in ("xmm", "ymm", "zmm", "vfmadd") if name in code))
"""

INSTRUCTION_SETS = {
    "SSE2": ("nocona", "+sse2", {"xmm"}),
    "AVX2": ("haswell", "+avx2,+fma", {"xmm", "ymm"}),
}


def elsewhere(cpu: str, features: str, cache: Path) -> subprocess.Popen[str]:
    """A process that compiles the engine for another processor and prints its digest and its registers."""
    settings = {"NUMBA_CPU_NAME": cpu, "NUMBA_CPU_FEATURES": features, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", ELSEWHERE, str(Path(__file__).parent)]
    return subprocess.Popen(
        command, env={**os.environ, **settings}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.fixture(scope="module", autouse=True)
def elsewheres(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, subprocess.Popen[str]]]:
    """The processes of all instruction sets; compilation takes a while, so they begin with the first test here."""
    cache = tmp_path_factory.mktemp("caches")
    running = {}
    if platform.machine().lower() in ("x86_64", "amd64"):
        for name, (cpu, features, _) in INSTRUCTION_SETS.items():
            running[name] = elsewhere(cpu, features, cache / name)
    yield running
    for process in running.values():
        process.kill()
        process.communicate()


@pytest.mark.parametrize("name", INSTRUCTION_SETS)
def test_the_instruction_set_does_not_matter(name: str, elsewheres: dict[str, subprocess.Popen[str]]) -> None:
    """SSE2, and AVX2 on a processor that could fuse multiplications with additions, against this machine's best."""
    if name not in elsewheres:
        pytest.skip("needs an x86-64 processor")
    if name == "AVX2" and "avx2" not in host_features():
        pytest.skip("needs a processor with AVX2")
    out, err = elsewheres[name].communicate()
    assert elsewheres[name].returncode == 0, err
    bits, *registers = out.split()
    assert set(registers) == INSTRUCTION_SETS[name][2]
    assert bits == digest()


def host_features() -> set[str]:
    """What this machine's processor has."""
    return {name for name, there in get_host_cpu_features().items() if there}
