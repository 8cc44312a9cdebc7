"""The plan: cores, schedulers and bytes for a number of evaluations a day, from measured figures and the model.

Measured are the engine, the optimizers, the bytes of what travels, and the CPU time of a shard at scheduler,
coordinator and worker. Assumed are the network and the room left free; modelled is what comes of them together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from cluster_model import Cluster, Load, simulate
from scale_page import DAY, Row, find, read_rows
from scipy.optimize import nnls

STEPS = 1800  # of an evaluation
NETWORK = 1.25e9  # [byte/s], 10 Gbit/s each way
WORKERS_BUSY = 0.9  # what a worker is planned for
SERVERS_BUSY = 0.8  # and scheduler, coordinator and network
PIECE = 20.0  # [s] of a whole run, before its state comes back
POPULATION, SMALL_POPULATION = 1000, 21
TARGETS = {1e9: ("small", "medium", "large"), 1e10: ("small",), 1e11: ("small",)}
CORES = (1, 4, 16, 64, 256, 1024, 4096)


class Way(msgspec.Struct, frozen=True, kw_only=True):
    """How evolutions are spread over a cluster: what a task is."""

    name: str
    evaluations: float  # of a task
    seconds: float  # [s] on a worker
    shards: int  # tasks of a generation
    bytes_there: float
    bytes_back: float
    optimizer: float = 0.0  # [s] of the coordinator, a generation


def ways(body: str, results: Path) -> list[Way]:
    """The ways to spread evolutions of `body`, fed by what was measured."""
    engine, travel = read_rows(results / "scale-engine.csv"), read_rows(results / "scale-travel.csv")
    rates = {row["agents"]: row["rate"] / STEPS for row in engine if row["body"] == body}  # evaluations/s of a core
    parameters = find(engine, body=body)["parameters"]

    def generation(strategy: str, population: int) -> float:
        rows = read_rows(results / "scale-optimizer.csv")
        return find(rows, strategy=strategy, parameters=parameters, population=population)["seconds"]

    back = find(travel, body=body, what="their final positions, steps, solved")["bytes"] / 256  # of an agent
    state = find(travel, body=body, what="a run's state, cma-es")["bytes"]
    cma, openai = generation("cma-es", POPULATION), generation("openai-es", POPULATION)
    run = SMALL_POPULATION / rates[SMALL_POPULATION] + generation("cma-es", SMALL_POPULATION)  # [s] of a generation
    quarter = POPULATION / 4
    return [
        Way(
            name="shards of 250",
            evaluations=quarter,
            seconds=quarter / rates[256],
            shards=4,
            bytes_there=4 * quarter * parameters,
            bytes_back=back * quarter,
            optimizer=cma,
        ),
        Way(
            name="generations of 1000",
            evaluations=POPULATION,
            seconds=POPULATION / rates[POPULATION],
            shards=1,
            bytes_there=4 * POPULATION * parameters,
            bytes_back=back * POPULATION,
            optimizer=cma,
        ),
        Way(
            name="generations of 1000, as seeds",
            evaluations=POPULATION,
            seconds=POPULATION / rates[POPULATION] + openai,  # the worker draws theta: at most what ask and tell take
            shards=1,
            bytes_there=4 * parameters + 8 * POPULATION,
            bytes_back=back * POPULATION,
            optimizer=openai,
        ),
        Way(
            name="whole runs",
            evaluations=SMALL_POPULATION * PIECE / run,
            seconds=PIECE,
            shards=1,
            bytes_there=state,
            bytes_back=state,
        ),
    ]


def costs(rows: list[Row], together: int = 1) -> dict[str, float]:
    """What a shard and a byte cost each process [s], and the latency [s], of which `Cluster` is made; `together`: the
    workers that share a process."""
    found, working = {}, 0.0
    for who in ("coordinator", "scheduler", "worker"):
        task, byte, idle, worker = fit(rows, who)
        # a process that is busy with itself for a part of its time takes longer for everything else
        slower = 1 / (1 - min(idle + worker * together, 0.95))
        found |= {f"{who}_task": task * slower, f"{who}_byte": byte * slower}
        working += task
    empty = find(rows, seconds=0.0)  # one shard at a time, without work
    return {**found, "latency": max(empty["wall"] / empty["tasks"] - working, 0.0)}


def fit(rows: list[Row], who: str) -> tuple[float, float, float, float]:
    """CPU time of a process for a shard [s] and for a byte [s], and the part of its time [1] that it is busy with
    itself, and with each worker in it: least squares of the relative errors over all rows of the real scheduler, none
    negative."""
    seconds = np.array([row[who] for row in rows])
    size = np.array([row["bytes_there"] + row["bytes_back"] for row in rows])
    wall = np.array([row["wall"] / row["tasks"] for row in rows])
    inside = np.array([row["workers"] if who == "worker" else 0 for row in rows])
    terms = np.stack([np.ones_like(size), size / 1e6, wall, wall * inside], axis=1) / seconds[:, None]
    (task, megabyte, idle, worker), _ = nnls(terms, np.ones_like(seconds))
    return float(task), float(megabyte) / 1e6, float(idle), float(worker)


def predict(rows: list[Row]) -> list[float]:
    """Wall time [s] that the model expects of each row of the real scheduler, from CPU times alone."""
    found = []
    for row in rows:
        numbers = {name: row[name] for name in Load.__struct_fields__}
        for name in ("evolutions", "generations", "shards"):
            numbers[name] = int(numbers[name])
        workers = int(row["workers"])
        cluster = Cluster(workers=workers, **costs(rows, workers), one_machine=int(row["cores"]))
        found.append(simulate(cluster, Load(**numbers)).seconds)
    return found


def evaluations(way: Way, workers: int, cost: dict[str, float]) -> float:
    """Evaluations/s of one coordinator and scheduler with `workers` workers, as modelled: two tasks in flight each,
    and two evolutions more for the optimizer."""
    evolutions = math.ceil(2 * workers / way.shards) + 2
    load = Load(
        evolutions=evolutions,
        generations=max(8, math.ceil(2000 / (evolutions * way.shards))),
        shards=way.shards,
        seconds=way.seconds,
        bytes_there=way.bytes_there,
        bytes_back=way.bytes_back,
        optimizer=way.optimizer,
    )
    return load.tasks * way.evaluations / simulate(Cluster(workers=workers, network=NETWORK, **cost), load).seconds


def plan(size: Any, out: Path) -> Iterator[Row]:
    """Cores and schedulers for each target, body and way; and whether the model reaches the target with them."""
    cost = costs(read_rows(out / "scale-scheduler.csv"))
    for target, bodies in TARGETS.items():
        for body in [body for body in bodies if body in size.bodies]:
            for way in ways(body, out):
                yield {"body": body, "target": target, "way": way.name, **needs(way, target / DAY, cost)}


def needs(way: Way, rate: float, cost: dict[str, float]) -> Row:
    """What `rate` evaluations/s take: arithmetic; and the model's answer to it."""
    tasks = rate / way.evaluations  # a second
    both = way.bytes_there + way.bytes_back
    spent = {who: cost[f"{who}_task"] + both * cost[f"{who}_byte"] for who in ("coordinator", "scheduler", "worker")}
    busy = {
        "scheduler": tasks * spent["scheduler"],
        "optimizer": tasks / way.shards * way.optimizer,
        "coordinator": tasks * spent["coordinator"],
        "network": tasks * max(way.bytes_there, way.bytes_back) / NETWORK,
    }
    # optimizer and coordinator are one process
    schedulers = max(busy["scheduler"], busy["optimizer"] + busy["coordinator"], busy["network"]) / SERVERS_BUSY
    schedulers = max(math.ceil(schedulers), 1)
    cores = math.ceil(tasks * (way.seconds + spent["worker"]) / WORKERS_BUSY)
    limit = max(busy, key=lambda who: busy[who])
    return {
        "cores_needed": cores,
        "tasks_a_second": tasks,
        "bytes_a_second": tasks * way.bytes_there,
        "schedulers": schedulers,
        "limit": limit,
        "share": busy[limit] / schedulers,
        "reached": evaluations(way, math.ceil(cores / schedulers), cost) * schedulers / rate,
    }


def curves(size: Any, out: Path) -> Iterator[Row]:
    """Evaluations/s of one coordinator and scheduler against cores, small bodies, as modelled."""
    cost = costs(read_rows(out / "scale-scheduler.csv"))
    engine = read_rows(out / "scale-engine.csv")
    best = max(row["rate"] for row in engine if row["body"] == "small") / STEPS
    for way in ways("small", out):
        for cores in CORES:
            yield {
                "way": way.name,
                "cores": cores,
                "evaluations": evaluations(way, cores, cost),
                "ideal": cores * best,
            }
