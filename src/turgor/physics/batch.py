"""A batch of agents: blocks of lanes, their memory, and the calls of the kernel that move them."""

from __future__ import annotations

import operator
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from turgor.control import pack
from turgor.physics.engine import LASTING, PASSING, load, run_blocks, words_of
from turgor.physics.ground import Columns, Room, cut_into_columns, reach_of, room_for
from turgor.physics.memory import BYTES, LINE, MOST_TRACE_BYTES, aligned, check_memory, fields
from turgor.physics.model import (
    COMMANDS,
    CONTROLLER,
    ON_CPU,
    UNKNOWN,
    WIDTH,
    Block,
    Brain,
    Ground,
    Result,
    State,
    Work,
)
from turgor.physics.tables import ground_tables, make_kernel, write_ground
from turgor.scene import Scene
from turgor.task import Task

_NO_SCRIPT = aligned(1, 0)
_NO_TRACE = np.zeros((1, 0), np.float32)
_NO_ROWS = np.zeros((0, 0), np.float32)
_NOBODY = np.zeros(0, dtype=bool)
_SPARE = 0.15  # room for scenes that are a little larger than those seen


class World:
    """A task as the kernel sees it, with its one scene: what the batches of a simulator share."""

    def __init__(self, task: Task, block: Block = ON_CPU) -> None:
        self.task = task
        columns = self.cut(task.scene)
        self.kernel = make_kernel(task, room_for([columns]), block=block)
        self.grounds = aligned(1, self.kernel.size(Ground))
        write_ground(ground_tables(self.kernel, self.grounds[0]), columns)

    def cut(self, scene: Scene) -> Columns:
        """The columns of a `scene` for the task's body."""
        return cut_into_columns(scene, reach_of(self.task.body, self.task.physics.skin))


class Batch:
    """Blocks of agents and their memory: what one call of the kernel works on.

    All agents share the world's scene, or each has one of `scenes` [agent] of its own.
    """

    def __init__(self, world: World, position: np.ndarray, scenes: Sequence[Columns] | None = None) -> None:
        """`position` [m], shape [agent, mass, 2]: where the agents start."""
        self.agents = len(position)
        self.position = np.array(position, dtype=np.float32, order="C")  # writable: the kernel is compiled for that
        self.velocity = np.zeros_like(self.position)
        self.steps = 0  # made so far
        self._task = world.task
        self._scenes = None if scenes is None else list(scenes)  # each agent's own
        if self._scenes is None:
            self.kernel, self._grounds = world.kernel, world.grounds
        else:
            self._make_room(room_for(self._scenes, _SPARE))
            self._write_scenes(range(self.agents))
        self._make_memory()
        self.brains = aligned(self.blocks, self.kernel.size(Brain))
        self.results = aligned(self.blocks, self.kernel.size(Result))
        self._told: tuple[Sequence[Any], list[int]] = [None], []  # the last arrays, and where they are

    def _make_memory(self) -> None:
        self.memory = aligned(self.blocks, self.kernel.size(State))

    @property
    def blocks(self) -> int:
        return -(-self.agents // self.kernel.block.abreast)

    @property
    def own_scenes(self) -> bool:
        return self._scenes is not None

    def think(self, theta: np.ndarray) -> None:
        """Gives the agents their controllers, `theta` [agent, parameter]."""
        task, abreast = self._task, self.kernel.block.abreast
        weights, biases = pack(theta, task.body, task.condition, task.controller, task.physics.dt)
        lanes = np.minimum(np.arange(self.blocks * abreast), self.agents - 1)  # the last agent in lanes left over
        for brain, agents in zip(self.brains, lanes.reshape(-1, abreast), strict=True):
            self.kernel.field(brain, Brain, "weight")[:] = weights[agents].T
            self.kernel.field(brain, Brain, "bias")[:] = biases[agents].T

    def trace(self, steps: int) -> np.ndarray:
        """Room for a recording of the first block, float32 [step + 1, row, lane]. Raises `InvalidInput` for more steps
        than can be recorded."""
        body, abreast = self.kernel.lengths, self.kernel.block.abreast
        row = 5 * body["mass"] + body["spring"] + body["chamber"] + body["input"]
        check_memory("steps: expected fewer to be recorded", BYTES * abreast * row * (steps + 1), MOST_TRACE_BYTES)
        return aligned(steps + 1, row * abreast).reshape(steps + 1, row, abreast)

    def run(
        self,
        drive: int,
        steps: int,
        last: int,
        *,
        fresh: np.ndarray = _NOBODY,
        script: np.ndarray | None = None,
        trace: np.ndarray | None = None,
        commands: np.ndarray = _NO_ROWS,
        observations: np.ndarray = _NO_ROWS,
        stands: np.ndarray = _NO_ROWS,
    ) -> None:
        """Puts the agents that are `fresh` [agent] at the start, then runs `steps` steps; `last` is the task's last.

        `script` [step, row] is for all agents, `commands` [agent, output] for each. Fills `trace` (a row for
        the start of fresh agents, a row a step), and in the end
        `observations` [agent, input] and `stands` [agent, stand].
        """
        scripts = _NO_SCRIPT
        if script is not None:
            scripts = aligned(1, script.size * self.kernel.block.abreast)
            scripts[0] = np.repeat(script.ravel(), self.kernel.block.abreast)
        traces = _NO_TRACE
        if trace is not None:
            assert trace.ctypes.data % LINE == 0  # the kernel moves whole cache lines
            traces = trace.reshape(1, -1)
        self._call((scripts, traces, fresh, commands, observations, stands), (drive, self.steps, steps, last))
        self.steps += steps

    def _call(self, passing: Sequence[np.ndarray], counts: Sequence[int]) -> None:
        """Calls the kernel with arrays that are PASSING, and COUNTS."""
        run_blocks([*self._lasting(), *words_of(passing, PASSING), *counts])

    def _lasting(self) -> list[int]:
        """The words of the arrays that stay from call to call."""
        kernel = self.kernel
        arrays = (
            kernel.constants, kernel.layouts, kernel.tables, self._grounds, self.memory, self.brains, self.results,
            self.position, self.velocity,
        )  # fmt: skip
        if not all(map(operator.is_, arrays, self._told[0])):
            self._told = arrays, words_of(arrays, LASTING)
        return self._told[1]

    def begin(self, drive: int = CONTROLLER, **outputs: Any) -> None:
        """Puts all agents at the start."""
        self.run(drive, 0, -1, fresh=np.ones(self.agents, dtype=bool), **outputs)

    def restart(self, fresh: np.ndarray, scenes: dict[int, Columns], **outputs: Any) -> None:
        """Puts the agents that are `fresh` [agent] back at the start, at `self.position`, on `scenes` [agent] of their
        own; the others stay as they are."""
        if scenes:
            assert self._scenes is not None
            for agent, columns in scenes.items():
                self._scenes[agent] = columns
            needed = room_for(list(scenes.values()))
            if self._room.holds(needed):
                self._write_scenes(scenes)
            else:
                self._grow(room_for(self._scenes, _SPARE))
        self.run(COMMANDS, 0, -1, fresh=fresh, **outputs)

    def push(self, change: np.ndarray) -> None:
        """Adds `change` [m/s], float32 [agent, mass, 2], to the velocities; what is 0 leaves the bits as they are."""
        for agent, mass, axis in np.argwhere(change).tolist():
            velocity = self.kernel.field(self.memory[agent // WIDTH], State, ("vx", "vy")[axis])
            velocity[mass, agent % WIDTH] += change[agent, mass, axis]

    def look(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations [agent, input] and stands [agent, stand] (see `Kernel.stand`), in arrays of their own."""
        observations, stands = self.kernel.rows_for(self.agents)
        self.run(COMMANDS, 0, -1, observations=observations, stands=stands)
        return observations, stands

    def result(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Final positions [agent, mass, 2], steps [agent], solved [agent]."""
        final = np.stack([self._rows(name) for name in ("x", "y")], axis=2)
        steps = self._rows("steps")[:, 0].astype(np.int64)
        return final, steps, self._rows("solved")[:, 0] > 0

    def _rows(self, name: str) -> np.ndarray:
        """A field of the results as [agent, length]."""
        blocks = [self.kernel.field(buffer, Result, name).T for buffer in self.results]
        return np.concatenate(blocks)[: self.agents]

    def _make_room(self, room: Room) -> None:
        self._room = room
        self.kernel = make_kernel(self._task, room, own_ground=True)
        self._grounds = aligned(self.blocks, self.kernel.size(Ground))

    def _write_scenes(self, agents: Iterable[int]) -> None:
        assert self._scenes is not None
        tables = [ground_tables(self.kernel, ground) for ground in self._grounds]
        for agent in agents:
            write_ground(tables[agent // WIDTH], self._scenes[agent], agent % WIDTH)
        for lane in range(self.agents % WIDTH, WIDTH if self.agents % WIDTH else 0):  # left over: the last agent again
            write_ground(tables[-1], self._scenes[-1], lane)

    def _grow(self, room: Room) -> None:
        """Makes room for larger scenes; what moves is taken along."""
        before, memory = self.kernel, self.memory
        slots, columns = before.settings.slots, before.settings.columns
        self._make_room(room)
        self._write_scenes(range(self.agents))
        self.memory = aligned(self.blocks, self.kernel.size(State))
        lanes = np.arange(WIDTH, dtype=np.int32)
        shift = lanes * (self.kernel.lengths["segment"] - before.lengths["segment"]) // WIDTH
        for old, new in zip(memory, self.memory, strict=True):
            for name, (_, length) in fields(State).items():
                was, now = before.field(old, State, name), self.kernel.field(new, State, name)
                if length == "slot":
                    was = was.reshape(-1, slots, *was.shape[1:])
                    now = now.reshape(len(was), -1, *now.shape[1:])
                    if name == "segment":
                        now[:] = UNKNOWN
                        was = np.where(was < 0, was, was + shift)
                    now[:, :slots] = was
                else:
                    now[:] = was
            self.kernel.field(new, State, "cell")[:] += lanes * (room.columns - columns)
            self.kernel.field(new, Work, "mean")[:] = before.field(old, Work, "mean")

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        for name in ("memory", "brains", "results", "_grounds"):  # copies lie anywhere
            buffer = state[name]
            vars(self)[name] = aligned(*buffer.shape)
            vars(self)[name][:] = buffer
        self._told = [None], []


def load_kernel() -> None:
    """Has the kernel ready, from its file or compiled; says so if that takes a while."""
    words = "turgor: compiling the engine for this processor, once ..."
    load(before_making=lambda: print(words, file=sys.stderr, flush=True))
