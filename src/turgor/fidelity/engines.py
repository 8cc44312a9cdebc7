"""The other engines by name, and agents that run in them, over processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module, metadata
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.control import check_theta
from turgor.errors import InvalidInput, WorkLost, describe, one_of
from turgor.experiments.campaign import follow_first_process
from turgor.fidelity.drive import Ended, Trace, World, new_trace, run
from turgor.recording import Recording
from turgor.rollout import Rollout, cut_evenly, judge, starts_of
from turgor.simulate import MOST_THREADS, available_cores
from turgor.task import Task

MOST_TOGETHER = 16  # agents in lockstep: more gain nothing, and Box2D v3 has room for 128 worlds in a process


class Engine(NamedTuple):
    """Another physics engine, and where it is driven from."""

    says: str  # its name for people
    module: str
    world: str  # class in it
    package: str  # that has to be installed


ENGINES = {
    "box2d": Engine("Box2D 2.3", "turgor.fidelity.box2d", "Box2DWorld", "box2d"),
    "box2d-ccd": Engine("Box2D 2.3 with CCD", "turgor.fidelity.box2d", "ContinuousBox2DWorld", "box2d"),
    "box2d-fine": Engine("Box2D 2.3, 4 steps in one", "turgor.fidelity.box2d", "FineBox2DWorld", "box2d"),
    "box2d-v3": Engine("Box2D v3", "turgor.fidelity.box2d_v3", "Box2Dv3World", "pyb2d3"),
}


def load_world(engine: str) -> type[World]:
    """The class of `engine`'s worlds. Raises `InvalidInput` for an unknown engine, and where its package is missing."""
    if engine not in ENGINES:
        raise one_of("engine", ENGINES, engine)
    where = ENGINES[engine]
    try:
        return getattr(import_module(where.module), where.world)
    except ImportError as error:
        expected = f"engine {engine}: expected the package {where.package} (pip install 'turgor[box2d]')"
        raise InvalidInput(expected, describe(error)) from None


def installed() -> list[str]:
    """The names of all engines whose package can be imported."""

    def is_there(engine: str) -> bool:
        try:
            load_world(engine)
        except InvalidInput:
            return False
        return True

    return [engine for engine in ENGINES if is_there(engine)]


def check_engine(engine: str, task: Task) -> None:
    """Raises `InvalidInput` where `load_world` does, and for a task that `engine` has no counterpart of."""
    load_world(engine)(task, task.position).close()


def version_of(engine: str) -> str:
    """The package that `engine` comes with, and its version."""
    package = ENGINES[engine].package
    return f"{package} {metadata.version(package)}"


# --- jobs ---------------------------------------------------------------------------------------------------------


class Job(NamedTuple):
    """Agents of one task, to be run in another engine."""

    engine: str
    task: Task
    theta: np.ndarray  # [agent, parameter]
    starts: np.ndarray  # [m], shape [agent, mass, 2]
    record: bool  # the first agent's steps are kept


class Done(NamedTuple):
    """What came of a `Job`."""

    rollout: Rollout
    recording: Recording | None  # of the first agent


def make_job(
    engine: str, task: Task, theta: ArrayLike, position: ArrayLike | None = None, *, record: bool = False
) -> Job:
    """Agents with `theta` [agent, parameter], from the task's start or from `position` [m], shape [agent, mass, 2].
    Raises `InvalidInput` for other shapes, and for what `engine` cannot do."""
    check_engine(engine, task)
    theta = check_theta(theta, task.body, task.condition, task.controller)
    return Job(engine, task, theta, starts_of(task, len(theta), position), record)


class Crew:
    """Processes that run jobs; a context, which ends them. With one process the jobs are run in this one; more are
    spawned, and then a script has to be guarded by `if __name__ == "__main__"`."""

    def __init__(self, processes: int | None = None) -> None:
        """`processes`: None for all cores. Raises `InvalidInput` for fewer than 1, or more than any machine has."""
        if processes is not None and (not isinstance(processes, int) or not 1 <= processes <= MOST_THREADS):
            raise InvalidInput(f"processes: expected a whole number, 1 to {MOST_THREADS}", describe(processes))
        self.processes = processes or available_cores()
        self._pool: Executor
        self._end: Connection | None = None  # of a pipe: processes end where its other end is closed
        self._open: Connection | None = None

    def __enter__(self) -> Crew:
        if self.processes == 1:
            self._pool = ThreadPoolExecutor(1)
        else:
            context = multiprocessing.get_context("spawn")
            self._end, self._open = context.Pipe(duplex=False)
            self._pool = ProcessPoolExecutor(self.processes, context, _begin, (self._end,))
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is not None and self._open is not None:
            self._open.close()  # as Ctrl-C: what is in hand is of no use any more
        self._pool.shutdown(cancel_futures=True)
        for end in (self._end, self._open):
            if end is not None:
                end.close()

    def run(self, jobs: Sequence[Job], progress: Callable[[int, int], object] | None = None) -> Iterator[Done]:
        """What came of each of `jobs`, in their order, as soon as it is known. `progress` is called with the agents
        that are done and with all, whenever some are done."""
        agents: dict[Future[tuple[Ended, Trace | None]], int] = {}
        try:
            futures = [[self._submit(job, part) for part in self._parts(job)] for job in jobs]
            agents |= {future: part.stop - part.start for job in futures for future, part in job}
            for job, parts in zip(jobs, futures, strict=True):
                for _ in as_completed([future for future, _ in parts]):
                    if progress is not None:
                        progress(sum(n for future, n in agents.items() if future.done()), sum(agents.values()))
                yield _joined(job, [future.result() for future, _ in parts])
        except BrokenProcessPool:
            expected = "crosscheck: expected its processes to go on; one was ended from outside (memory?)"
            raise WorkLost(expected) from None
        finally:
            for future in agents:
                future.cancel()

    def _submit(self, job: Job, part: slice) -> tuple[Future[tuple[Ended, Trace | None]], slice]:
        # fitness is judged here, so that a function of the user's own need not travel
        task = msgspec.structs.replace(job.task, fitness="progress")
        record = job.record and part.start == 0
        return self._pool.submit(_work, job.engine, task, job.theta[part], job.starts[part], record), part

    def _parts(self, job: Job) -> list[slice]:
        """One for every process, as long as they are not too large."""
        agents = len(job.theta)
        return cut_evenly(agents, max(min(self.processes, agents), -(-agents // MOST_TOGETHER)))


def _begin(end: Connection) -> None:
    """Ends this process where the first one is gone, or has closed the other end of the pipe."""
    follow_first_process()

    def wait() -> None:
        with contextlib.suppress(EOFError, OSError):
            end.recv()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _work(engine: str, task: Task, theta: np.ndarray, starts: np.ndarray, record: bool) -> tuple[Ended, Trace | None]:
    trace = new_trace() if record else None
    return run(load_world(engine), task, theta, starts, trace=trace), trace


def _joined(job: Job, answers: list[tuple[Ended, Trace | None]]) -> Done:
    final, steps, solved = (np.concatenate(field) for field in zip(*(ended for ended, _ in answers), strict=True))
    rollout = judge(job.task, job.starts, final, steps, solved)
    trace = answers[0][1]
    return Done(rollout, None if trace is None else _recording(job.task, trace, rollout))


def _recording(task: Task, trace: Trace, rollout: Rollout) -> Recording:
    fields: dict[str, Any] = {name: np.array(values) for name, values in trace._asdict().items()}
    steps = rollout.steps[0]
    fields = {name: array[: steps + 1] for name, array in fields.items()}
    fields["observation"] = fields["observation"][:steps] if len(fields["observation"]) else None
    fitness, solved = float(rollout.fitness[0]), bool(rollout.solved[0])
    return Recording(body=task.body, scene=task.scene, dt=task.physics.dt, fitness=fitness, solved=solved, **fields)
