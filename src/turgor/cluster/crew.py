"""The crew: a cluster's workers, given jobs so that their deaths, their silence and their number change no bit.

A job is a function and its arguments, with the same answer whoever does it. The first answer to a job counts. A worker
that dies loses its jobs to others, which is Dask's doing. Of one that is silent for too long, its jobs are given to
others as well, and it gets no new ones until it answers. A worker of other versions is refused.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import statistics
import sys
import time
import uuid
from collections import deque
from collections.abc import Callable, Coroutine, Generator, Hashable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import msgspec

from turgor.cluster.connect import check_client
from turgor.cluster.stand import COMPARED, check_versions, own_kernels, own_versions, python_of
from turgor.errors import InvalidInput, WorkLost, describe

if TYPE_CHECKING:
    from distributed import Client, Future

PULSE = 1.0  # [s], between two looks at who is there
DEATHS = 3  # of so many sets of workers by the same job: it is the job
LARGEST_MESSAGE = "1 GB"  # that Dask does not warn of: the state of a large run is 29 MB
REMEMBERED = 100  # answers, for how long one usually takes

T = TypeVar("T")


class Patience(msgspec.Struct, frozen=True, kw_only=True):
    """How long what is waited for. Set in Dask's configuration, as in `DASK_TURGOR__ANSWER_TIMEOUT=300`."""

    answer_timeout: float = 60.0  # [s], at least, until a job is given to another worker
    answer_factor: float = 5.0  # [1], the same as a multiple of what an answer usually takes
    workers_timeout: float = 120.0  # [s] without any worker
    scheduler_timeout: float = 20.0  # [s] without a word from the scheduler
    segment: float = 15.0  # [s] of a campaign's run between two checkpoints


def patience() -> Patience:
    """The settings in force. Raises `InvalidInput`."""
    import dask
    from dask.utils import parse_timedelta

    chosen = {}
    for name, default in msgspec.structs.asdict(Patience()).items():
        given = dask.config.get(f"turgor.{name.replace('_', '-')}", default)
        try:
            chosen[name] = float(given) if name == "answer_factor" else parse_timedelta(given, "s") or 0.0
        except (TypeError, ValueError, KeyError):
            chosen[name] = 0.0
        if not chosen[name] > 0:
            raise InvalidInput(f"turgor.{name}: expected a positive number in Dask's configuration", describe(given))
    return Patience(**chosen)


class _Attempt:
    """One way on which an answer may come."""

    def __init__(self, future: Future, answer: concurrent.futures.Future[Any]) -> None:
        self.future, self.answer = future, answer


class _Job:
    """What is to be done, and its attempts so far."""

    def __init__(self, name: Any, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self.name, self.function, self.arguments = name, function, arguments
        self.attempts: list[_Attempt] = []
        self.given = self.since = time.monotonic()  # first given; last given, or last known to wait its turn
        self.deaths = 0


class Crew:
    """The workers of a Dask client, at work on jobs. `wait` returns answers in whatever order they come."""

    def __init__(self, client: Client, *, whole_runs: bool = False) -> None:
        """`whole_runs`: jobs are more than simulations, so that all processors have to calculate alike.

        Raises `InvalidInput` for a `client` that is none, or a worker of other versions; `WorkLost` where the scheduler
        is silent.
        """
        self._client = check_client(client)
        self._loop = cast(Any, client.loop).asyncio_loop
        self._patience = patience()
        self._expected = {**own_versions(), **(own_kernels() if whole_runs else {})}
        self._jobs: dict[Any, _Job] = {}
        self._workers: dict[str, int] = {}  # threads of each, by its address
        self._silent: set[str] = set()  # workers that owe an answer for too long
        self._asked: set[str] = set()  # workers whose versions were asked for
        self._versions: concurrent.futures.Future[Any] | None = None
        self._took: deque[float] = deque(maxlen=REMEMBERED)  # [s], of the last answers
        self._looked = self._peopled = time.monotonic()
        self._told: set[str] = set()  # what was said, and need not be said again
        self.topic = f"turgor-{uuid.uuid4().hex}"  # of what jobs tell on the way, by `Worker.log_event`
        self._look()
        if self._versions is not None:  # a stranger among them is refused before there is any work
            concurrent.futures.wait([self._versions], self._patience.scheduler_timeout)
            self._check_strangers()

    @property
    def workers(self) -> int:
        """Workers that answer."""
        return len(self._workers.keys() - self._silent)

    @property
    def threads(self) -> int:
        """Threads of the workers that answer: jobs that are done at a time."""
        return sum(threads for worker, threads in self._workers.items() if worker not in self._silent)

    @property
    def jobs(self) -> int:
        """Jobs in hand."""
        return len(self._jobs)

    @property
    def segment(self) -> float:
        """Length of a run's pieces [s]."""
        return self._patience.segment

    def give(self, name: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Gives a job to whoever is free: `function`, which a worker imports, and its `arguments`."""
        assert name not in self._jobs
        job = self._jobs[name] = _Job(name, function, arguments)
        self._try(job, self._silent)

    def wait(self, seconds: float = float("inf")) -> list[tuple[Any, Any]]:
        """Names of the jobs that are done, and their answers: at least one, unless `seconds` are over.

        Raises what a job raised; `WorkLost` if the scheduler or all workers are gone; `InvalidInput` for a worker of
        other versions or a job that kills its workers.
        """
        until = time.monotonic() + seconds
        while self._jobs:
            left = until - time.monotonic()
            answers = [attempt.answer for job in self._jobs.values() for attempt in job.attempts]
            concurrent.futures.wait(answers, max(min(left, PULSE), 0.0), concurrent.futures.FIRST_COMPLETED)
            done = [found for job in list(self._jobs.values()) if (found := self._answer_to(job)) is not None]
            if time.monotonic() - self._looked > PULSE:
                self._look()
            if done or left <= 0:
                return done
        return []

    @contextlib.contextmanager
    def listening(self, hear: Callable[[Any], object]) -> Generator[None]:
        """Calls `hear`, in another thread, with what jobs tell under `topic`."""
        self._client.subscribe_topic(self.topic, lambda event: hear(event[1]))
        try:
            yield
        finally:
            if self._client.status == "running":
                self._client.unsubscribe_topic(self.topic)

    def drop(self) -> None:
        """Forgets all jobs in hand; what waits for a worker is not begun."""
        for job in self._jobs.values():
            self._forget(job)
        self._jobs.clear()

    # --- jobs -----------------------------------------------------------------------------------------------------

    def _try(self, job: _Job, without: set[str]) -> None:
        """One more attempt, by other workers than `without` where there are others."""
        import dask

        if self._client.status != "running":
            raise self._scheduler_lost()
        others = [worker for worker in self._workers if worker not in without] if without else []
        where: dict[str, Any] = {"workers": others, "allow_other_workers": True} if others else {}
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": LARGEST_MESSAGE}):
            future = self._client.submit(perform, self._expected, job.function, job.arguments, pure=False, **where)
        job.attempts.append(_Attempt(future, self._begin(_answer(future))))
        job.since = time.monotonic()

    def _answer_to(self, job: _Job) -> tuple[Any, Any] | None:
        """The first answer to a job, which is then forgotten; None if there is none yet."""
        for attempt in [attempt for attempt in job.attempts if attempt.answer.done()]:
            job.attempts.remove(attempt)
            found, error = attempt.answer.result()
            if error is not None:
                self._weigh(job, error)
                continue
            worker, answer = found
            self._silent.discard(worker)
            self._took.append(time.monotonic() - job.given)
            self._forget(job)
            del self._jobs[job.name]
            return job.name, answer
        return None

    def _weigh(self, job: _Job, error: Exception) -> None:
        """What an attempt's `error` means: another attempt, or the end."""
        from distributed import KilledWorker

        if isinstance(error, _Gone) or self._client.status != "running":
            raise self._scheduler_lost()
        if isinstance(error, KilledWorker):
            job.deaths += 1
            if job.deaths == DEATHS:
                expected = "cluster: expected a job that workers survive (is there enough memory?)"
                raise InvalidInput(expected, f"one that {DEATHS} times in a row killed all that tried, {error.args[1]}")
            self._try(job, self._silent)
        elif isinstance(error, ImportError):
            expected = f"cluster: expected turgor {own_versions()['turgor']}, and what your own functions import, on "
            raise InvalidInput(f"{expected}every worker", describe(error)) from None
        else:
            raise error

    def _forget(self, job: _Job) -> None:
        for attempt in job.attempts:
            attempt.answer.cancel()
            attempt.future.release()
        job.attempts.clear()

    # --- workers --------------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Sees who is there, whether strangers came, and who is silent for too long."""
        self._workers = self._ask(_threads_of(self._client))
        now = self._looked = time.monotonic()
        self._silent &= self._workers.keys()
        if self._workers:
            self._peopled = now
        elif now - self._peopled > self._patience.workers_timeout:
            raise WorkLost(f"cluster: no worker at {self._address} for {now - self._peopled:.0f} s")
        else:
            self._say_once(f"no worker at {self._address}; waiting {self._patience.workers_timeout:.0f} s for one ...")
        self._check_strangers()
        self._give_overdue_to_others(now)

    def _check_strangers(self) -> None:
        """Refuses workers of other versions; asks those that are new."""
        if self._versions is not None and self._versions.done():
            if self._versions.exception() is None:
                for worker, stand in self._versions.result()["workers"].items():
                    packages = stand["packages"]
                    found = {**packages, "python": python_of(packages["python"])}
                    check_versions(worker, {name: found.get(name) for name in (*COMPARED, "python")}, own_versions())
            self._versions = None
        if self._versions is None and self._workers.keys() - self._asked:
            self._asked |= self._workers.keys()
            self._versions = self._begin(_versions_of(self._client, self._patience.scheduler_timeout))

    def _give_overdue_to_others(self, now: float) -> None:
        usual = statistics.median(self._took) if self._took else 0.0
        limit = max(self._patience.answer_timeout, self._patience.answer_factor * usual)
        overdue = [job for job in self._jobs.values() if now - job.since > limit]
        if not overdue:
            return
        holders = self._ask(_holders_of(self._client))
        for job in overdue:
            silent = {worker for attempt in job.attempts for worker in holders.get(attempt.future.key, ())}
            self._silent |= silent
            job.since = now
            others = self._workers.keys() - self._silent
            for worker in sorted(silent):
                what = "its work is given to others" if others else "there is no other worker; waiting"
                self._say_once(f"no answer from worker {worker} for {limit:.0f} s: {what}")
            if silent and others:
                self._try(job, self._silent)

    def _say_once(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            print(f"turgor: {text}", file=sys.stderr, flush=True)

    # --- the client's event loop ----------------------------------------------------------------------------------

    @property
    def _address(self) -> str:
        return self._client.scheduler.address if self._client.scheduler is not None else "the cluster"

    def _begin(self, coroutine: Coroutine[Any, Any, T]) -> concurrent.futures.Future[T]:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop)

    def _ask(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """What the scheduler says to a question; raises `WorkLost` if it is silent."""
        answer, until = self._begin(coroutine), time.monotonic() + self._patience.scheduler_timeout
        while self._client.status == "running" and time.monotonic() < until:
            if concurrent.futures.wait([answer], PULSE / 10).done:
                break
        try:
            return answer.result(0)
        except (OSError, TimeoutError, concurrent.futures.CancelledError):
            answer.cancel()
            raise self._scheduler_lost() from None

    def _scheduler_lost(self) -> WorkLost:
        return WorkLost(f"cluster: the scheduler at {self._address} is gone or does not answer")


def perform(expected: dict[str, str], function: Callable[..., T], arguments: tuple[Any, ...]) -> tuple[str, T]:
    """Address of the worker that does a job, and the answer. Raises `InvalidInput` on a worker of other versions
    or, where that is asked for, other kernels."""
    from distributed import get_worker

    worker = get_worker().address
    check_versions(worker, own_versions(), expected)
    if not expected.keys() <= own_versions().keys():
        check_versions(worker, own_kernels(), expected)
    return worker, function(*arguments)


class _Gone(Exception):
    """A future was cancelled by the end of its scheduler."""


async def _answer(future: Future) -> tuple[Any, Exception | None]:
    """What a future brings, or the error that it brings."""
    try:
        return await future, None
    except (asyncio.CancelledError, concurrent.futures.CancelledError):
        if future.cancelled():
            return None, _Gone()
        raise
    except Exception as error:
        return None, error


async def _threads_of(client: Client) -> dict[str, int]:
    return dict(await client.nthreads())


async def _holders_of(client: Client) -> dict[Hashable, list[str]]:
    """Workers that have a task to do or its result, by the task's key."""
    holders: dict[Hashable, list[str]] = {}
    for found in (await client.processing(), await client.has_what()):
        for worker, keys in found.items():
            for key in keys:
                holders.setdefault(key, []).append(worker)
    return holders


async def _versions_of(client: Client, seconds: float) -> dict[str, Any]:
    return await asyncio.wait_for(cast(Any, client.get_versions(packages=list(COMPARED))), seconds)
