"""The engine on an NVIDIA GPU: the same stages with lanes of one agent, an agent a thread.

Memory is that of the CPU's blocks, 32 agents abreast: row i of an agent is its place among 32 numbers, so that the
threads of a warp read one cache line. What the lanes of a block share on the CPU is every agent's own.

The code is compiled by numba-cuda and NVVM without a device, for any compute capability. No operation is contracted,
approximated or flushed to zero: the bits are meant to be those of the CPU.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import get_type_hints

import numpy as np
from cuda import pathfinder
from cuda.core import Linker, LinkerOptions, ObjectCode
from numba import cuda, typeof, types
from numba.cuda import compiler, dispatcher
from numba.cuda.cudadrv import nvvm
from numba.cuda.cudadrv.error import NvvmSupportError

from turgor.errors import InvalidInput
from turgor.physics.batch import Batch, World, build_of_sources, notice_of_compilation
from turgor.physics.driver import Argument, Device, Memory, flat
from turgor.physics.memory import BYTES, Width, fields
from turgor.physics.model import VIEWS, Settings, State
from turgor.physics.step import run_agent, run_blocks
from turgor.task import Task

ABREAST = 32  # agents side by side in memory: a warp
THREADS = 128  # of a block of the grid
# Blocks on a multiprocessor at once: at most 128 registers a thread, so that 65,536 agents are one wave on an H100
BLOCKS = 4
# every operation rounded as IEEE 754 has it, one by one
OPTIONS = {"opt": 3, "fma": 0, "ftz": 0, "prec-div": 1, "prec-sqrt": 1}
_C_TYPES = {"i": ctypes.c_int32, "f": ctypes.c_float}  # of a setting
SHARE = 0.8  # of the free memory that a batch may take


def on_gpu() -> Width:
    """The width of the kernel: one lane."""
    return Width(1, build_of_sources(), ABREAST)


def run_agents(
    agents, width, settings, tables, grounds, memory, brains, scripts, traces, results, layouts, fresh, position,
    velocity, commands, observations, stands, drive, first_step, steps, last_step,
):  # fmt: skip
    """The kernel: `turgor.physics.step.run_blocks` of one agent."""
    agent = cuda.grid(1)
    if agent < agents:
        run_agent(
            agent, width, settings, tables, grounds, memory, brains, scripts, traces, results, layouts, fresh,
            position, velocity, commands, observations, stands, drive, first_step, steps, last_step,
        )  # fmt: skip


def signature() -> tuple[types.Type, ...]:
    """The types of the kernel's arguments."""
    table, rows, positions = (types.Array(types.float32, dimensions, "C") for dimensions in (1, 2, 3))
    settings = Settings(*(number(0) for number in get_type_hints(Settings).values()))
    layouts = types.Tuple([types.UniTuple(types.int32, len(fields(view))) for view in VIEWS])
    fresh = types.Array(types.boolean, 1, "C")
    return (
        types.int32, typeof(on_gpu()), typeof(settings), table, *[rows] * 6, layouts, fresh, positions, positions,
        *[rows] * 3, *[types.int32] * 4,
    )  # fmt: skip


def compile_for(compute_capability: tuple[int, int]) -> str:
    """The engine as PTX for GPUs of a `compute_capability`, say (9, 0). Needs no GPU."""
    with _as_if_on(compute_capability):
        made = compiler.compile_cuda(run_agents, types.void, signature(), nvvm_options=OPTIONS, cc=compute_capability)
    kernel = made.library.get_function(made.fndesc.llvm_func_name)
    compiler.kernel_fixup(kernel, False)
    nvvm.set_launch_bounds(kernel, (THREADS, BLOCKS))
    unit = nvvm.CompilationUnit({**OPTIONS, "arch": "compute_{}{}".format(*compute_capability)})
    for module in made.library.llvm_strs:
        unit.add_module(nvvm.llvm_replace(module).encode())
    unit.verify()
    unit.lazy_add_module(Path(pathfinder.find_bitcode_lib("device")).read_bytes())  # abs of a single number
    return unit.compile().decode().rstrip("\0")


def assemble(ptx: str, compute_capability: tuple[int, int]) -> bytes:
    """The machine code of `ptx`. Needs no GPU either."""
    options = LinkerOptions(arch="sm_{}{}".format(*compute_capability))
    return Linker(ObjectCode.from_ptx(ptx.encode()), options=options).link("cubin").code


@contextmanager
def _as_if_on(compute_capability: tuple[int, int]) -> Generator[None]:
    """numba-cuda asks the present device for its capability when one function calls another, though it is told; here
    it asks us."""
    present = dispatcher.get_current_device
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=compute_capability)
    try:
        yield
    finally:
        dispatcher.get_current_device = present


@lru_cache
def machine_code_for(compute_capability: tuple[int, int]) -> bytes:
    """The engine for GPUs of a `compute_capability`, compiled or from the cache, beside the CPU's kernel."""
    start = "engine-sm_{}{}".format(*compute_capability)
    name = f"{start}-{build_of_sources()}-{version('numba-cuda')}.cubin"
    cache = run_blocks.stats.cache_path
    file = Path(cache) / name if cache else None
    if file is not None and file.exists():
        return file.read_bytes()
    try:
        with notice_of_compilation("GPU"):
            code = assemble(compile_for(compute_capability), compute_capability)
    except (RuntimeError, OSError, NvvmSupportError, pathfinder.BitcodeLibNotFoundError) as error:
        expected = "device: expected NVVM and nvJitLink, which compile for the GPU; pip install 'turgor[cuda]'"
        raise InvalidInput(expected, str(error)) from None
    if file is not None:
        _keep(code, file, file.parent.glob(f"{start}-*.cubin"))
    return code


def _keep(code: bytes, file: Path, older: Iterable[Path]) -> None:
    """Puts the code into the cache in place of `older` ones; where that is not possible, it is compiled again."""
    with suppress(OSError):
        for old in list(older):
            old.unlink()
        unfinished = file.with_suffix(f".{os.getpid()}.part")
        unfinished.write_bytes(code)
        unfinished.replace(file)


class Gpu:
    """A device that runs batches of agents."""

    def __init__(self, device: Device) -> None:
        self.device = device
        device.load(machine_code_for(device.compute_capability))

    def __repr__(self) -> str:
        return f"Gpu({self.device.name})"

    def world(self, task: Task) -> World:
        """The task as this device sees it."""
        return World(task, on_gpu())

    def batch(self, world: World, starts: np.ndarray) -> DeviceBatch:
        """Agents that are to begin at `starts` [agent, mass, 2]."""
        return DeviceBatch(world, starts, self.device)

    def agents_at_once(self, world: World) -> int:
        """How many agents there is memory for."""
        kernel, masses = world.kernel, world.task.body.mass_count
        each = kernel.block_bytes / ABREAST + 4 * masses * BYTES
        return max(ABREAST, int(SHARE * self.device.free_bytes() / each) // ABREAST * ABREAST)


@lru_cache
def first_gpu() -> Gpu:
    """This machine's first GPU. Raises `InvalidInput` without one."""
    return Gpu(Device())


class DeviceBatch(Batch):
    """A batch whose agents live on a GPU. `run` takes along what it needs and brings back what came of it."""

    def __init__(self, world: World, position: np.ndarray, device: Device) -> None:
        self._device = device
        super().__init__(world, position)
        self._fixed = [device.upload(array) for array in (self.kernel.tables, self._grounds)]
        self._results = device.zeros(self.results.shape)
        self._places = [device.upload(array) for array in (self.position, self.velocity)]
        self._brains = device.zeros((self.blocks, 0))

    def _make_memory(self) -> None:
        self.memory = np.zeros((0, self.kernel.size(State)), np.float32)  # none on this side
        self._memory = self._device.zeros((self.blocks, self.kernel.size(State)))

    def think(self, theta: np.ndarray) -> None:
        super().think(theta)
        self._brains = self._device.upload(self.brains)

    def _call(
        self, scripts: np.ndarray, traces: np.ndarray, fresh: np.ndarray, commands: np.ndarray,
        observations: np.ndarray, stands: np.ndarray, drive: int, steps: int, last: int,
    ) -> None:  # fmt: skip
        device = self._device
        given = [device.upload(array) for array in (scripts, fresh, np.ascontiguousarray(commands))]
        made = {"traces": traces, "observations": observations, "stands": stands}
        rooms = {name: device.zeros(array.shape) for name, array in made.items()}
        device.launch(-(-self.agents // THREADS), THREADS, self._arguments(given, rooms, drive, steps, last))
        for name, array in made.items():
            device.download(rooms[name], array)
        device.download(self._results, self.results)

    def _arguments(
        self, given: list[Memory], rooms: dict[str, Memory], drive: int, steps: int, last: int
    ) -> list[Argument]:
        """What `run_agents` is called with, number by number."""
        scripts, fresh, commands = given
        tables, grounds = self._fixed
        position, velocity = self._places
        layouts = [
            int(offset)
            for offsets, view in zip(self.kernel.layouts, VIEWS, strict=True)
            for offset in offsets[: len(fields(view))]
        ]
        arrays = [tables, grounds, self._memory, self._brains, scripts, rooms["traces"], self._results]
        seen = [fresh, position, velocity, commands, rooms["observations"], rooms["stands"]]
        return [
            (ctypes.c_int32, self.agents),
            (ctypes.c_void_p, 0),  # the width, which is all in its type
            *((_C_TYPES[value.dtype.char], value.item()) for value in self.kernel.settings),
            *(argument for array in arrays for argument in flat(array)),
            *((ctypes.c_int32, offset) for offset in layouts),
            *(argument for array in seen for argument in flat(array)),
            *((ctypes.c_int32, number) for number in (drive, self.steps, steps, last)),
        ]
