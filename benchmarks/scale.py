"""Limits and a plan for scale: what a million agents cost, and what 10^9 evaluations a day take (docs/scale.md).

    ./run python benchmarks/scale.py                       # everything, about ten minutes on a quiet machine
    ./run python benchmarks/scale.py million optimizer     # some parts
    ./run python benchmarks/scale.py --quick --out /tmp    # a look, in a minute or two; not for a record

Each part prints its table and keeps its rows in OUT/scale-PART.csv (default: benchmarks/results). The tables and
figures of docs/scale.md are made anew from those files, unless OUT is another folder. `plan` and `curves` are a model,
fed by the others' rows.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import cluster_plan
import msgspec
import numpy as np
import scale_page
from real_scheduler import scheduler

from turgor.bench.measuring import Skipped, fastest, peak_memory
from turgor.bench.report import environment, machine_seconds, own_seconds
from turgor.evolution import STRATEGIES
from turgor.evolution.loop import evolve
from turgor.evolution.strategy import built_in
from turgor.simulate import Rollout, Simulator, available_cores
from turgor.task import make_task

HERE = Path(__file__).parent
Row = dict[str, Any]


class Size(msgspec.Struct, frozen=True, kw_only=True):
    """How much is measured; the defaults are the whole benchmark."""

    bodies: tuple[str, ...] = ("small", "medium", "large")
    steps: int = 1800  # of a rollout
    seconds: float = 0.5  # of measuring, at least, for every row
    shards: tuple[int, ...] = (21, 256, 1000)  # agents that a core gets at once
    million: int = 1_000_000
    chunk: int = 10_000
    growth: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    growth_steps: int = 20  # memory does not depend on them
    populations: tuple[int, ...] = (21, 1000, 10_000, 100_000)
    patience: float = 1.5  # [s] of generations of one strategy, about
    memory: float = 12e9  # [byte] that an optimizer may take, about
    cluster_workers: tuple[int, ...] = (4, 16, 64, 256)
    cluster_seconds: float = 2.0  # of every load of the scheduler, about


QUICK = Size(
    seconds=0.05,
    million=20_000,
    growth=(1000, 10_000, 20_000),
    populations=(21, 1000),
    patience=0.2,
    cluster_workers=(4, 16),
    cluster_seconds=0.5,
)


def draw(agents: int, parameters: int, seed: int = 0) -> np.ndarray:
    """Controllers, float32 [agent, parameter], uniform in [-1, 1]."""
    theta = np.random.default_rng(seed).random((agents, parameters), dtype=np.float32)
    theta *= 2  # in place: the memory of these processes is measured
    theta -= 1
    return theta


def in_a_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """What `function` returns in a fresh process, whose peak of memory is its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


# --- one machine ----------------------------------------------------------------------------------------------------


def engine(size: Size, out: Path) -> Iterator[Row]:
    """Agent-steps a second of each core while all cores work, against the agents that a core gets at once."""
    cores = available_cores()
    for body in size.bodies:
        task = make_task("hilly", body=body, steps=size.steps)
        simulator = Simulator(task)
        for agents in size.shards:
            theta = draw(agents * cores, task.parameter_count)
            steps = int(simulator.rollout(theta).steps.sum())
            (took,) = fastest([partial(simulator.rollout, theta)], size.seconds, 3)
            yield {
                "body": body,
                "parameters": task.parameter_count,
                "agents": agents,
                "rate": steps / took / cores,
                "seconds": took,
                "cores": cores,
            }


def million(size: Size, out: Path) -> Iterator[Row]:
    """Time and memory of very many small agents: in one call, and streamed."""
    task = make_task("hilly", steps=1)
    Simulator(task).rollout(draw(1, task.parameter_count))  # compiles the engine, once
    for way in ("one call, float64", "one call, float32", "streamed, float32"):
        for agents in size.growth:
            yield in_a_process(many, way, agents, size.growth_steps, size.chunk)
    yield in_a_process(many, "streamed, float32", size.million, size.steps, size.chunk)


def many(way: str, agents: int, steps: int, chunk: int) -> Row:
    """The row of one process that simulates `agents` agents."""
    task = make_task("hilly", steps=steps)
    simulator = Simulator(task)
    simulator.rollout(draw(1, task.parameter_count))
    before, began = peak_memory(), time.perf_counter()
    if way.startswith("one call"):
        theta = draw(agents, task.parameter_count) if way.endswith("32") else np.empty((agents, task.parameter_count))
        if way.endswith("64"):
            for k in range(0, agents, chunk):
                theta[k : k + chunk] = draw(min(chunk, agents - k), task.parameter_count, k)
        out = simulator.rollout(theta)
        given, kept, taken = theta.nbytes, size_of(out), int(out.steps.sum())
    else:
        chunks = (draw(min(chunk, agents - k), task.parameter_count, k) for k in range(0, agents, chunk))
        given, kept, taken = 4 * task.parameter_count * min(chunk, agents), 0, 0
        for out in simulator.rollouts(chunks):
            kept, taken = max(kept, size_of(out)), taken + int(out.steps.sum())
    took = time.perf_counter() - began
    return {
        "way": way,
        "agents": agents,
        "steps": steps,
        "seconds": took,
        "rate": taken / took,
        "threads": simulator.threads,
        "peak": peak_memory(),
        "empty": before,
        "theta": given,
        "results": kept,
    }


def size_of(out: Rollout) -> int:
    """Bytes of all fields."""
    return sum(getattr(out, field).nbytes for field in out.__struct_fields__)


def optimizer(size: Size, out: Path) -> Iterator[Row]:
    """What a generation costs whoever asks and tells, one thread."""
    parameters = {make_task("hilly", body=body).parameter_count for body in size.bodies}
    for name in STRATEGIES:
        for count in sorted(parameters):
            for population in size.populations:
                even = population + (population % 2 if name == "openai-es" else 0)
                if 10 * 8 * count * even > size.memory or (count == 784 and population > 1000):
                    continue
                try:
                    yield in_a_process(ask_and_tell, name, count, even, size.patience)
                except BrokenProcessPool:
                    say(f"optimizer: {name}, population {even}, {count} parameters: out of memory")


def ask_and_tell(name: str, parameters: int, population: int, patience: float) -> Row:
    """The row of one strategy. The fitness is one parameter's distance from 0."""
    rng = np.random.default_rng(0)
    first = built_in(name)(10, rng)
    first.tell(first.ask(), np.zeros(first.population))  # loads what it needs
    strategy = built_in(name)(parameters, rng, population=population)
    before, spent, generations = peak_memory(), 0.0, 0
    warm = 20 if population < 100 else 1
    for generation in range(150):
        began = time.perf_counter()
        theta = strategy.ask()
        fitness = -np.abs(theta[:, 0])
        strategy.tell(theta, fitness)
        took = time.perf_counter() - began
        if generation >= warm or took > patience:  # a mean: CMA-ES decomposes its covariance in some generations only
            spent, generations = spent + took, generations + 1
        if spent > patience:
            break
    return {
        "strategy": name,
        "parameters": parameters,
        "population": population,
        "seconds": spent / generations,
        "generations": generations,
        "memory": peak_memory() - before,
    }


def travel(size: Size, out: Path) -> Iterator[Row]:
    """Bytes that travel, and the time that Dask's protocol takes for them."""
    for body in size.bodies:
        task = make_task("hilly", body=body, steps=1)
        theta = draw(256, task.parameter_count).astype(np.float64)
        rollout = Simulator(task).rollout(theta)
        seeds = {"mean": theta[0].astype(np.float32), "seed": np.arange(256)}
        yield packed(body, "256 agents, theta in float64", theta)
        yield packed(body, "256 agents, theta in float32", theta.astype(np.float32))
        yield packed(body, "256 agents, seeds and a mean", seeds)
        yield packed(body, "their final positions, steps, solved", (rollout.position, rollout.steps, rollout.solved))
        yield packed(body, "their fitness", rollout.fitness)
        yield packed(body, "their whole `Rollout`", msgspec.structs.asdict(rollout))
        for name in STRATEGIES:
            strategy = built_in(name)(task.parameter_count, np.random.default_rng(0))
            yield packed(body, f"a run's state, {name}", strategy.state())
        with tempfile.TemporaryDirectory() as folder:
            evolve(make_task("hilly", body=body, steps=size.steps), 420, out=Path(folder) / "run", robust_repeats=1)
            files = {file.name: file.read_bytes() for file in (Path(folder) / "run").iterdir() if file.is_file()}
        yield packed(body, "a whole run's files, cma-es", files)


def packed(body: str, what: str, content: Any) -> Row:
    """The row of what Dask would send."""
    from distributed.protocol import dumps, loads, to_serialize

    message = {"content": to_serialize(content)}
    frames = dumps(message)
    took = fastest([lambda: dumps(message), lambda: loads(frames)], 0.02, 5)
    size = sum(memoryview(frame).nbytes for frame in frames)
    return {"body": body, "what": what, "bytes": size, "dumps": took[0], "loads": took[1]}


# --- the command ----------------------------------------------------------------------------------------------------

PARTS: dict[str, Callable[[Size, Path], Iterator[Row]]] = {
    "million": million,
    "engine": engine,
    "optimizer": optimizer,
    "travel": travel,
    "scheduler": scheduler,
    "plan": cluster_plan.plan,
    "curves": cluster_plan.curves,
}


def say(line: str) -> None:
    print(f"scale: {line}", file=sys.stderr, flush=True)


def measure(name: str, size: Size, out: Path) -> list[Row]:
    """The rows of a part, which are kept in `out` with the machine they were measured on."""
    here, began, busy, own = environment(), time.perf_counter(), machine_seconds(), own_seconds()
    rows = []
    for row in PARTS[name](size, out):
        rows.append(row)
        say(f"{name}: " + ", ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                                    for key, value in row.items()))  # fmt: skip
    took = time.perf_counter() - began
    if busy is not None:
        other = (machine_seconds() or 0) - busy - (own_seconds() - own)
        here["other_load"] = f"{max(other / took, 0):.2f}"
    scale_page.write_rows(out / f"scale-{name}.csv", [{**here, **row} for row in rows])
    say(f"{name}: {took:.0f} s")
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)} (default: all)")
    parser.add_argument("--out", type=Path, default=HERE / "results", metavar="FOLDER", help="where the rows are kept")
    parser.add_argument("--agents", type=int, metavar="N", help="agents of the streamed rollout (default: 1,000,000)")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter; not for a record")
    options = parser.parse_args()
    unknown = [name for name in options.parts if name not in PARTS]
    if unknown:
        parser.error(f"expected parts out of {', '.join(PARTS)}; got {', '.join(unknown)}")
    size = QUICK if options.quick else Size()
    if options.agents:
        size = msgspec.structs.replace(size, million=options.agents)
    options.out.mkdir(parents=True, exist_ok=True)
    status = 0
    for name in PARTS:
        if name in (options.parts or PARTS):
            try:
                measure(name, size, options.out)
            except (Skipped, scale_page.Missing) as reason:
                say(f"{name}: skipped, because {reason}")
                status = 1
                continue
            print(scale_page.table(name, options.out), flush=True)
    if options.out.resolve() == (HERE / "results").resolve() and not status:
        scale_page.make_figure(options.out, scale_page.FIGURE)
        scale_page.make_page(options.out, scale_page.PAGE)
        say(f"wrote {scale_page.PAGE.relative_to(HERE.parent)}")
    return status


if __name__ == "__main__":
    sys.exit(main())
