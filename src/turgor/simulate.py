"""The simulator: runs a batch of agents of one task, in blocks of lanes, over threads."""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor import physics
from turgor.body import Body
from turgor.control import check_theta, observation_count, output_count, pack
from turgor.errors import InvalidInput, describe
from turgor.physics.memory import LINE, Width, aligned
from turgor.physics.model import COMMANDS, CONTROLLER, REPLAY, WIDTH, Brain, Result, State, Work
from turgor.physics.step import run_blocks
from turgor.physics.tables import Kernel, make_kernel
from turgor.recording import Recording
from turgor.scene import LARGEST_COORDINATE, Scene
from turgor.task import Physics, Task, given_rows, start_position

BLOCKS_AT_ONCE = 8  # of a thread: memory does not grow with the batch


class Rollout(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """What a batch of agents achieved; every field is per agent."""

    fitness: Any  # [agent], see `Task.fitness`
    steps: Any  # [agent], steps until the end
    solved: Any  # [agent], bool: the end came before the time was up
    com: Any  # [m], shape [agent, 2], final centre of mass
    start: Any  # [m], shape [agent, 2], centre of mass at the start
    position: Any  # [m], shape [agent, mass, 2], final


class Step(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Where a batch of agents stands between two steps; every field is per agent."""

    observation: Any  # [1], shape [agent, input]: the window's mean, what a controller sees now
    position: Any  # [m], shape [agent, mass, 2]
    velocity: Any  # [m/s], shape [agent, mass, 2]
    pressure: Any  # [Pa], shape [agent, chamber]
    solved: Any  # [agent], bool: the end has come


class Simulator:
    """Runs agents of one `Task`. What an agent does depends neither on the batch it is in nor on `threads`."""

    def __init__(self, task: Task, *, threads: int | None = None) -> None:
        """`threads`: None for all cores. Raises `InvalidInput` for fewer than 1."""
        if threads is not None and (not isinstance(threads, int) or threads < 1):
            raise InvalidInput("threads: expected a whole number, at least 1", describe(threads))
        self.task = task
        self.threads = threads or available_cores()
        self._kernel = make_kernel(task)
        self._stepping: list[_Batch] = []

    def rollout(self, theta: ArrayLike, position: ArrayLike | None = None) -> Rollout:
        """A `Rollout` of every row of `theta` [agent, parameter] from the task's start, or from `position` [m],
        shape [agent, mass, 2]. Raises `InvalidInput` for another shape or numbers that are not finite."""
        theta = check_theta(theta, self.task.body, self.task.condition, self.task.controller)
        starts = self._starts(len(theta), position)
        final = np.empty(starts.shape, dtype=np.float32)
        steps = np.empty(len(theta), dtype=np.int64)
        solved = np.empty(len(theta), dtype=bool)

        def run(part: slice) -> None:
            batch = _Batch(self._kernel, starts[part])
            batch.think(theta[part], self.task)
            final[part], steps[part], solved[part] = self._run_whole(batch)

        self._spread(run, _parts(len(theta), self.threads))
        return self._judge(starts, final, steps, solved)

    def record(self, theta: ArrayLike, position: ArrayLike | None = None) -> Recording:
        """The `Recording` of one controller, `theta` [parameter], from the task's start or from `position`
        [mass, 2]: the same steps that `rollout` takes."""
        theta = np.reshape(np.asarray(theta), (1, -1))
        theta = check_theta(theta, self.task.body, self.task.condition, self.task.controller)
        starts = self._starts(1, None if position is None else np.asarray(position)[None])
        batch = _Batch(self._kernel, starts)
        batch.think(theta, self.task)
        trace = batch.trace(self.task.steps)
        final, steps, solved = self._run_whole(batch, trace)
        out = self._judge(starts, final, steps, solved)
        return _recording(self.task, trace[: steps[0] + 1], float(out.fitness[0]), bool(solved[0]))

    def reset(self, agents: int, position: ArrayLike | None = None) -> Step:
        """Puts `agents` agents at the start, to be driven by `step`; returns their first `Step`."""
        if not isinstance(agents, int) or agents < 1:
            raise InvalidInput("agents: expected a whole number, at least 1", describe(agents))
        starts = self._starts(agents, position)
        load_kernel()
        self._stepping = [_Batch(self._kernel, starts[part]) for part in _parts(agents, self.threads)]
        for batch in self._stepping:
            batch.run(COMMANDS, first=0, steps=0, last=self.task.steps - 1)
        return self._stand()

    def step(self, commands: ArrayLike) -> Step:
        """One step of all agents after `reset`, with `commands` [agent, output] in place of a controller's outputs:
        springs in [-1, 1], then each chamber's pressure change in units of `Task.pressure_step`."""
        if not self._stepping:
            raise InvalidInput("step: expected agents at the start; call reset first")
        agents = sum(batch.agents for batch in self._stepping)
        commands = np.asarray(commands, dtype=np.float32)
        outputs = output_count(self.task.body, self.task.condition)
        if commands.shape != (agents, outputs) or not np.isfinite(commands).all():
            raise InvalidInput(
                f"commands: expected finite numbers of shape [{agents}, {outputs}]", f"shape {list(commands.shape)}"
            )
        parts = _parts(agents, self.threads)

        def run(k: int) -> None:
            self._stepping[k].command(commands[parts[k]])

        self._spread(run, list(range(len(parts))))
        return self._stand()

    def _stand(self) -> Step:
        pieces = [batch.stand() for batch in self._stepping]
        joined = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
        return Step(**joined)

    def _run_whole(self, batch: _Batch, trace: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Final positions, steps and solved of a batch that runs the whole task."""
        task = self.task
        drive, script = CONTROLLER, None
        if task.pressure is not None:
            lengths = np.repeat(task.body.rest_length[None], task.steps, axis=0)
            drive, script = REPLAY, np.concatenate([lengths, task.pressure], axis=1)
        if not callable(task.end):
            batch.run(drive, first=0, steps=task.steps, last=task.steps - 1, script=script, trace=trace)
            return batch.result()
        return self._run_until(batch, drive, script, trace)

    def _run_until(
        self, batch: _Batch, drive: int, script: np.ndarray | None, trace: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same with an end of the user's own, asked after every step."""
        task = self.task
        final = np.zeros((batch.agents, task.body.mass_count, 2), dtype=np.float32)
        steps = np.zeros(batch.agents, dtype=np.int64)
        solved = np.zeros(batch.agents, dtype=bool)
        for t in range(task.steps):
            rows_of_t = None if script is None else script[t : t + 1]
            # a trace of two rows: before and after this step
            here = None if trace is None else batch.trace(1)
            batch.run(drive, first=t, steps=1, last=task.steps - 1, script=rows_of_t, trace=here)
            if trace is not None and here is not None:
                trace[t + 1] = here[1]
                if t == 0:
                    trace[0] = here[0]
            position = batch.stand()["position"]
            done = np.asarray(task.end(position), dtype=bool)  # ty: ignore[not-callable]
            if done.shape != (batch.agents,):
                raise InvalidInput(f"end: expected bools of shape [{batch.agents}]", f"shape {list(done.shape)}")
            ended = (steps == 0) & (done | (t == task.steps - 1))
            final[ended], steps[ended], solved[ended] = position[ended], t + 1, done[ended]
            if (steps > 0).all():
                break
        return final, steps, solved

    def _starts(self, agents: int, position: ArrayLike | None) -> np.ndarray:
        shape = (agents, self.task.body.mass_count, 2)
        if position is None:
            return np.broadcast_to(self.task.position.astype(np.float32), shape)
        starts = np.asarray(position, dtype=np.float64)
        if starts.shape != shape or not (np.abs(starts) <= LARGEST_COORDINATE).all():
            raise InvalidInput(
                f"position: expected finite numbers of shape {list(shape)}", f"shape {list(starts.shape)} or too large"
            )
        return starts.astype(np.float32) + np.float32(0)  # no negative zeros

    def _spread(self, run: Callable[[Any], None], parts: list[Any]) -> None:
        """Runs every part, over the threads."""
        load_kernel()
        if self.threads == 1 or len(parts) == 1:
            for part in parts:
                run(part)
        else:
            list(_pool(self.threads).map(run, parts))

    def _judge(self, starts: np.ndarray, final: np.ndarray, steps: np.ndarray, solved: np.ndarray) -> Rollout:
        task = self.task
        share = task.body.mass / task.body.mass.sum()
        start = np.einsum("amd,m->ad", starts.astype(np.float64), share)
        com = np.einsum("amd,m->ad", final.astype(np.float64), share)
        travel = com[:, 0] - start[:, 0]
        if task.fitness == "progress":
            fitness = travel / task.duration
        elif task.fitness == "distance":
            fitness = np.abs(travel) / task.duration
        elif task.fitness == "elapsed":
            fitness = np.abs(travel) / (steps * task.physics.dt)
        else:
            fitness = np.full(len(steps), np.nan)
        if task.fitness == "area":
            fitness = task.body.area(final.astype(np.float64))[:, 0] / task.area_reference[0]
        out = Rollout(fitness=fitness, steps=steps, solved=solved, com=com, start=start, position=final)
        if callable(task.fitness):
            fitness = np.asarray(task.fitness(out), dtype=np.float64)
            if fitness.shape != steps.shape:
                raise InvalidInput(f"fitness: expected numbers of shape [{len(steps)}]", f"shape {list(fitness.shape)}")
            out = msgspec.structs.replace(out, fitness=fitness)
        return out


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
    batch = _Batch(make_kernel(task), task.position[None].astype(np.float32))
    if velocity is not None:
        batch.velocity[:] = start_position(velocity, body).astype(np.float32)
    trace = batch.trace(steps)
    acting = np.zeros((steps, body.chamber_count)) if task.pressure is None else task.pressure
    load_kernel()
    batch.run(REPLAY, 0, steps, steps - 1, script=np.concatenate([lengths, acting], axis=1), trace=trace)
    return _recording(task, trace)


class _Batch:
    """Blocks of agents and their memory: what one call of the kernel works on."""

    def __init__(self, kernel: Kernel, starts: np.ndarray) -> None:
        self.kernel = kernel
        self.agents = len(starts)
        blocks = -(-self.agents // WIDTH)
        # unused lanes repeat the last agent
        self.lanes = np.minimum(np.arange(blocks * WIDTH), self.agents - 1)
        self.position = np.ascontiguousarray(starts[self.lanes], dtype=np.float32)
        self.velocity = np.zeros_like(self.position)
        self.memory = aligned(blocks, kernel.size(State))
        self.brains = aligned(blocks, kernel.size(Brain))
        self.results = aligned(blocks, kernel.size(Result))
        self._step = 0

    def think(self, theta: np.ndarray, task: Task) -> None:
        """Gives the agents their controllers, `theta` [agent, parameter]."""
        weights, biases = pack(theta, task.body, task.condition, task.controller, task.physics.dt)
        for block, brain in enumerate(self.brains):
            lanes = self.lanes[block * WIDTH : (block + 1) * WIDTH]
            self.kernel.field(brain, Brain, "weight")[:] = weights[lanes].T
            self.kernel.field(brain, Brain, "bias")[:] = biases[lanes].T

    def trace(self, steps: int) -> np.ndarray:
        """Room for a recording of the first block, float32 [step + 1, row, lane]."""
        body = self.kernel.lengths
        row = 5 * body["mass"] + body["spring"] + body["chamber"] + body["input"]
        return aligned(steps + 1, row * WIDTH).reshape(steps + 1, row, WIDTH)

    def run(
        self,
        drive: int,
        first: int,
        steps: int,
        last: int,
        script: np.ndarray | None = None,
        trace: np.ndarray | None = None,
        scripts: np.ndarray | None = None,
    ) -> None:
        """Runs `steps` steps from step `first`; `last` is the task's last. `script` [step, row] is for all agents,
        `scripts` [block, size] for each."""
        if scripts is None:
            scripts = aligned(1, 0 if script is None else script.size * WIDTH)
            if script is not None:
                scripts[0] = np.repeat(script.ravel(), WIDTH)
        traces = np.zeros((1, 0), np.float32) if trace is None else trace.reshape(1, -1)
        kernel = self.kernel
        # the kernel's loads and stores are of whole cache lines
        assert all(
            a.ctypes.data % LINE == 0 or a.size == 0 for a in (self.memory, self.brains, self.results, scripts, traces)
        )
        run_blocks(
            _width(), kernel.settings, kernel.tables, self.memory, self.brains, scripts, traces, self.results,
            kernel.layouts, self.position, self.velocity, drive, first, steps, last,
        )  # fmt: skip

    def command(self, commands: np.ndarray) -> None:
        """One step of every agent with `commands` [agent, output] of its own."""
        blocks = commands[self.lanes].reshape(-1, WIDTH, commands.shape[1])
        scripts = aligned(len(blocks), commands.shape[1] * WIDTH)
        scripts[:] = blocks.transpose(0, 2, 1).reshape(len(blocks), -1)
        self.run(COMMANDS, first=self._step, steps=1, last=-1, scripts=scripts)
        self._step += 1

    def stand(self) -> dict[str, np.ndarray]:
        """The fields of a `Step`."""
        return {
            "observation": self._rows(self.memory, Work, "mean"),
            "position": np.stack([self._rows(self.memory, State, name) for name in ("x", "y")], axis=2),
            "velocity": np.stack([self._rows(self.memory, State, name) for name in ("vx", "vy")], axis=2),
            "pressure": self._rows(self.memory, State, "pressure"),
            "solved": self._rows(self.results, Result, "solved")[:, 0] > 0,
        }

    def result(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Final positions [agent, mass, 2], steps [agent], solved [agent]."""
        final = np.stack([self._rows(self.results, Result, name) for name in ("x", "y")], axis=2)
        steps = self._rows(self.results, Result, "steps")[:, 0].astype(np.int64)
        return final, steps, self._rows(self.results, Result, "solved")[:, 0] > 0

    def _rows(self, buffers: np.ndarray, view: type, name: str) -> np.ndarray:
        """A field as [agent, length]."""
        blocks = [self.kernel.field(buffer, view, name).T for buffer in buffers]
        return np.concatenate(blocks)[: self.agents]


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


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _parts(agents: int, threads: int) -> list[slice]:
    """The batch cut evenly: for every thread a part, as long as that fills lanes, and none too large."""
    blocks = -(-agents // WIDTH)
    count = max(min(threads, blocks), -(-blocks // BLOCKS_AT_ONCE))
    bounds = [agents * k // count for k in range(count + 1)] if count else []
    return [slice(a, b) for a, b in pairwise(bounds)]


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="turgor")


if hasattr(os, "register_at_fork"):  # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


@lru_cache
def _width() -> Width:
    """The kernel's width, marked with its sources."""
    sources = sorted(Path(physics.__file__).parent.glob("*.py"))
    return Width(WIDTH, hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:12])


@lru_cache
def load_kernel() -> None:
    """Has the kernel ready, compiled or from the cache; says so if that takes a while."""
    said = "turgor: compiling the engine for this processor, once ..."
    notice = threading.Timer(1.5, print, [said], {"file": sys.stderr, "flush": True})
    notice.daemon = True
    notice.start()
    body = Body([[0.0, 0.0]])
    task = Task(name="nothing", body=body, scene=Scene([]), position=body.position, condition="passive")
    try:
        _Batch(make_kernel(task), np.zeros((0, 1, 2))).run(CONTROLLER, first=0, steps=0, last=0)
    finally:
        notice.cancel()
