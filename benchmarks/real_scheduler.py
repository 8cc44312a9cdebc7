"""A real Dask scheduler with many workers on one machine: what does it take for a task?

The scheduler is a process, all workers are a second one, the client is this one. Workers do not simulate: they wait for
as long as a shard would take, and return as many bytes. What each process works for a task is its CPU time, which does
not depend on how many cores there are; the wall time of the whole does.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
from cluster_model import Load
from scale_page import find, read_rows

from turgor.bench.measuring import Skipped
from turgor.simulate import available_cores

REPEATS = 2  # of every load
HERE = str(Path(__file__).parent)  # where the scheduler finds `shard`


def scheduler(size: Any, out: Path) -> Iterator[dict[str, Any]]:
    """Rows: what a task costs, against workers, tasks in flight, agents of a shard and bytes."""
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise Skipped("it needs the extra cluster (distributed)") from None
    engine, travel = read_rows(out / "scale-engine.csv"), read_rows(out / "scale-travel.csv")
    for workers, loads in make_loads(size, engine, travel).items():
        for load, counted in asyncio.run(run_loads(workers, loads)):
            yield {
                "workers": workers,
                "cores": available_cores(),
                **{name: getattr(load, name) for name in load.__struct_fields__},
                "tasks": load.tasks,
                **counted,
            }


def make_loads(size: Any, engine: list[dict[str, Any]], travel: list[dict[str, Any]]) -> dict[int, list[Load]]:
    """The loads that each number of workers gets: shards of small bodies."""
    back = find(travel, body=size.bodies[0], what="their final positions, steps, solved")["bytes"] / 256
    one = find(engine, body=size.bodies[0], agents=256)
    agent, parameters = size.steps / one["rate"], int(one["parameters"])

    def load(evolutions: int, shards: int, agents: int = 256, number: int = 4, optimizer: float = 0.0) -> Load:
        """`number`: bytes of a parameter, 0 for seeds."""
        seconds = agents * agent
        there = agents * parameters * number if number else agents * 8 + parameters * 4
        # a look at what two cores can do at most, so that a row takes about as long as it should
        rate = min(workers / seconds, evolutions * shards / (seconds + optimizer), 300)
        return Load(
            evolutions=evolutions,
            generations=max(2, round(size.cluster_seconds * rate / (evolutions * shards))),
            shards=shards,
            seconds=seconds,
            bytes_there=there,
            bytes_back=agents * back,
            optimizer=optimizer,
        )

    found = {}
    middle = size.cluster_workers[len(size.cluster_workers) // 2]
    for workers in size.cluster_workers:
        found[workers] = [load(workers // 2, 4), load(workers // 2, 4, number=0)]
        if workers == middle:
            found[workers] += [
                load(workers // 4, 4),  # in flight: one for each worker
                load(2 * workers, 4),  # and eight
                load(workers // 2, 4, number=8),
                load(workers // 2, 4, agents=64),
                load(workers // 2, 4, agents=1024),
                load(2 * workers, 1),
            ]
    workers = size.cluster_workers[1]
    found[workers].append(Load(evolutions=1, generations=100, shards=1, seconds=0.0, bytes_there=8.0, bytes_back=8.0))
    found[workers] += [load(1, workers, optimizer=0.05), load(2, 2 * workers, optimizer=0.05)]
    return found


async def run_loads(workers: int, loads: list[Load]) -> list[tuple[Load, dict[str, float]]]:
    """What each of `loads` took on a cluster of its own, with `workers` workers."""
    from distributed import Client

    context = multiprocessing.get_context("spawn")
    end, found = context.Event(), []
    logging.getLogger("distributed").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
        command = [sys.executable, "-m", "distributed.cli.dask_scheduler", *options, "--scheduler-file", str(file)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")])}
        with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process:
            try:
                while not file.exists():
                    await asyncio.sleep(0.05)
                async with Client(scheduler_file=str(file), asynchronous=True) as client:
                    address = client.scheduler.address
                    host = context.Process(target=serve_workers, args=(address, workers, folder, end))
                    host.start()
                    try:
                        await client.wait_for_workers(workers)
                        await run_load(client, Load(evolutions=8, generations=4, shards=4, seconds=0.0))  # warms up
                        rounds = [[await run_load(client, load) for load in loads] for _ in range(REPEATS)]
                        # the fastest counts: other work on the machine only ever slows things down
                        fastest = [min(same, key=lambda each: each["wall"]) for same in zip(*rounds, strict=True)]
                        found = list(zip(loads, fastest, strict=True))
                    finally:
                        end.set()
                        host.join()
            finally:
                process.terminate()
    return found


def serve_workers(address: str, workers: int, folder: str, end: Event) -> None:
    """Runs `workers` workers in this process until `end`."""
    from distributed import Worker

    logging.getLogger("distributed").setLevel(logging.ERROR)

    async def serve() -> None:
        options: dict[str, Any] = {"nthreads": 1, "host": "127.0.0.1", "dashboard": False, "local_directory": folder}
        serving = [Worker(address, **options, name=k, memory_limit=0) for k in range(workers)]
        await asyncio.gather(*serving)
        while not end.is_set():
            await asyncio.sleep(0.2)
        await asyncio.gather(*(worker.close() for worker in serving))

    asyncio.run(serve())


async def shard(theta: np.ndarray, seconds: float, size: int) -> np.ndarray:
    """What a worker does in place of a simulation."""
    await asyncio.sleep(seconds)
    return np.zeros(size, dtype=np.uint8)


async def run_load(client: Any, load: Load) -> dict[str, float]:
    """Wall time [s], and CPU time of each process for a task [s]."""

    async def evolve() -> None:
        for _ in range(load.generations):
            time.sleep(load.optimizer)  # the coordinator does nothing else meanwhile
            parts = [np.zeros(int(load.bytes_there), dtype=np.uint8) for _ in range(load.shards)]
            size = int(load.bytes_back)
            await client.gather([client.submit(shard, part, load.seconds, size, pure=False) for part in parts])

    before, began = await cpu_seconds(client), time.perf_counter()
    await asyncio.gather(*(evolve() for _ in range(load.evolutions)))
    wall = time.perf_counter() - began
    spent = {who: now - before[who] for who, now in (await cpu_seconds(client)).items()}
    return {"wall": wall, **{who: seconds / load.tasks for who, seconds in spent.items()}}


async def cpu_seconds(client: Any) -> dict[str, float]:
    """CPU time of each process so far [s]."""
    first = next(iter(await client.run_on_scheduler(lambda dask_scheduler: list(dask_scheduler.workers))))
    return {
        "scheduler": await client.run_on_scheduler(time.process_time),
        "worker": (await client.run(time.process_time, workers=[first]))[first],
        "coordinator": time.process_time(),
    }
