"""The engine on an NVIDIA GPU: the same stages with lanes of one agent, an agent a thread.

Memory is that of the CPU's blocks, 32 agents abreast: row i of an agent is its place among 32 numbers, so that the
threads of a warp read one cache line. What the lanes of a block share on the CPU is every agent's own.

LLVM makes PTX of it (`build.ptx`), the driver machine code of that. No operation is contracted, approximated or flushed
to zero: the bits are meant to be those of the CPU.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from functools import cache

import numpy as np

from turgor.physics.batch import Batch, World
from turgor.physics.driver import Device, Memory
from turgor.physics.engine import ENTRY, PTX, THREADS, code_of, in_words
from turgor.physics.memory import BYTES
from turgor.physics.model import ON_GPU, State
from turgor.task import Task

SHARE = 0.8  # of the free memory that a batch may take


@cache
def first_gpu() -> Gpu:
    """This machine's first GPU. Raises `InvalidInput` without one."""
    return Gpu(Device())


class Gpu:
    """A device that runs batches of agents."""

    def __init__(self, device: Device) -> None:
        self.device = device
        words = "turgor: compiling the engine for GPUs, once ..."
        device.load(code_of(PTX, lambda: print(words, file=sys.stderr, flush=True)), ENTRY)

    def __repr__(self) -> str:
        return f"Gpu({self.device.name})"

    def world(self, task: Task) -> World:
        """The task as this device sees it."""
        return World(task, ON_GPU)

    def batch(self, world: World, starts: np.ndarray) -> Batch:
        """Agents that are to begin at `starts` [agent, mass, 2]."""
        return DeviceBatch(world, starts, self.device)

    def agents_at_once(self, world: World) -> int:
        """How many agents there is memory for."""
        kernel, masses = world.kernel, world.task.body.mass_count
        each = kernel.block_bytes / ON_GPU.abreast + 4 * masses * BYTES
        return max(1, int(SHARE * self.device.free_bytes() / each) // ON_GPU.abreast) * ON_GPU.abreast


class DeviceBatch(Batch):
    """A batch whose agents live on a GPU. `run` takes along what it needs and brings back what came of it."""

    def __init__(self, world: World, position: np.ndarray, device: Device) -> None:
        self._device = device
        super().__init__(world, position)
        self._tables, self._ground = device.upload(self.kernel.tables), device.upload(self._grounds)
        self._results = device.zeros(self.results.shape)
        self._places = [device.upload(array) for array in (self.position, self.velocity)]
        self._brains = device.zeros((self.blocks, 0))

    def _make_memory(self) -> None:
        self._memory = self._device.zeros((self.blocks, self.kernel.size(State)))  # none on this side

    def think(self, theta: np.ndarray) -> None:
        super().think(theta)
        self._brains = self._device.upload(self.brains)

    def _call(self, passing: Sequence[np.ndarray], counts: Sequence[int]) -> None:
        device = self._device
        scripts, traces, fresh, commands, observations, stands = passing
        made = [device.zeros(array.shape) for array in (traces, observations, stands)]
        given = [device.upload(np.ascontiguousarray(array)) for array in (scripts, fresh, commands)]
        passed = [given[0], made[0], *given[1:], *made[1:]]
        device.launch(-(-self.agents // THREADS), THREADS, self._argument(passed, counts))
        for memory, array in zip((*made, self._results), (traces, observations, stands, self.results), strict=True):
            device.download(memory, array)

    def _argument(self, passed: Sequence[Memory], counts: Sequence[int]) -> bytes:
        """What the kernel is launched with."""
        lasting = [self._tables, self._ground, self._memory, self._brains, self._results, *self._places]
        words = [word for memory in (*lasting, *passed) for word in memory.words] + [*counts]
        near = in_words(self.kernel.constants) + in_words(self.kernel.layouts)
        return near + struct.pack(f"{len(words)}q", *words)
