"""A model of evolutions on a Dask cluster, event by event: where does the time go with so many workers?

    coordinator    asks and tells (`optimizer`), submits each shard and takes its result
    scheduler      gets each shard, sends it to a worker, gets its result, passes it on
    network        in and out of the scheduler's machine, each way on its own
    workers        one shard at a time each; a free one takes what waits longest

Coordinator, scheduler and each way of the network do one thing at a time, in the order in which it comes. An evolution
submits the shards of a generation, waits for all of them, and goes on with the next. A whole run that comes in pieces
is an evolution of one shard a generation without an optimizer at the coordinator. Everything that the model knows is
in `Cluster` and `Load`; nothing is drawn at random.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import msgspec


class Cluster(msgspec.Struct, frozen=True, kw_only=True):
    """Who works, and what a shard costs each of them apart from its simulation: half when it comes, half when its
    result does."""

    workers: int
    coordinator_task: float = 0.0  # [s] a shard
    coordinator_byte: float = 0.0  # [s] a byte of what it submits and takes
    scheduler_task: float = 0.0
    scheduler_byte: float = 0.0
    worker_task: float = 0.0
    worker_byte: float = 0.0
    latency: float = 0.0  # [s] a shard, in which nobody works: messages wait to be sent together
    network: float = float("inf")  # [byte/s], each way
    one_machine: int | None = None  # its cores, if all run there and all workers in one process; None: own ones


class Load(msgspec.Struct, frozen=True, kw_only=True):
    """What is to be done."""

    evolutions: int  # at the same time
    generations: int  # of each
    shards: int  # of a generation
    seconds: float  # [s] of simulating a shard
    bytes_there: float = 0.0  # of a shard
    bytes_back: float = 0.0  # of its result
    optimizer: float = 0.0  # [s] of ask and tell, once a generation

    @property
    def tasks(self) -> int:
        return self.evolutions * self.generations * self.shards


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """How long it took, and which part of that time each of them was busy [1]; of the network, the busier way."""

    seconds: float
    workers: float
    coordinator: float
    scheduler: float
    network: float

    @property
    def bottleneck(self) -> str:
        """Who was the busiest."""
        return max(("workers", "coordinator", "scheduler", "network"), key=lambda name: getattr(self, name))


class Server:
    """Does one thing at a time, in the order in which it comes."""

    def __init__(self) -> None:
        self.waiting = deque[tuple[int, float, Callable[[], None]]]()  # order of coming, [s], what follows
        self.working, self.busy = False, 0.0


class _Run:
    """The run of a `Load` on a `Cluster`: each method is an event, and arranges the next."""

    def __init__(self, cluster: Cluster, load: Load) -> None:
        self.cluster, self.load, self.now = cluster, load, 0.0
        self.coordinator, self.scheduler, self.host = Server(), Server(), Server()
        self.there, self.back = Server(), Server()
        self.sharing = (self.coordinator, self.scheduler, self.host)  # the cores of one machine
        self.cores = cluster.one_machine or len(self.sharing)
        self.free, self.arrived, self.simulated = cluster.workers, deque[int](), 0.0
        self.missing, self.left = [0] * load.evolutions, [load.generations] * load.evolutions
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()

    def go(self) -> float:
        """When the last event was."""
        for evolution in range(self.load.evolutions):
            self._after(0.0, partial(self.ask, evolution))
        while self._events:
            self.now, _, event = heapq.heappop(self._events)
            event()
        return self.now

    def _after(self, seconds: float, event: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self.now + seconds, next(self._order), event))

    def _have(self, server: Server, seconds: float, event: Callable[[], None], *, first: bool = False) -> None:
        """Has `event` follow when `server` has worked `seconds` on it; `first`: before all that waits."""
        (server.waiting.appendleft if first else server.waiting.append)((next(self._order), seconds, event))
        self._serve(server)

    def _serve(self, server: Server) -> None:
        if server.working or not server.waiting or (server in self.sharing and not self.cores):
            return
        _, seconds, event = server.waiting.popleft()
        server.working, server.busy = True, server.busy + seconds
        self.cores -= server in self.sharing
        self._after(seconds, partial(self._served, server, event))

    def _served(self, server: Server, event: Callable[[], None]) -> None:
        server.working = False
        self.cores += server in self.sharing
        event()
        if server in self.sharing:  # a core is free: for whom has waited longest
            for other in sorted(self.sharing, key=lambda s: s.waiting[0][0] if s.waiting else 0):
                self._serve(other)
        self._serve(server)

    def _cost(self, who: str, size: float) -> float:
        """[s] of half a shard's way, with `size` bytes."""
        return getattr(self.cluster, f"{who}_task") / 2 + size * getattr(self.cluster, f"{who}_byte")

    def ask(self, evolution: int) -> None:
        self.left[evolution] -= 1
        self.missing[evolution] = self.load.shards
        self._have(self.coordinator, self.load.optimizer, partial(self.submit, evolution, self.load.shards))

    def submit(self, evolution: int, shards: int) -> None:
        """One shard after the other, before anything else."""
        if shards < self.load.shards:
            cost = self._cost("scheduler", self.load.bytes_there)
            self._have(self.scheduler, cost, partial(self.send, evolution))
        if shards:
            cost = self._cost("coordinator", self.load.bytes_there)
            self._have(self.coordinator, cost, partial(self.submit, evolution, shards - 1), first=True)

    def send(self, evolution: int) -> None:
        self._have(self.there, self.load.bytes_there / self.cluster.network, partial(self.wait, self.arrive, evolution))

    def wait(self, event: Callable[[int], None], evolution: int) -> None:
        self._after(self.cluster.latency / 2, partial(event, evolution))

    def arrive(self, evolution: int) -> None:
        self.arrived.append(evolution)
        self.start()

    def start(self) -> None:
        if not (self.free and self.arrived):
            return
        self.free -= 1
        around = self._cost("worker", self.load.bytes_there) + self._cost("worker", self.load.bytes_back)
        simulation = partial(self.run, self.now, self.arrived.popleft())
        if self.cluster.one_machine:
            self._have(self.host, around, simulation)
        else:
            self._after(around, simulation)

    def run(self, since: float, evolution: int) -> None:
        self._after(self.load.seconds, partial(self.end, since, evolution))

    def end(self, since: float, evolution: int) -> None:
        self.free += 1
        self.simulated += self.now - since
        self._have(self.back, self.load.bytes_back / self.cluster.network, partial(self.wait, self.finish, evolution))
        self.start()

    def finish(self, evolution: int) -> None:
        self._have(self.scheduler, self._cost("scheduler", self.load.bytes_back), partial(self.take, evolution))

    def take(self, evolution: int) -> None:
        self._have(self.coordinator, self._cost("coordinator", self.load.bytes_back), partial(self.tell, evolution))

    def tell(self, evolution: int) -> None:
        self.missing[evolution] -= 1
        if not self.missing[evolution] and self.left[evolution]:
            self.ask(evolution)


def simulate(cluster: Cluster, load: Load) -> Outcome:
    """The `Outcome` of a `load` on a `cluster`."""
    run = _Run(cluster, load)
    seconds = run.go()
    busy: dict[str, Any] = {
        "workers": run.simulated / cluster.workers,
        "coordinator": run.coordinator.busy,
        "scheduler": run.scheduler.busy,
        "network": max(run.there.busy, run.back.busy),
    }
    return Outcome(seconds=seconds, **{who: time / seconds for who, time in busy.items()})
