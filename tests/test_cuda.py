"""The engine with an agent a thread: its code on the CPU, its PTX without a GPU, and on a GPU where there is one."""

from __future__ import annotations

import functools
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import ptx
import pytest

from turgor.errors import InvalidInput
from turgor.physics import driver, engine, gpu
from turgor.physics.batch import Batch, World
from turgor.physics.build import machine_code
from turgor.physics.build import ptx as ptx_of
from turgor.physics.engine import LASTING, PASSING, function_of, in_words, words_of
from turgor.physics.model import COMMANDS, CONTROLLER, ON_GPU, State
from turgor.physics.step import NEAR, THREAD_ARGUMENTS, run_agent
from turgor.simulate import Simulator
from turgor.task import Task, make_task

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


@functools.cache
def code_of_a_thread() -> Any:
    """The function, and what it lives in."""
    return function_of(machine_code(run_agent, THREAD_ARGUMENTS))


class OneByOne(Batch):
    """A batch as a GPU has it in memory, run by the CPU."""

    def _call(self, passing: Sequence[np.ndarray], counts: Sequence[int]) -> None:
        kernel, run = self.kernel, code_of_a_thread()[0]
        near = in_words(kernel.constants) + in_words(kernel.layouts)
        lasting = kernel.tables, self._grounds, self.memory, self.brains, self.results, self.position, self.velocity
        kinds = {name: kind for name, kind in LASTING.items() if name not in NEAR}
        words = words_of(lasting, kinds) + words_of(passing, PASSING) + [*counts]
        for agent in range(-(-self.agents // 32) * 32):
            run(near + struct.pack(f"{len(words) + 1}q", *words, agent))


def begun(kind: type[Batch], task: Task, theta: np.ndarray) -> Batch:
    """A batch of either kind at its start."""
    world = World(task, ON_GPU) if kind is OneByOne else World(task)
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
    kernel = World(task, ON_GPU).kernel
    offsets = kernel.layouts[2, : len(State._fields) + 1]
    size = dict(zip(State._fields, np.diff(offsets), strict=True))
    assert size["x"] == size["used"] == ON_GPU.abreast * task.body.mass_count
    assert size["travel"] == ON_GPU.abreast


# --- PTX, made and run without a GPU ------------------------------------------------------------------------------


@functools.cache
def text_for(architecture: str) -> str:
    """The engine's PTX for an architecture."""
    return ptx_of(run_agent, THREAD_ARGUMENTS, architecture)


ARCHITECTURES = ("sm_70", "sm_75", "sm_80", "sm_90")


def test_newer_gpus_would_be_given_the_same_instructions() -> None:
    def instructions(architecture: str) -> str:
        text = text_for(architecture)
        assert f".target {architecture}\n" in text
        return text.partition(".address_size")[2]

    assert len({instructions(architecture) for architecture in ARCHITECTURES}) == 1


def test_every_operation_is_rounded_by_itself() -> None:
    """Without .rn the assembler may fuse a product with a sum."""
    text = text_for("sm_70")
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


def test_all_is_in_one_function_and_in_the_gpus_memory() -> None:
    text = text_for("sm_70")
    assert len(re.findall(r"\.entry ", text)) == 1
    assert not re.search(r"^\s+call", text, re.MULTILINE)
    places = set(re.findall(r"^\s+(?:ld|st)\.(\w+)\.", text, re.MULTILINE))
    assert places == {"param", "global"}  # neither a thread's own memory nor addresses of any kind
    assert ".maxntid 128" in text
    assert ".minnctapersm 4" in text
    assert ptx.Kernel(text).parameter_bytes < 4096  # what CUDA allows


@pytest.mark.parametrize("architecture", ARCHITECTURES[1:])
def test_nvidias_assembler_takes_it(architecture: str, tmp_path: Path) -> None:
    assembler = shutil.which("ptxas")
    if assembler is None:
        pytest.skip("needs ptxas, of the CUDA toolkit")
    (tmp_path / "engine.ptx").write_text(text_for("sm_70"))
    command = [assembler, "-v", f"-arch={architecture}", "engine.ptx", "-o", "engine.cubin"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "engine.cubin").read_bytes()[:4] == b"\x7fELF"
    assert int(re.search(r"Used (\d+) registers", done.stderr)[1]) <= 128


# --- the PTX, run by a machine on the CPU, and by a GPU where there is one ----------------------------------------


@functools.cache
def machine() -> tuple[ptx.Driver, gpu.Gpu]:
    """The driver of a machine on the CPU that runs the engine's PTX, and the `Gpu` that stands on it."""
    made = ptx.Driver()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "library", lambda: made)
        return made, gpu.Gpu(driver.Device())


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> ptx.Driver:
    """Simulators of device "cuda" run in the machine, with this driver."""
    made, found = machine()
    monkeypatch.setattr(driver, "library", lambda: made)
    monkeypatch.setattr(gpu, "first_gpu", lambda: found)
    return made


@pytest.fixture(params=["here", "there"])
def device(request: pytest.FixtureRequest) -> driver.Device:
    """Where simulators of device "cuda" run: in the machine, or on this computer's GPU."""
    if request.param == "here":
        request.getfixturevalue("here")
    try:
        return gpu.first_gpu().device
    except InvalidInput as error:
        pytest.skip(str(error))


def compare(mine: Any, expected: Any, fields: Sequence[str] = FIELDS) -> None:
    """They are the same, bit by bit."""
    for field in fields:
        assert getattr(mine, field).tobytes() == getattr(expected, field).tobytes(), field


@pytest.mark.parametrize("name", TASKS)
def test_rollouts_have_the_bits_of_the_cpu(device: driver.Device, name: str) -> None:
    task = task_of(name, steps=1800 if name in ("hilly", "large") else 400)
    theta, busy = agents_of(task, 40), device.busy
    compare(Simulator(task, device="cuda").rollout(theta), Simulator(task).rollout(theta))
    assert device.busy > busy


@pytest.mark.parametrize("agents", [1, 31, 33, 127, 129, 300])
def test_any_number_of_agents(device: driver.Device, agents: int) -> None:
    """Warps, blocks of memory and of the grid that are not full."""
    task = task_of("hilly", steps=20)
    theta = agents_of(task, agents)
    compare(Simulator(task, device="cuda").rollout(theta), Simulator(task).rollout(theta))


def test_agents_may_be_none(device: driver.Device) -> None:
    task = task_of("hilly")
    assert len(Simulator(task, device="cuda").rollout(np.zeros((0, task.parameter_count))).fitness) == 0


@pytest.mark.parametrize("name", ["escape", "distributed", "inflation"])
def test_recordings_have_the_bits_of_the_cpu(device: driver.Device, name: str) -> None:
    task = task_of(name)
    mine, expected = (Simulator(task, device=where).record(agents_of(task, 1)[0]) for where in ("cuda", "cpu"))
    compare(mine, expected, ("position", "velocity", "pressure", "rest_length", "touch", "observation"))


def test_an_end_of_the_users_own_is_asked(device: driver.Device) -> None:
    task = task_of("hilly", steps=120)
    theta = agents_of(task, 12)
    far = np.quantile(np.abs(Simulator(task).rollout(theta).position.mean(axis=1)[:, 0]), 0.8)
    task = msgspec.structs.replace(task, end=lambda position: np.abs(position.mean(axis=1)[:, 0]) > far)
    expected = Simulator(task).rollout(theta)
    assert 0 < expected.solved.sum() < 12
    compare(Simulator(task, device="cuda").rollout(theta), expected)


def test_agents_start_where_they_are_put_in_other_tasks_too(device: driver.Device) -> None:
    tasks = [task_of("hilly", steps=60), task_of("rough", steps=60)]
    theta = agents_of(tasks[0], 40)
    simulators = [Simulator(tasks[0], device=where) for where in ("cuda", "cpu")]
    for mine, expected in zip(*(simulator.rollout_in(tasks, theta) for simulator in simulators), strict=True):
        compare(mine, expected)
    starts = tasks[0].position + np.linspace(0, 1, 40)[:, None, None]
    compare(*(simulator.rollout(theta, starts) for simulator in simulators))


def test_a_batch_larger_than_the_memory_is_cut(device: driver.Device, monkeypatch: pytest.MonkeyPatch) -> None:
    task = task_of("hilly", steps=30)
    theta, whole, launches = agents_of(task, 100), Simulator(task, device="cuda"), []
    expected = whole.rollout(theta)
    launch = device.launch
    monkeypatch.setattr(device, "free_bytes", lambda: 1_000_000)
    monkeypatch.setattr(device, "launch", lambda *given: launches.append(given) or launch(*given))
    at_once = whole._gpu.agents_at_once(whole._world)
    assert ON_GPU.abreast <= at_once < 100
    compare(whole.rollout(theta), expected)
    assert len(launches) == -(-100 // at_once)


def test_other_threads_may_call(device: driver.Device) -> None:
    """CUDA's calls are for the device of their thread."""
    task = task_of("hilly", steps=20)
    theta, simulator = agents_of(task, 40), Simulator(task, device="cuda")
    with ThreadPoolExecutor(1) as pool:
        compare(pool.submit(simulator.rollout, theta).result(), Simulator(task).rollout(theta))


def test_what_is_too_much_for_the_memory_is_told_in_one_line(device: driver.Device) -> None:
    with pytest.raises(InvalidInput, match=r"^device: expected the GPU to do its work; got CUDA_ERROR_OUT_OF_MEMORY$"):
        device.zeros((2**50,))
    assert device.zeros((2,)).address > 0  # and it goes on


def test_code_that_is_refused_is_told_in_one_line(device: driver.Device) -> None:
    other = driver.Device()
    with pytest.raises(
        InvalidInput, match=r"^device: expected a GPU that can run the engine; got CUDA_ERROR_"
    ) as error:
        other.load(b"nothing", "nothing")
    assert "\n" not in str(error.value)


def test_65536_agents_on_a_gpu() -> None:
    """Those that are looked at have the bits of the CPU, and all together its distribution."""
    if not has_gpu():
        pytest.skip("needs a GPU")
    task = task_of("large", steps=200)
    theta = np.random.default_rng(0).uniform(-1, 1, (65_536, task.parameter_count)).astype(np.float32)
    mine = Simulator(task, device="cuda").rollout(theta)
    looked_at = np.random.default_rng(1).integers(0, 65_536, 2000)
    expected = Simulator(task).rollout(theta[looked_at])
    assert mine.position[looked_at].tobytes() == expected.position.tobytes()
    np.testing.assert_allclose(
        np.quantile(mine.fitness, [0.1, 0.5, 0.9]), np.quantile(expected.fitness, [0.1, 0.5, 0.9]), atol=0.1
    )


def test_a_gpu_runs_whole_tasks(here: ptx.Driver) -> None:
    simulator = Simulator(task_of("hilly"), device="cuda")
    with pytest.raises(InvalidInput, match="reset: expected a simulator of device 'cpu': a GPU runs whole tasks"):
        simulator.reset(4)
    with pytest.raises(InvalidInput, match="call reset first"):
        simulator.step(np.zeros((4, 11)))
    assert repr(simulator).endswith("device='cuda')")


def test_what_the_assembler_says_is_told(here: ptx.Driver) -> None:
    with pytest.raises(InvalidInput, match=r"; got CUDA_ERROR_INVALID_PTX line 1: no entry$"):
        driver.Device().load(b"nothing", "nothing")


def test_memory_is_given_back(here: ptx.Driver) -> None:
    simulator = Simulator(task_of("hilly", steps=2), device="cuda")
    simulator.rollout(agents_of(simulator.task, 40))
    assert here.used == 0


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


# --- without a GPU ------------------------------------------------------------------------------------------------


def test_without_a_gpu_the_error_is_one_line() -> None:
    if has_gpu():
        pytest.skip("there is a GPU")
    with pytest.raises(
        InvalidInput, match=r"^device: expected an NVIDIA GPU and its driver for 'cuda'; got ."
    ) as error:
        Simulator(task_of("hilly"), device="cuda")
    assert "\n" not in str(error.value)


def test_ptx_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = []
    monkeypatch.setattr(engine, "_folders", lambda: [tmp_path])
    monkeypatch.setattr(engine, "_made", lambda kind: made.append(kind) or b"text")
    for _ in range(2):
        assert engine.code_of(engine.PTX, lambda: made.append("notice")) == b"text"
    assert made == ["notice", "ptx"]
    assert [file.name.partition("-")[0] for file in tmp_path.iterdir()] == ["ptx"]


@pytest.mark.parametrize("device", ["tpu", None, 0, ["cuda"]])
def test_other_devices_are_refused(device: Any) -> None:
    with pytest.raises(InvalidInput, match=re.escape(f"device: expected one of cpu, cuda; got {device!r}")):
        Simulator(task_of("hilly"), device=device)


FIRST_ROLLOUT = """
import sys, numpy, turgor
task = turgor.make_task("hilly", steps=2)
turgor.Simulator(task).rollout(numpy.zeros((1, task.parameter_count)))
print(*(name for name in sys.modules if name.startswith(("turgor.physics.gpu", "turgor.physics.driver"))))
"""


def test_nothing_of_cuda_is_loaded_before_it_is_asked_for() -> None:
    made = subprocess.run([sys.executable, "-c", FIRST_ROLLOUT], capture_output=True, text=True, check=True)
    assert made.stdout.split() == []


def has_gpu() -> bool:
    with suppress(InvalidInput):
        gpu.first_gpu()
        return True
    return False
