"""The benchmarks' page: every number on it comes from the rows of one run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from turgor.bench.figures import draw_evolution, draw_scaling
from turgor.bench.measuring import MILLION
from turgor.bench.report import PEERS, Record, Row, ratio_name, rows_of
from turgor.experiments.rows import markdown_table
from turgor.files import write_whole, writing

SCALING, EVOLUTION = "benchmarks-scaling.png", "benchmarks-evolution.png"  # in FOLDER/images

HEAD = """# Benchmarks: how fast is it?

One command measures everything on this page, on any machine, and makes the page as well:

```sh
./run turgor bench --csv benchmarks/results --page docs                 # measure, and write this page
./run turgor bench --from benchmarks/results/{machine}.csv --page docs  # this page from rows that were kept
```

A rate counts **agent-steps**: one step of one agent, 1/60 s of its life, sensing and control included. What is
compared is measured in turn in the same run, and the fastest of several repeats counts, because other work on a
machine only ever slows things down. Compare ratios rather than rates between two machines.
[benchmarks/README.md](../benchmarks/README.md) tells what every row is; the rows behind this page are in
[benchmarks/results](../benchmarks/results).
"""

KERNEL = """## The kernel

Whole rollouts of 1800 steps on one thread, in million agent-steps/s. The cost of a step depends on how often masses
touch the ground and each other: *inflated* agents keep their gas; about half of the *random* ones let it go and lie
crumpled, mass on mass; *evolved* ones are a population after a short evolution. A block of the engine is 16 agents,
one in each lane of a vector: an agent alone pays for the whole block.
"""

CURVES = f"""## How it scales

![Speed over the batch and the threads, cost over masses and segments](images/{SCALING})

Rollouts of inflated agents. **a** Speed grows with the batch until 16 lanes are full, and falls for a moment just
beyond: 20 agents take two blocks. **b** Rings of more masses, half a metre of radius for each mass, on a plane, from
where they have come to lie. *Inflated* ones have the small body's pressure; *passive* ones have no controller, so
that the physics alone is left. The linear controller has as many weights as the square of the masses, which is what
bends the curve. **c** The terrain is cut into columns, and a mass looks at the segments of its own alone: a step must
not cost more on a long terrain. The agents are spread from one end to the other. **d** Threads share nothing but the
tables.
"""

COLLAPSED = """\
Self-collision is expensive where masses lie on each other, in a *collapsed* body without gas. turgor has no switch
that turns collisions between masses off; *points* comes close to one: the same body with masses of 1 cm, as heavy as
before, which hardly ever meet each other, but lie on the ground as before. The difference of the two columns is about
what self-collision costs.
"""

STEPPING = """## Environments

`gymnasium.make_vec` beside the same agents in one rollout: small differences apart, they do the same steps, but each
step of the environments hands observations and rewards to Python and takes actions from it. Their actions are those
that the agents' controllers gave in an episode before, so that no policy is measured. All environments share one
terrain; [environments.md](environments.md#speed) has what new terrains cost, and sampling.
"""

WHOLE = f"""## Whole evolutions

![Where the time of an evolution goes](images/{EVOLUTION})

`turgor.evolve` on hills with its default population, as a process of its own, engine in the cache, no video. Disk is
what the run's files take. Python is all else: its start, imports, loading the engine, the loop. Best is the
champion's fitness, robust the median of its starts that are moved by a millionth of a metre.
"""

START = """## Start and memory

Whole processes, from their start to their end.
"""

BESIDE = """## Peers

The same agent in another engine, one agent after the other on one core: what one would write in Python without
turgor. It is programmed with care (everything that does not change is laid out once, one product of NumPy for the
controller), but more than half of its time is Python's: a program in C++ on the same engine would be faster.

* **Box2D 2.3** (`pybox2d`): comparable in everything. The same body, scene, sensing, controller and solver; it moves
  as turgor does until chaos sets in.
* **Box2D v3** (`pyb2d3`): the same body, scene, sensing and controller, in steps of the same length; its solver is
  another one, with softer contacts, so that an agent moves otherwise, and has other contacts to solve.
"""

VOXELS = """## EvoGym

Not the same agent, but the nearest one in another simulator of soft robots that are evolved. EvoGym is for Python
3.7 to 3.10, so that it runs in a process of its own, which takes turns with the engine, on one core.

* **Comparable**: the number of masses. Beside the large body (20 masses, 20 springs) stands a robot of 4 x 3 voxels,
  with masses at their corners and springs on edges and diagonals (20 and 55), beside the small one (10 and 10) a
  robot of 4 x 1 (10 and 21). Both have a linear controller with a tanh, of the mean of the last 25 observations,
  with random weights. Every voxel is an actuator (12 and 4 outputs instead of 21 and 11). turgor's agents are the
  inflated ones, which keep their shape as voxels do.
* **Not comparable**: all else. Voxels hold no gas, and touch is not observed. EvoGym's contacts are stiff forces and
  its springs are integrated in steps so short that they stay stable, while turgor solves for impulses as Box2D does.
  So a step of EvoGym is 30 Runge-Kutta steps of 0.0001 s, with forces computed four times in each.
* **Time** has another unit, so that steps are not the same thing. EvoGym's step is 0.003 s, but at a gravity of 110 and
  with voxels of 0.1; [its authors](https://github.com/EvolutionGym/evogym/issues/49) give the numbers no units. What
  both have is the time in which a mass falls as far as its neighbour is away, 0.043 s there and 0.79 s here. One of
  EvoGym's steps is 3.3 times as much of it as one of turgor's: the last two columns.
* **Worlds**: *plane* is the ground within EvoGym's physics, which costs it next to nothing. *Walker-v0* is that of its
  walking task, 100 fixed voxels, whose masses and springs it simulates as it does the robot's. turgor's agents are on
  hills.

EvoGym's simulator is called directly, without Gymnasium, and nothing is drawn. *In its C++* is the part of the time
that calls of its step take: what no better program around it could save.
"""


def write_page(folder: Path, record: Record) -> Path:
    """Path of FOLDER/benchmarks.md, with its figures in FOLDER/images."""
    with writing(folder):
        (folder / "images").mkdir(parents=True, exist_ok=True)
    if rows_of(record.rows, "scaling.batch"):
        draw_scaling(record.rows, folder / "images" / SCALING)
    if rows_of(record.rows, "evolution.python"):
        draw_evolution(record.rows, folder / "images" / EVOLUTION)
    write_whole(folder / "benchmarks.md", page_text(record).encode())
    return folder / "benchmarks.md"


def page_text(record: Record) -> str:
    """The page as Markdown; parts that were not measured are left out."""
    rows = record.rows
    parts = [HEAD.format(machine=record.facts["machine"]), machine(record.facts)]
    parts += [part(rows) for part in (kernel, scaling, environments, evolutions, start, peers, voxels)]
    return "\n".join(part for part in parts if part)


def machine(facts: dict[str, str]) -> str:
    """What it was measured on."""
    versions = f"turgor {facts['turgor']}, Python {facts['python']}, Numba {facts['numba']}"
    load = f"; other programs kept {facts['other_load']} cores busy" if facts.get("other_load") else ""
    return f"Measured on {facts['cpu']}, {facts['date']}, {versions}{load}.\n"


def figures(value: float) -> str:
    """Three significant figures."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def one(rows: Sequence[Row], name: str, **wanted: object) -> str:
    """The figure of the row, nothing where there is none."""
    found = rows_of(rows, name, **wanted)
    return figures(found[0].value) if found else ""


# --- the parts --------------------------------------------------------------------------------------------------------


def kernel(rows: Sequence[Row]) -> str:
    rates = rows_of(rows, "kernel", threads=1)
    if not rates:
        return ""
    batches = sorted({row.batch or 0 for row in rates})
    heads = ["body", "task", "controllers", *(f"{batch:,} at once" for batch in batches), "the last on 2 threads"]
    lines = []
    for body, task, kind in dict.fromkeys((row.body, row.task, row.controllers) for row in rates):
        mine = {"body": body, "task": task, "controllers": kind}
        cells = [one(rates, "kernel", **mine, batch=batch) for batch in batches]
        factor = one(rows, "kernel.scaling", **mine, threads=2)
        lines.append([body, task, kind, *cells, f"{factor} times" if factor else ""])
    return f"{KERNEL}\n{markdown_table(heads, lines)}"


def scaling(rows: Sequence[Row]) -> str:
    if not rows_of(rows, "scaling.batch"):
        return ""
    tables = [batch_table(rows), COLLAPSED, mass_table(rows), segment_table(rows), thread_table(rows)]
    return "\n".join([CURVES, *tables])


def batch_table(rows: Sequence[Row]) -> str:
    mine = rows_of(rows, "scaling.batch")
    columns = list(dict.fromkeys((row.body, row.threads) for row in mine))
    heads = ["agents at once", *(f"{body}, {t} thread{'s' * (t != 1)}" for body, t in columns)]
    lines = [
        [f"{batch:,}", *(one(mine, "scaling.batch", body=body, threads=t, batch=batch) for body, t in columns)]
        for batch in dict.fromkeys(row.batch for row in mine)
    ]
    return f"Million agent-steps/s:\n\n{markdown_table(heads, lines)}"


def mass_table(rows: Sequence[Row]) -> str:
    mine = rows_of(rows, "scaling.masses")
    shapes = list(dict.fromkeys(row.controllers for row in mine))
    lines = []
    for size in dict.fromkeys(row.size for row in mine):
        costs = [1 / rows_of(mine, "scaling.masses", size=size, controllers=shape)[0].value for shape in shapes]
        lines.append([str(size), *map(figures, costs)])
    return f"Microseconds per agent-step, one thread:\n\n{markdown_table(['masses', *shapes], lines)}"


def segment_table(rows: Sequence[Row]) -> str:
    mine = rows_of(rows, "scaling.segments")
    (growth,) = rows_of(rows, "scaling.segments.growth")
    told = f"On {growth.size:,} segments a step costs {growth.value:.2f} times what it costs on {mine[0].size}:"
    lines = [[f"{row.size:,}", figures(row.value), figures(1 / row.value)] for row in mine]
    heads = ["segments", "million agent-steps/s", "µs per agent-step"]
    return f"{told}\n\n{markdown_table(heads, lines)}"


def thread_table(rows: Sequence[Row]) -> str:
    mine = rows_of(rows, "scaling.threads")
    lines = []
    for row in mine:
        (alone,) = rows_of(mine, "scaling.threads", body=row.body, threads=1)
        lines.append([row.body, str(row.threads), figures(row.value), f"{row.value / alone.value:.2f}"])
    return markdown_table(["body", "threads", "million agent-steps/s", "times one thread"], lines)


def environments(rows: Sequence[Row]) -> str:
    mine = rows_of(rows, "environment")
    if not mine:
        return ""
    lines = []
    for row in mine:
        same = {"body": row.body, "batch": row.batch, "threads": row.threads}
        rolled, times = one(rows, "environment.rollout", **same), one(rows, "environment.overhead", **same)
        lines.append([row.body, f"{row.batch:,}", str(row.threads), figures(row.value), rolled, times])
    heads = ["body", "environments", "threads", "stepped [million agent-steps/s]", "rollout", "stepping takes, times"]
    return f"{STEPPING}\n{markdown_table(heads, lines)}"


def evolutions(rows: Sequence[Row]) -> str:
    mine = rows_of(rows, "evolution.wall")
    if not rows_of(rows, "evolution.python"):
        return ""
    names = ("wall", "simulation", "strategy", "disk", "python", "best", "robust")
    heads = ["body", "evaluations", "whole [s]", "simulation", "CMA-ES", "disk", "Python", "best [m/s]", "robust [m/s]"]
    lines = [
        [row.body, row.what.split()[0], *(one(rows, f"evolution.{name}", body=row.body) for name in names)]
        for row in mine
    ]
    return f"{WHOLE}\n{markdown_table(heads, lines)}"


def start(rows: Sequence[Row]) -> str:
    mine = [row for row in rows if row.name.startswith(("startup.", "memory."))]
    if not mine:
        return ""
    lines = [[told(row), f"{figures(row.value)} {row.unit}"] for row in mine]
    return f"{START}\n{markdown_table(['', ''], lines)}"


def told(row: Row) -> str:
    """What a row is a figure of."""
    return f"{row.what} ({row.body}, {row.batch:,} at once)" if row.batch else row.what


def peers(rows: Sequence[Row]) -> str:
    names = {name: says for name, says in PEERS.items() if rows_of(rows, f"peer.{name}")}
    if not names:
        return ""
    heads = ["body", "controllers", *names.values(), "turgor, one at a time", "turgor, all at once"]
    heads += [f"against {says}" for says in names.values()]
    lines = []
    for row in rows_of(rows, "peer.box2d"):
        same = {"body": row.body, "controllers": row.controllers}
        few, many = sorted(rows_of(rows, "peer.engine", **same), key=lambda found: found.batch or 0)
        cells = [one(rows, f"peer.{name}", **same) for name in names]
        ratios = [one(rows, ratio_name(name), **same, batch=many.batch) for name in names]
        lines.append([row.body, row.controllers, *cells, figures(few.value), figures(many.value)])
        lines[-1] += [f"{ratio} times" for ratio in ratios]
    return f"{BESIDE}\nMillion agent-steps/s on one core:\n\n{markdown_table(heads, lines)}"


def voxels(rows: Sequence[Row]) -> str:
    """EvoGym's robots beside the engine."""
    lines = []
    for row in rows_of(rows, "peer.evogym"):
        same = {"body": row.body, "task": row.task}
        few, many = sorted({each.batch or 0 for each in rows_of(rows, "peer.ratio.evogym", **same)})
        told = [one(rows, "peer.evogym.life", **same), f"{one(rows, 'peer.evogym.simulator', **same)} %"]
        ratios = [
            one(rows, name, **same, batch=batch)
            for name in ("peer.ratio.evogym", "peer.ratio.evogym.life")
            for batch in (few, many)
        ]
        lines.append([row.body, row.task, figures(row.value * MILLION), *told, *(f"{ratio} times" for ratio in ratios)])
    heads = ["beside", "world", "agent-steps/s", "its own s/s", "in its C++"]
    heads += ["turgor, one at a time", "all at once", "the same in falls, one at a time", "all at once"]
    return f"{VOXELS}\n{markdown_table(heads, lines)}" if lines else ""
