"""The simulator: runs a batch of agents of one task, in blocks of lanes, over threads."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.arrays import as_numbers
from turgor.body import Body
from turgor.control import check_theta, observation_count, output_count
from turgor.errors import InvalidInput, describe, one_of
from turgor.physics.batch import Batch, World, load_kernel
from turgor.physics.memory import BYTES, MOST_BYTES, MOST_TRACE_BYTES, check_memory
from turgor.physics.model import COMMANDS, CONTROLLER, REPLAY, WIDTH
from turgor.recording import Recording
from turgor.rollout import Rollout, cut_evenly, judge, starts_of
from turgor.scene import Scene
from turgor.task import Physics, Task, given_rows, start_position

if TYPE_CHECKING:
    from turgor.physics.gpu import Gpu

DEVICES = ("cpu", "cuda")
BLOCKS_AT_ONCE = 8  # of a thread: memory does not grow with the batch
LEAST_WORK = 10_000  # [mass x step] of a thread's part, 70 us and more: to wake it takes 50
LEAST_SHARE = 100_000  # [mass x step] of it where lanes stay empty: blocks of few agents are only somewhat faster
MOST_THREADS = 1024
LARGEST_PUSH = 1e9  # [m/s]


class Step(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Where a batch of agents stands between two steps; every field is per agent."""

    observation: Any  # [1], shape [agent, input]: the window's mean, what a controller sees now
    stand: Any  # [agent, stand]: all the rest in one array, of which the other fields are views
    position: Any  # [m], shape [agent, mass, 2]
    velocity: Any  # [m/s], shape [agent, mass, 2]
    touch: Any  # 0 or 1, shape [agent, mass]: whether it touched something in the last step
    pressure: Any  # [Pa], shape [agent, chamber]
    area: Any  # [m^2], shape [agent, chamber], signed

    def __repr__(self) -> str:
        agents, masses, _ = self.position.shape
        return f"Step({agents} agents of {masses} masses, {int(self.solved.sum())} solved)"

    @property
    def solved(self) -> np.ndarray:
        """Whether the end has come, bool [agent]."""
        return self.stand[:, -1] > 0


class Simulator:
    """Runs agents of one `Task`. What an agent does depends neither on the batch it is in nor on `threads`."""

    def __init__(self, task: Task, *, threads: int | None = None, device: str = "cpu") -> None:
        """`threads`: None for all cores. `device`: "cpu", or "cuda" for the first NVIDIA GPU, which runs whole tasks
        (`rollout`, `record`) of large batches. Raises `InvalidInput` for fewer than 1 thread, or without such a GPU."""
        if threads is not None and (not isinstance(threads, int) or not 1 <= threads <= MOST_THREADS):
            raise InvalidInput(f"threads: expected a whole number, 1 to {MOST_THREADS}", describe(threads))
        self.task = task
        self.threads = threads or available_cores()
        if not isinstance(device, str) or device not in DEVICES:
            raise one_of("device", DEVICES, device)
        self.device = device
        self._gpu = open_gpu() if device == "cuda" else None
        self._world = World(task) if self._gpu is None else self._gpu.world(task)
        self._stepping: list[tuple[Batch, slice]] = []  # the agents that `step` drives, in parts
        stand = self._world.kernel.stand
        self._columns = [(name, *place) for name, place in stand.items() if name in Step.__struct_fields__]

    def __repr__(self) -> str:
        where = f"threads={self.threads}" if self._gpu is None else f"device={self.device!r}"
        return f"Simulator({self.task}, {where})"

    def rollout(self, theta: ArrayLike, position: ArrayLike | None = None) -> Rollout:
        """A `Rollout` of every row of `theta` [agent, parameter] from the task's start, or from `position` [m],
        shape [agent, mass, 2]. Theta of float32 takes half the memory and gives the same bits as the same numbers in
        float64. Raises `InvalidInput` for another shape or numbers that are not finite."""
        work = _Work(self, theta, position)
        self._spread(work.run, work.parts)
        return work.rollout()

    def rollout_in(self, tasks: Sequence[Task], theta: ArrayLike) -> list[Rollout]:
        """A `Rollout` of `theta` [agent, parameter] in each of `tasks`, with the bits that a simulator of each would
        have, and the threads spread over all of them at once. Raises `InvalidInput`."""
        works = [_Work(Simulator(task, threads=self.threads, device=self.device), theta) for task in tasks]
        self._spread(lambda one: one[0].run(one[1]), [(work, part) for work in works for part in work.parts])
        return [work.rollout() for work in works]

    def rollouts(self, chunks: Iterable[ArrayLike]) -> Iterator[Rollout]:
        """A `Rollout` of each of `chunks`, theta [agent, parameter] of any length, with the bits that one `rollout` of
        all would have. The next chunk is asked for when its rollout is, and none is kept: a generator of chunks
        streams any number of agents in the memory of one chunk. Raises `InvalidInput`."""
        if isinstance(chunks, np.ndarray) and chunks.ndim == 2:
            raise InvalidInput("chunks: expected several theta, as [theta] is", f"one, shape {list(chunks.shape)}")
        if not isinstance(chunks, Iterable):
            raise InvalidInput("chunks: expected theta after theta", describe(chunks))
        return map(self.rollout, chunks)

    def record(self, theta: ArrayLike, position: ArrayLike | None = None) -> Recording:
        """The `Recording` of one controller, `theta` [parameter], from the task's start or from `position`
        [mass, 2]: the same steps that `rollout` takes."""
        theta = np.reshape(as_numbers("theta", theta), (1, -1))
        theta = check_theta(theta, self.task.body, self.task.condition, self.task.controller)
        starts = starts_of(self.task, 1, None if position is None else as_numbers("position", position)[None])
        batch = self._batch(starts)
        batch.think(theta)
        trace = batch.trace(self.task.steps)
        final, steps, solved = self._run_whole(batch, trace)
        out = judge(self.task, starts, final, steps, solved)
        return _recording(self.task, trace[: steps[0] + 1], float(out.fitness[0]), bool(solved[0]))

    def reset(self, agents: int, position: ArrayLike | None = None, *, scenes: Sequence[Scene] | None = None) -> Step:
        """The first `Step` of `agents` agents, put at the start, to be driven by `step`. `position` [m], shape
        [agent, mass, 2], in place of the task's; `scenes` [agent]: one for each in place of the task's."""
        if not isinstance(agents, int) or agents < 1:
            raise InvalidInput("agents: expected a whole number, at least 1", describe(agents))
        if self._gpu is not None:
            raise InvalidInput("reset: expected a simulator of device 'cpu': a GPU runs whole tasks", repr(self.device))
        starts = starts_of(self.task, agents, position)
        if scenes is not None and len(scenes) != agents:
            raise InvalidInput(f"scenes: expected one for each of {agents} agents", str(len(scenes)))
        load_kernel()
        own = None if scenes is None else [self._world.cut(scene) for scene in scenes]
        # a part for each thread, and no more: this memory stays
        parts = cut_evenly(agents, min(self.threads, max(agents * self.task.body.mass_count // LEAST_WORK, 1)))
        self._stepping = [(Batch(self._world, starts[mine], own and own[mine]), mine) for mine in parts]
        out = self._room_for_step("reset", None)
        for batch, mine in self._stepping:
            batch.begin(COMMANDS, observations=out.observation[mine], stands=out.stand[mine])
        return out

    def step(self, commands: ArrayLike, out: Step | None = None) -> Step:
        """The `Step` after one step of all agents, with `commands` [agent, output] in place of a controller's outputs:
        springs in [-1, 1], then each chamber's pressure change in units of `Task.pressure_step`. `out`: an earlier
        `Step` of theirs, to be written over in place of a new one."""
        out = self._room_for_step("step", out)
        shape = (len(out.stand), output_count(self.task.body, self.task.condition))
        commands = np.ascontiguousarray(as_numbers("commands", commands, np.float32))
        if commands.shape != shape:
            raise InvalidInput(f"commands: expected shape {list(shape)}", f"shape {list(commands.shape)}")
        if not np.isfinite(commands).all():
            raise InvalidInput(f"commands: expected finite numbers of shape {list(shape)}", "NaN or infinity")

        def run(part: tuple[Batch, slice]) -> None:
            batch, mine = part
            batch.run(
                COMMANDS, 1, -1, commands=commands[mine], observations=out.observation[mine], stands=out.stand[mine]
            )

        self._spread(run, self._stepping)
        return out

    def push(self, change: ArrayLike) -> None:
        """Adds `change` [m/s], shape [agent, mass, 2], to the velocities of the agents that `step` drives: the next
        step starts from them. Masses whose change is 0 keep their bits. Raises `InvalidInput` for another shape, NaN
        or infinity."""
        if not self._stepping:
            raise InvalidInput("push: expected agents at the start; call reset first")
        shape = (self._stepping[-1][1].stop, self.task.body.mass_count, 2)
        expected = f"change: expected finite numbers of shape {list(shape)}"
        given = as_numbers("change", change)
        if given.shape != shape:
            raise InvalidInput(expected, f"shape {list(given.shape)}")
        if not (np.abs(given) <= LARGEST_PUSH).all():
            raise InvalidInput(expected, f"NaN, infinity or too large: beyond {LARGEST_PUSH:g} m/s")
        for batch, mine in self._stepping:
            batch.push(given[mine].astype(np.float32))

    def restart(
        self,
        which: ArrayLike,
        position: ArrayLike | None = None,
        *,
        scenes: Sequence[Scene] | None = None,
        out: Step | None = None,
    ) -> Step:
        """The `Step` in which the agents `which` [agent, bool] stand at the start again, and the others where they
        stood. `position` [m], shape [restarted, mass, 2], and `scenes` [restarted] are for the former alone; `scenes`
        are for agents that had their own from `reset` on."""
        out = self._room_for_step("restart", out)
        which = as_numbers("which", which, None)
        if which.shape != (len(out.stand),) or which.dtype != bool:
            raise InvalidInput(f"which: expected bools of shape [{len(out.stand)}]", describe(which))
        fresh = np.flatnonzero(which)
        starts = starts_of(self.task, len(fresh), position)
        if scenes is not None and (len(scenes) != len(fresh) or not self._stepping[0][0].own_scenes):
            expected = f"scenes: expected one for each of {len(fresh)} agents, after a reset with scenes"
            raise InvalidInput(expected, str(len(scenes)))
        cut = [] if scenes is None else [self._world.cut(scene) for scene in scenes]
        for batch, mine in self._stepping:
            a, b = np.searchsorted(fresh, [mine.start, mine.stop])
            agents = fresh[a:b] - mine.start
            batch.position[agents] = starts[a:b]
            batch.restart(
                which[mine],
                dict(zip(agents.tolist(), cut[a:b], strict=False)),
                observations=out.observation[mine],
                stands=out.stand[mine],
            )
        return out

    def _room_for_step(self, verb: str, out: Step | None) -> Step:
        """A `Step` with room for all agents: views into two arrays."""
        if not self._stepping:
            raise InvalidInput(f"{verb}: expected agents at the start; call reset first")
        agents, kernel = self._stepping[-1][1].stop, self._world.kernel
        if out is None:
            observation, stand = kernel.rows_for(agents)
            fields = {name: stand[:, c].reshape(agents, *shape) for name, c, shape in self._columns}
            return Step(observation=observation, stand=stand, **fields)
        if out.observation.shape != (agents, kernel.lengths["input"]):
            raise InvalidInput(f"out: expected a Step of these {agents} agents", f"{len(out.observation)} agents")
        return out

    def _batch(self, starts: np.ndarray) -> Batch:
        """Agents that are to begin at `starts` [agent, mass, 2]."""
        return Batch(self._world, starts) if self._gpu is None else self._gpu.batch(self._world, starts)

    def _run_whole(self, batch: Batch, trace: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Final positions, steps and solved of a batch that runs the whole task."""
        task = self.task
        drive, script = CONTROLLER, None
        if task.pressure is not None:
            columns = task.body.spring_count + task.body.chamber_count
            check_memory(
                "steps: expected fewer with a given pressure", BYTES * WIDTH * task.steps * columns, MOST_TRACE_BYTES
            )
            lengths = np.repeat(task.body.rest_length[None], task.steps, axis=0)
            drive, script = REPLAY, np.concatenate([lengths, task.pressure], axis=1)
        if callable(task.end):
            return self._run_until(batch, drive, script, trace)
        fresh = np.ones(batch.agents, dtype=bool)
        batch.run(drive, task.steps, task.steps - 1, fresh=fresh, script=script, trace=trace)
        return batch.result()

    def _run_until(
        self, batch: Batch, drive: int, script: np.ndarray | None, trace: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same with an end of the user's own, asked after every step."""
        task = self.task
        final = np.zeros((batch.agents, task.body.mass_count, 2), dtype=np.float32)
        steps = np.zeros(batch.agents, dtype=np.int64)
        solved = np.zeros(batch.agents, dtype=bool)
        batch.begin(drive, trace=None if trace is None else trace[:1])
        observations, stands = batch.kernel.rows_for(batch.agents)
        position = stands[:, : 2 * task.body.mass_count].reshape(final.shape)
        for t in range(task.steps):
            batch.run(
                drive,
                1,
                task.steps - 1,
                script=None if script is None else script[t : t + 1],
                trace=None if trace is None else trace[t + 1 : t + 2],
                observations=observations,
                stands=stands,
            )
            done = np.asarray(task.end(position.copy()), dtype=bool)  # ty: ignore[not-callable]
            if done.shape != (batch.agents,):
                raise InvalidInput(f"end: expected bools of shape [{batch.agents}]", f"shape {list(done.shape)}")
            ended = (steps == 0) & (done | (t == task.steps - 1))
            final[ended], steps[ended], solved[ended] = position[ended], t + 1, done[ended]
            if (steps > 0).all():
                break
        return final, steps, solved

    def _spread(self, run: Callable[[Any], None], parts: list[Any]) -> None:
        """Runs every part, over the threads, of which the caller's is one."""
        if self._gpu is not None:
            for part in parts:
                run(part)
            return
        load_kernel()
        todo = deque(parts)

        def work() -> None:
            while todo:
                try:
                    part = todo.popleft()
                except IndexError:  # another thread was faster
                    return
                run(part)

        helpers = [_pool(self.threads).submit(work) for _ in range(min(self.threads, len(parts)) - 1)]
        try:
            work()
        finally:
            for helper in helpers:
                helper.result()


class _Work:
    """Agents that are to run a whole task, in parts that any thread may run in any order."""

    def __init__(self, simulator: Simulator, theta: ArrayLike, position: ArrayLike | None = None) -> None:
        task, world = simulator.task, simulator._world
        self._simulator = simulator
        self._theta = check_theta(theta, task.body, task.condition, task.controller)
        agents = len(self._theta)
        self._starts = starts_of(task, agents, position)
        self._final = np.empty(self._starts.shape, dtype=np.float32)
        self._steps = np.empty(agents, dtype=np.int64)
        self._solved = np.empty(agents, dtype=bool)
        if simulator._gpu is not None:
            self.parts = cut_evenly(agents, -(-agents // simulator._gpu.agents_at_once(world)))
            return
        most = max(1, min(BLOCKS_AT_ONCE, MOST_BYTES // world.kernel.block_bytes))
        self.parts = _parts(agents, agents * task.body.mass_count * task.steps, simulator.threads, most)

    def run(self, part: slice) -> None:
        batch = self._simulator._batch(self._starts[part])
        batch.think(self._theta[part])
        self._final[part], self._steps[part], self._solved[part] = self._simulator._run_whole(batch)

    def rollout(self) -> Rollout:
        """What came of them, once all parts are run."""
        return judge(self._simulator.task, self._starts, self._final, self._steps, self._solved)


def replay(
    body: Body,
    scene: Scene,
    rest_length: ArrayLike,
    pressure: ArrayLike | None = None,
    position: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    gravity: float = 10.0,
    **numbers: Any,
) -> Recording:
    """The `Recording` of a body whose springs and gas follow a given course, without a controller.

    `rest_length` [m], shape [step, spring]; `pressure` [Pa], shape [step] or [step, chamber], None for the gas law;
    `position` [m], `velocity` [m/s], shape [mass, 2], default the body's own and zero; `numbers` are those of
    `turgor.task.Physics`. A body may lack chambers or springs: single squares fall and slide.
    """
    steps = len(np.asarray(rest_length))
    lengths = given_rows("rest_length", np.asarray(rest_length).reshape(steps, -1), steps, body.spring_count)
    task = Task(
        name="replay",
        body=body,
        scene=scene,
        position=body.position if position is None else position,
        condition="passive",
        physics=Physics(gravity=gravity, **numbers),
        steps=steps,
        pressure=pressure,
    )
    batch = Batch(World(task), task.position[None].astype(np.float32))
    if velocity is not None:
        batch.velocity[:] = start_position(velocity, body).astype(np.float32)
    trace = batch.trace(steps)
    acting = np.zeros((steps, body.chamber_count)) if task.pressure is None else task.pressure
    load_kernel()
    script = np.concatenate([lengths, acting], axis=1)
    batch.run(REPLAY, steps, steps - 1, fresh=np.ones(1, dtype=bool), script=script, trace=trace)
    return _recording(task, trace)


def _recording(task: Task, trace: np.ndarray, fitness: float | None = None, solved: bool = False) -> Recording:
    """The first lane of a `trace` [step + 1, row, lane]."""
    body, n = task.body, task.body.mass_count
    columns = np.cumsum([n, n, n, n, n, body.spring_count, body.chamber_count, observation_count(body)])
    x, y, vx, vy, touch, rest, pressure, observation = np.split(trace[:, :, 0], columns[:-1], axis=1)
    return Recording(
        body=body,
        scene=task.scene,
        dt=task.physics.dt,
        position=np.stack([x, y], axis=2),
        velocity=np.stack([vx, vy], axis=2),
        pressure=pressure.copy(),
        rest_length=rest.copy(),
        touch=touch > 0,
        observation=observation[:-1].copy(),
        fitness=fitness,
        solved=solved,
    )


def perturbed(position: np.ndarray, repeats: int, size: float = 1e-6) -> np.ndarray:
    """`repeats` starts that differ from `position` [mass, 2] by one coordinate each, float32 [repeat, mass, 2].

    Start k has mass k mod n moved by `size` [m] (at least by one float32) in x, then y, then -x, -y.
    """
    starts = np.repeat(position[None].astype(np.float32), repeats, axis=0)
    n = len(position)
    for k, start in enumerate(starts):
        mass, axis = k % n, (k // n) % 2
        sign = -1 if k >= 2 * n else 1
        here = start[mass, axis]
        moved = np.float32(here + np.float32(sign * size * (1 + k // (4 * n))))
        start[mass, axis] = moved if moved != here else np.nextafter(here, np.float32(sign * np.inf))
    return starts


def open_gpu() -> Gpu:
    """The first GPU of this machine. Raises `InvalidInput` without one."""
    from turgor.physics.gpu import first_gpu

    return first_gpu()


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _parts(agents: int, work: int, threads: int, most: int = BLOCKS_AT_ONCE) -> list[slice]:
    """The batch, which is `work` [mass x step], cut evenly: a part for each thread that is worth waking, none of more
    than `most` blocks."""
    blocks = -(-agents // WIDTH)
    filled = min(threads, blocks, max(work // LEAST_WORK, 1))
    shared = min(threads, agents, work // LEAST_SHARE)
    return cut_evenly(agents, max(filled, shared, -(-blocks // most)))


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="turgor")


if hasattr(os, "register_at_fork"):  # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
