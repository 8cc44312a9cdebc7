"""The engine with an agent a thread: its code on the CPU, its PTX without a GPU, and on a GPU where there is one."""

from __future__ import annotations

import functools
import re
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import ptx
import pytest
from numba import njit

import turgor.simulate
from turgor.errors import InvalidInput
from turgor.physics.batch import Batch, World
from turgor.physics.memory import Width
from turgor.physics.model import COMMANDS, CONTROLLER, State
from turgor.physics.step import run_agent
from turgor.simulate import Simulator
from turgor.task import Task, make_task

ABREAST = 32
ONE_LANE = Width(1, stride=ABREAST)
TASKS: dict[str, dict[str, Any]] = {
    "hilly": {},
    "large": {"body": "large"},
    "springs": {"body": "medium", "condition": "springs", "seed": 1},
    "passive": {"condition": "passive"},
    "rough": {"hill_step": 1.0, "hill_height": 0.7},
    "collapsing": {"name": "flat", "body": "medium", "pressure_max": 0.2},
    "escape": {"name": "escape"},
    "inflation": {"name": "inflation", "rest_steps": 200},
    "mlp": {"controller": "mlp"},
    "sinusoid": {"controller": "sinusoid"},
    "distributed": {"controller": "distributed", "observation": "unit"},
    "commanded": {"pressure_length": "commanded"},
}
FIELDS = ("position", "steps", "solved", "fitness", "com")


def task_of(name: str, steps: int = 400) -> Task:
    return make_task(**{"name": "hilly", **TASKS[name]}, steps=steps)


def agents_of(task: Task, agents: int) -> np.ndarray:
    """Controllers, every third of strong will."""
    theta = np.random.default_rng(7).uniform(-1, 1, (agents, task.parameter_count))
    theta[::3] *= 20
    return theta


# --- the code of a thread, compiled for the CPU -------------------------------------------------------------------


@njit(error_model="numpy", boundscheck=False)
def run_agents_here(
    agents, width, settings, tables, grounds, memory, brains, scripts, traces, results, layouts, fresh, position,
    velocity, commands, observations, stands, drive, first_step, steps, last_step,
):  # fmt: skip
    for agent in range(agents):
        run_agent(
            agent, width, settings, tables, grounds, memory, brains, scripts, traces, results, layouts, fresh,
            position, velocity, commands, observations, stands, drive, first_step, steps, last_step,
        )  # fmt: skip


class OneByOne(Batch):
    """A batch as a GPU has it in memory, run by the CPU."""

    def _call(self, scripts, traces, fresh, commands, observations, stands, drive, steps, last) -> None:
        kernel = self.kernel
        run_agents_here(
            self.agents, ONE_LANE, kernel.settings, kernel.tables, self._grounds, self.memory, self.brains, scripts,
            traces, self.results, kernel.layouts, fresh, self.position, self.velocity, commands, observations, stands,
            drive, self.steps, steps, last,
        )  # fmt: skip


def begun(kind: type[Batch], task: Task, theta: np.ndarray) -> Batch:
    """A batch of either kind at its start."""
    world = World(task, ONE_LANE) if kind is OneByOne else World(task)
    batch = kind(world, np.repeat(task.position[None], len(theta), axis=0))
    batch.think(theta)
    batch.begin()
    return batch


@pytest.mark.parametrize("name", TASKS.keys() - {"inflation"})
def test_one_lane_has_the_bits_of_sixteen(name: str) -> None:
    task = task_of(name)
    theta = agents_of(task, 40)
    wide, narrow = (begun(kind, task, theta) for kind in (Batch, OneByOne))
    for steps in (1, 30, 369):
        for batch in (wide, narrow):
            batch.run(CONTROLLER, steps, task.steps - 1)
        for mine, expected in zip(narrow.look(), wide.look(), strict=True):
            assert mine.tobytes() == expected.tobytes()
    for mine, expected in zip(narrow.result(), wide.result(), strict=True):
        assert mine.tobytes() == expected.tobytes()
    assert len({position.tobytes() for position in narrow.result()[0]}) == (1 if name == "passive" else 40)


def test_one_lane_follows_commands_and_begins_anew() -> None:
    task = task_of("hilly")
    wide, narrow = (begun(kind, task, agents_of(task, 40)) for kind in (Batch, OneByOne))
    fresh = np.arange(40) % 3 == 1
    for k, commands in enumerate(np.random.default_rng(2).uniform(-1, 1, (60, 40, 11)).astype(np.float32)):
        for batch in (wide, narrow):
            batch.run(COMMANDS, 1, -1, commands=commands)
            if k == 30:
                batch.restart(fresh, {})
    for mine, expected in zip(narrow.look(), wide.look(), strict=True):
        assert mine.tobytes() == expected.tobytes()


def test_what_lanes_share_is_every_agents_own() -> None:
    task = task_of("large")
    kernel = World(task, ONE_LANE).kernel
    offsets = kernel.layouts[2, : len(State._fields) + 1]
    size = dict(zip(State._fields, np.diff(offsets), strict=True))
    assert size["x"] == size["used"] == ABREAST * task.body.mass_count
    assert size["travel"] == ABREAST


# --- PTX, made and run without a GPU ------------------------------------------------------------------------------


@functools.cache
def compiled(capability: tuple[int, int]) -> str:
    """The engine's PTX for a compute capability."""
    pytest.importorskip("numba_cuda", reason="needs numba-cuda and nvidia-nvvm, as the extra cuda or the group dev has")
    from turgor.physics.gpu import compile_for

    return compile_for(capability)


@pytest.fixture(params=[(8, 0), (9, 0)], ids=lambda cc: "sm_{}{}".format(*cc))
def code(request: pytest.FixtureRequest) -> tuple[tuple[int, int], str]:
    """A compute capability and the engine's PTX for it."""
    return request.param, compiled(request.param)


def test_every_operation_is_rounded_by_itself(code: tuple[tuple[int, int], str]) -> None:
    """Without .rn the assembler may fuse a product with a sum."""
    (major, minor), text = code
    assert f".target sm_{major}{minor}" in text
    floating = re.findall(r"^\s+(?:@!?%p\d+ )?(\w+[\w.]*\.f(?:32|64))\s", text, re.MULTILINE)
    arithmetic = [name for name in floating if name.split(".")[0] not in ("ld", "st", "mov", "selp", "setp", "cvt")]
    kinds = {name.split(".")[0]: set() for name in arithmetic}
    for name in arithmetic:
        kinds[name.split(".")[0]].add(name.split(".", 1)[1])
    exact = {kind: kinds.pop(kind) for kind in ("neg", "abs", "min", "max")}
    assert set().union(*exact.values()) == {"f32"}  # not f32.ftz
    assert kinds.keys() == {"add", "sub", "mul", "div", "rcp", "sqrt"}
    assert set().union(*kinds.values()) == {"rn.f32", "rn.f64"}
    assert not re.search(r"fma|mad|approx|ftz|\.full", text.replace("mad.lo.s", ""))


def test_all_is_in_one_function_and_in_global_memory(code: tuple[tuple[int, int], str]) -> None:
    assert len(re.findall(r"\.entry ", code[1])) == 1
    assert not re.search(r"^\s+(call|ld\.local|st\.local|ld\.shared)", code[1], re.MULTILINE)
    assert ".maxntid 128" in code[1]


def test_the_assembler_takes_it(code: tuple[tuple[int, int], str]) -> None:
    if not _has_linker():
        pytest.skip("needs nvJitLink, as the extra cuda has")
    from turgor.physics.driver import entry_of
    from turgor.physics.gpu import assemble

    machine_code = assemble(code[1], code[0])
    assert machine_code[:4] == b"\x7fELF"
    assert entry_of(machine_code).decode() in code[1]


def _has_linker() -> bool:
    from cuda import pathfinder

    try:
        pathfinder.load_nvidia_dynamic_lib("nvJitLink")
    except pathfinder.DynamicLibNotFoundError:
        return False
    return True


@pytest.fixture(scope="module")
def card() -> tuple[ptx.Machine, Any]:
    """A machine on the CPU that runs the engine's PTX, and the `Gpu` that it passes for."""
    text, made = compiled((9, 0)), ptx.Machine((9, 0))
    from turgor.physics import gpu

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpu, "machine_code_for", lambda capability: text)
        return made, gpu.Gpu(made)


@pytest.fixture
def machine(card: tuple[ptx.Machine, Any], monkeypatch: pytest.MonkeyPatch) -> ptx.Machine:
    """Simulators of device "cuda" run in it."""
    monkeypatch.setattr(turgor.simulate, "open_gpu", lambda: card[1])
    return card[0]


@pytest.mark.parametrize("name", TASKS)
def test_ptx_has_the_bits_of_the_cpu(machine: ptx.Machine, name: str) -> None:
    task = task_of(name, steps=1800 if name in ("hilly", "large") else 400)
    theta, launches = agents_of(task, 40), machine.launches
    mine, expected = (Simulator(task, device=device).rollout(theta) for device in ("cuda", "cpu"))
    assert machine.launches == launches + 1
    for field in FIELDS:
        assert getattr(mine, field).tobytes() == getattr(expected, field).tobytes(), field


@pytest.mark.parametrize("name", ["escape", "distributed", "inflation"])
def test_ptx_records_what_the_cpu_does(machine: ptx.Machine, name: str) -> None:
    task = task_of(name)
    theta = agents_of(task, 1)[0]
    mine, expected = (Simulator(task, device=device).record(theta) for device in ("cuda", "cpu"))
    for field in ("position", "velocity", "pressure", "rest_length", "touch", "observation"):
        assert getattr(mine, field).tobytes() == getattr(expected, field).tobytes(), field


def test_ptx_asks_an_end_of_the_users_own(machine: ptx.Machine) -> None:
    task = task_of("hilly", steps=120)
    theta = agents_of(task, 12)
    far = np.quantile(np.abs(Simulator(task).rollout(theta).position.mean(axis=1)[:, 0]), 0.8)
    task = msgspec.structs.replace(task, end=lambda position: np.abs(position.mean(axis=1)[:, 0]) > far)
    mine, expected = (Simulator(task, device=device).rollout(theta) for device in ("cuda", "cpu"))
    assert 0 < expected.solved.sum() < 12
    for field in FIELDS:
        assert getattr(mine, field).tobytes() == getattr(expected, field).tobytes(), field


def test_a_batch_larger_than_the_memory_is_cut(machine: ptx.Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    task = task_of("hilly", steps=30)
    theta, whole = agents_of(task, 100), Simulator(task, device="cuda")
    expected = whole.rollout(theta)
    monkeypatch.setattr(machine, "free_bytes", lambda: 1_000_000)
    at_once = whole._gpu.agents_at_once(whole._world)
    assert ABREAST <= at_once < 100
    launches = machine.launches
    assert whole.rollout(theta).position.tobytes() == expected.position.tobytes()
    assert machine.launches - launches == -(-100 // at_once)


def test_a_gpu_runs_whole_tasks(machine: ptx.Machine) -> None:
    simulator = Simulator(task_of("hilly"), device="cuda")
    with pytest.raises(InvalidInput, match="reset: expected a simulator of device 'cpu': a GPU runs whole tasks"):
        simulator.reset(4)
    with pytest.raises(InvalidInput, match="call reset first"):
        simulator.step(np.zeros((4, 11)))
    assert repr(simulator).endswith("device='cuda')")


def test_agents_on_a_gpu_may_be_none(machine: ptx.Machine) -> None:
    task = task_of("hilly")
    assert len(Simulator(task, device="cuda").rollout(np.zeros((0, task.parameter_count))).fitness) == 0


# --- the machine itself -------------------------------------------------------------------------------------------

PROGRAM = """
.version 8.0
.visible .entry run(
	.param .f32 run_param_0,
	.param .f32 run_param_1,
	.param .u64 run_param_2
)
.maxntid 128, 1, 1
{
	.reg .f32 	%f<4>;
	.reg .b64 	%rd<3>;
	ld.param.f32 	%f1, [run_param_0];
	ld.param.f32 	%f2, [run_param_1];
	ld.param.u64 	%rd1, [run_param_2];
	OPERATION 	%f3, %f1, %f2;
	st.global.f32 	[%rd1], %f3;
	ret;
}
"""


def compute(operation: str, a: float, b: float) -> np.float32:
    kernel, out = ptx.Kernel(PROGRAM.replace("OPERATION", operation)), np.zeros(1, np.float32)
    kernel.run(np.float32([a, b]).tobytes() + np.int64(out.ctypes.data).tobytes(), 1, 1)
    return out[0]


@pytest.mark.parametrize(
    ("operation", "a", "b", "expected"),
    [
        ("add.rn.f32", 1.0, 2.0**-25, 1.0),
        ("mul.rn.f32", 1 + 2.0**-12, 1 + 2.0**-12, 1 + 2.0**-11),
        ("mul.rn.f32", 1e-30, 1e-15, np.float32(1e-45)),  # denormal, not flushed to 0
        ("min.f32", 0.0, -0.0, -0.0),
        ("max.f32", -0.0, 0.0, 0.0),
        ("min.f32", np.nan, 3.0, 3.0),
        ("max.f32", 3.0, np.nan, 3.0),
        ("div.rn.f32", 1.0, 3.0, np.float32(1) / np.float32(3)),
    ],
)
def test_the_machine_computes_as_ptx_has_it(operation: str, a: float, b: float, expected: float) -> None:
    assert compute(operation, a, b).tobytes() == np.float32(expected).tobytes()


@pytest.mark.parametrize("operation", ["add.f32", "add.ftz.f32", "div.approx.f32", "mul.rn.ftz.f32", "ex2.approx.f32"])
def test_the_machine_refuses_what_is_not_exact(operation: str) -> None:
    with pytest.raises((AssertionError, AttributeError)):
        ptx.Kernel(PROGRAM.replace("OPERATION", operation))


# --- without a GPU, and on one ------------------------------------------------------------------------------------


def test_without_a_gpu_the_error_is_one_line() -> None:
    if has_gpu():
        pytest.skip("there is a GPU")
    missing = "packages" if find_spec("numba_cuda") is None else "NVIDIA GPU"
    with pytest.raises(InvalidInput, match=f"^device: expected .*{missing}") as error:
        Simulator(task_of("hilly"), device="cuda")
    assert "\n" not in str(error.value)


def test_without_a_compiler_the_error_says_what_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled((9, 0))
    from turgor.physics import gpu

    def fail(*_: object) -> None:
        raise RuntimeError("no libnvvm\nanywhere")

    monkeypatch.setattr(gpu, "compile_for", fail)
    monkeypatch.setattr(gpu, "run_blocks", SimpleNamespace(stats=SimpleNamespace(cache_path=None)))
    with pytest.raises(InvalidInput, match=r"pip install 'turgor\[cuda\]'; got no libnvvm anywhere"):
        gpu.machine_code_for((1, 2))


def test_machine_code_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiled((9, 0))
    from turgor.physics import gpu

    made = []
    monkeypatch.setattr(gpu, "compile_for", lambda capability: made.append(capability) or "text")
    monkeypatch.setattr(gpu, "assemble", lambda text, capability: f"{text} {capability}".encode())
    monkeypatch.setattr(gpu, "run_blocks", SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path))))
    monkeypatch.setattr(gpu, "build_of_sources", lambda: "old")
    assert gpu.machine_code_for((1, 2)) == b"text (1, 2)"
    monkeypatch.setattr(gpu, "build_of_sources", lambda: "new")
    for _ in range(2):
        gpu.machine_code_for.cache_clear()
        assert gpu.machine_code_for((1, 2)) == b"text (1, 2)"
    assert gpu.machine_code_for((1, 3)) == b"text (1, 3)"
    assert made == [(1, 2), (1, 2), (1, 3)]
    assert sorted(file.name[:17] for file in tmp_path.iterdir()) == ["engine-sm_12-new-", "engine-sm_13-new-"]
    gpu.machine_code_for.cache_clear()


@pytest.mark.parametrize("device", ["tpu", None, 0, ["cuda"]])
def test_other_devices_are_refused(device: Any) -> None:
    with pytest.raises(InvalidInput, match=re.escape(f"device: expected one of cpu, cuda; got {device!r}")):
        Simulator(task_of("hilly"), device=device)


def test_nothing_of_cuda_is_loaded_before_it_is_asked_for() -> None:
    code = """
import sys, numpy, turgor
task = turgor.make_task("hilly", steps=2)
turgor.Simulator(task).rollout(numpy.zeros((1, task.parameter_count)))
print(*(name for name in sys.modules if name.startswith(("cuda.", "turgor.physics.gpu", "turgor.physics.driver"))))
"""
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert made.stdout.split() == []


def has_gpu() -> bool:
    with suppress(InvalidInput):
        turgor.simulate.open_gpu()
        return True
    return False


@pytest.fixture(scope="module")
def real() -> None:
    """Skips where there is no GPU."""
    try:
        turgor.simulate.open_gpu()
    except InvalidInput as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", TASKS)
def test_a_gpu_has_the_bits_of_the_cpu(real: None, name: str) -> None:
    task = task_of(name, steps=1800 if name in ("hilly", "large") else 400)
    theta = agents_of(task, 300)
    mine, expected = (Simulator(task, device=device).rollout(theta) for device in ("cuda", "cpu"))
    for field in FIELDS:
        assert getattr(mine, field).tobytes() == getattr(expected, field).tobytes(), field


def test_a_gpu_records_what_the_cpu_does(real: None) -> None:
    task = task_of("escape")
    theta = agents_of(task, 1)[0]
    mine, expected = (Simulator(task, device=device).record(theta) for device in ("cuda", "cpu"))
    assert mine.position.tobytes() == expected.position.tobytes()


def test_a_gpu_runs_65536_agents(real: None) -> None:
    """Those that are looked at have the bits of the CPU, and all together its distribution."""
    task = task_of("large", steps=200)
    theta = np.random.default_rng(0).uniform(-1, 1, (65_536, task.parameter_count)).astype(np.float32)
    mine = Simulator(task, device="cuda").rollout(theta)
    looked_at = np.random.default_rng(1).integers(0, 65_536, 2000)
    expected = Simulator(task).rollout(theta[looked_at])
    assert mine.position[looked_at].tobytes() == expected.position.tobytes()
    np.testing.assert_allclose(
        np.quantile(mine.fitness, [0.1, 0.5, 0.9]), np.quantile(expected.fitness, [0.1, 0.5, 0.9]), atol=0.1
    )
