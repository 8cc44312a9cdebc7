"""docs/scale.md from the rows of benchmarks/scale.py: its tables, the sentences with figures in them, its picture."""

from __future__ import annotations

import csv
import re
import statistics
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "scale.md"
FIGURE = ROOT / "docs" / "images" / "scale.png"
DAY = 86_400.0  # [s]
Row = dict[str, Any]


class Missing(Exception):
    """Rows of another part that have to be measured first."""


# --- rows -----------------------------------------------------------------------------------------------------------


def write_rows(file: Path, rows: list[Row]) -> None:
    with open(file, "w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()}
                         for row in rows)  # fmt: skip


def read_rows(file: Path) -> list[Row]:
    """The rows of a part, numbers as float. Raises `Missing`."""
    if not file.exists():
        raise Missing(f"{file.stem.removeprefix('scale-')} has to be measured first (no {file.name})")
    with open(file, encoding="utf-8", newline="") as stream:
        return [{key: number(value) for key, value in row.items()} for row in csv.DictReader(stream)]


def number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def find(rows: list[Row], **wanted: Any) -> Row:
    """The first row with these values. Raises `Missing`."""
    for row in rows:
        if all(row[key] == value for key, value in wanted.items()):
            return row
    raise Missing(f"no row with {wanted}")


# --- tables ---------------------------------------------------------------------------------------------------------


def count(value: float) -> str:
    return f"{value:,.0f}"


def figures(value: float) -> str:
    """Two significant figures at least."""
    if value == 0:
        return "0"
    if abs(value) >= 10:
        return f"{value:,.0f}"
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.1f}"


def megabytes(value: float) -> str:
    return figures(value / 1e6)


def milliseconds(value: float) -> str:
    return figures(1e3 * value)


def percent(value: float) -> str:
    return f"{100 * value:.0f} %"


# of each table: header, what a row shows there
TABLES: dict[str, list[tuple[str, Any]]] = {
    "million": [
        ("", lambda r: r["way"]),
        ("agents", lambda r: count(r["agents"])),
        ("steps", lambda r: count(r["steps"])),
        ("time, theta drawn on the way [s]", lambda r: figures(r["seconds"])),
        ("million agent-steps/s", lambda r: figures(r["rate"] / 1e6)),
        ("peak of the process [MB]", lambda r: count(r["peak"] / 1e6)),
        ("theta [MB]", lambda r: megabytes(r["theta"])),
        ("results [MB]", lambda r: megabytes(r["results"])),
        ("the rest [MB]", lambda r: count((r["peak"] - r["theta"] - r["results"]) / 1e6)),
    ],
    "engine": [
        ("body", lambda r: r["body"]),
        ("parameters", lambda r: count(r["parameters"])),
        ("agents at once on a core", lambda r: count(r["agents"])),
        ("million agent-steps/s a core", lambda r: figures(r["rate"] / 1e6)),
        ("of an agent [ms]", lambda r: milliseconds(1800 / r["rate"])),
    ],
    "optimizer": [
        ("strategy", lambda r: r["strategy"]),
        ("parameters", lambda r: count(r["parameters"])),
        ("population", lambda r: count(r["population"])),
        ("ask + tell [ms a generation]", lambda r: milliseconds(r["seconds"])),
        ("[µs an agent]", lambda r: figures(1e6 * r["seconds"] / r["population"])),
        ("memory [MB]", lambda r: megabytes(r["memory"])),
        ("cores it keeps at work", lambda r: figures(r["feeds"])),
    ],
    "travel": [
        ("body", lambda r: r["body"]),
        ("what", lambda r: r["what"]),
        ("kB", lambda r: figures(r["bytes"] / 1e3)),
        ("serialise [ms]", lambda r: milliseconds(r["dumps"])),
        ("deserialise [ms]", lambda r: milliseconds(r["loads"])),
    ],
    "scheduler": [
        ("workers", lambda r: count(r["workers"])),
        ("shards in flight", lambda r: count(r["evolutions"] * r["shards"])),
        ("a shard's simulation [ms]", lambda r: milliseconds(r["seconds"])),
        ("kB there", lambda r: figures(r["bytes_there"] / 1e3)),
        ("optimizer [ms]", lambda r: milliseconds(r["optimizer"])),
        ("CPU a shard: scheduler [ms]", lambda r: milliseconds(r["scheduler"])),
        ("coordinator", lambda r: milliseconds(r["coordinator"])),
        ("worker", lambda r: milliseconds(r["worker"])),
        ("shards/s", lambda r: count(r["tasks"] / r["wall"])),
        ("of what the workers could do", lambda r: percent(r["tasks"] * r["seconds"] / r["workers"] / r["wall"])),
        ("modelled / measured time", lambda r: f"{r['ratio']:.2f}" if r["seconds"] else "gives the latency"),
    ],
    "plan": [
        ("body", lambda r: r["body"]),
        ("a day", lambda r: power(r["target"])),
        ("way", lambda r: r["way"]),
        ("cores", lambda r: count(r["cores_needed"])),
        ("tasks/s", lambda r: figures(r["tasks_a_second"])),
        ("MB/s there", lambda r: figures(r["bytes_a_second"] / 1e6)),
        ("schedulers", lambda r: count(r["schedulers"])),
        ("its busiest part: cores apart", lambda r: f"{r['limit']}, {percent(r['share'])}"),
        ("modelled: of the target", lambda r: percent(r["reached"])),
    ],
}


def power(value: float) -> str:
    return f"10^{len(f'{value:.0f}') - 1}"


def rows_of(name: str, results: Path) -> list[Row]:
    """The rows of a table, with what follows from other parts' rows. Raises `Missing`."""
    rows = read_rows(results / f"scale-{name}.csv")
    if name == "optimizer":
        engine = read_rows(results / "scale-engine.csv")
        for row in rows:
            agents = max(each["agents"] for each in engine)
            rate = find(engine, parameters=row["parameters"], agents=agents)["rate"]
            row["feeds"] = 1800 / rate / (row["seconds"] / row["population"])
    if name == "scheduler":
        import cluster_plan

        for row, modelled in zip(rows, cluster_plan.predict(rows), strict=True):
            row["ratio"] = modelled / row["wall"]
    return rows


def table(name: str, results: Path) -> str:
    """A part as a Markdown table; nothing for one that has none."""
    if name not in TABLES:
        return ""
    columns, rows = TABLES[name], rows_of(name, results)
    lines = [" | ".join(header for header, _ in columns), " | ".join("---" for _ in columns)]
    lines += [" | ".join(show(row) for _, show in columns) for row in rows]
    return "\n".join(f"| {line} |" for line in lines)


# --- sentences ------------------------------------------------------------------------------------------------------


def machine(results: Path) -> str:
    """On what it was measured."""
    rows = [read_rows(results / f"scale-{name}.csv")[0] for name in TABLES]
    loads = [float(row["other_load"]) for row in rows if row["other_load"] != ""]
    dates = sorted({row["date"] for row in rows})
    busy = f"; other programs kept {max(loads):.2f} cores busy at most" if loads else ""
    return f"Measured on {rows[0]['cpu']}, {' and '.join(dates)}, turgor {rows[0]['turgor']}{busy}."


def million_summary(results: Path) -> str:
    rows = read_rows(results / "scale-million.csv")
    whole, growth = rows[-1], [row for row in rows[:-1] if row["way"].startswith("streamed")]
    least, most = min(r["peak"] for r in growth), max(r["peak"] for r in growth)
    return (
        f"{whole['agents']:,.0f} small agents, each for {whole['steps']:,.0f} steps on hills, take "
        f"{whole['seconds']:.0f} s on {whole['threads']:.0f} cores ({whole['rate'] / 1e6:.1f} million agent-steps/s) "
        f"and {whole['peak'] / 1e6:.0f} MB. Streamed, the peak is {least / 1e6:.0f} to {most / 1e6:.0f} MB from "
        f"{growth[0]['agents']:,.0f} agents to {growth[-1]['agents']:,.0f}."
    )


def optimizer_summary(results: Path) -> str:
    rows = rows_of("optimizer", results)
    told = []
    for name in dict.fromkeys(row["strategy"] for row in rows):
        feeds = [row["feeds"] for row in rows if row["strategy"] == name]
        told.append(f"{name} {figures(min(feeds))} to {figures(max(feeds))}")
    return f"One coordinator keeps so many cores at work: {', '.join(told)}."


def scheduler_summary(results: Path) -> str:
    import cluster_plan

    rows = rows_of("scheduler", results)
    cost = cluster_plan.costs(rows)
    ratios = [row["ratio"] for row in rows if row["seconds"]]
    fitted = {who: cluster_plan.fit(rows, who) for who in ("scheduler", "coordinator", "worker")}
    told = [
        f"{who} {milliseconds(task)} ms, {milliseconds(1e6 * byte)} ms a MB and {percent(idle)} of its time anyway"
        for who, (task, byte, idle, _) in fitted.items()
    ]
    return (
        f"Fitted to all rows, a shard costs {'; '.join(told)}. For {milliseconds(cost['latency'])} ms of a shard's way "
        f"nobody works. A scheduler with a core of its own and shards of few bytes is at its end at "
        f"{1 / cost['scheduler_task']:,.0f} shards/s; this machine, whose {rows[0]['cores']:.0f} cores do all of it, "
        f"reached {max(row['tasks'] / row['wall'] for row in rows):,.0f}. The model's time is "
        f"{min(ratios):.2f} to {max(ratios):.2f} of the measured, {statistics.median(ratios):.2f} in the median."
    )


def plan_summary(results: Path) -> str:
    rows = read_rows(results / "scale-plan.csv")
    first = [row for row in rows if row["target"] == 1e9]
    told = []
    for body in dict.fromkeys(row["body"] for row in first):
        cores = [row["cores_needed"] for row in first if row["body"] == body]
        told.append(f"{min(cores):.0f} to {max(cores):.0f} cores for {body} bodies")
    return (
        f"10^9 evaluations a day are {1e9 / DAY:,.0f} a second, or {1e9 / DAY * 1800 / 1e6:.1f} million agent-steps a "
        f"second: {', '.join(told)}, according to the way."
    )


SENTENCES = {
    "machine": machine,
    "million": million_summary,
    "optimizer": optimizer_summary,
    "scheduler": scheduler_summary,
    "plan": plan_summary,
}


# --- the page -------------------------------------------------------------------------------------------------------


def filled(text: str, results: Path) -> str:
    """`text` with what stands between its marks made anew."""
    for name in TABLES:
        text = between(text, f"table: {name}", table(name, results))
    for name, sentence in SENTENCES.items():
        text = between(text, f"text: {name}", sentence(results))
    return text


def between(text: str, mark: str, content: str) -> str:
    pattern = re.compile(rf"(<!-- {mark} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"expected a mark <!-- {mark} --> and <!-- end --> in the page")
    return pattern.sub(lambda match: f"{match[1]}{content}\n{match[2]}", text)


def make_page(results: Path, page: Path) -> None:
    page.write_text(filled(page.read_text(encoding="utf-8"), results), encoding="utf-8")


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # Okabe and Ito's: told apart by everyone
MARKERS = "os^D"


def make_figure(results: Path, file: Path) -> None:
    """Left: evaluations a day of one scheduler against cores, as modelled. Right: the optimizer beside simulation."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    draw_curves(left, read_rows(results / "scale-curves.csv"))
    draw_optimizers(right, read_rows(results / "scale-optimizer.csv"), read_rows(results / "scale-engine.csv"))
    for axes in (left, right):
        axes.set(xscale="log", yscale="log")
        axes.grid(color="#dddddd", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file)


def draw_curves(axes: Any, rows: list[Row]) -> None:
    ways = list(dict.fromkeys(row["way"] for row in rows))
    for way, colour, marker in zip(ways, COLOURS, MARKERS, strict=False):
        mine = [row for row in rows if row["way"] == way]
        x, y = [row["cores"] for row in mine], [row["evaluations"] * DAY for row in mine]
        hidden = way == ways[0]  # by the next one, where the scheduler is not the limit
        axes.plot(x, y, color=colour, marker=marker, markersize=8 if hidden else 4, linewidth=1.5, label=way)
    x = [row["cores"] for row in rows if row["way"] == ways[0]]
    y = [row["ideal"] * DAY for row in rows if row["way"] == ways[0]]
    axes.plot(x, y, ":", color="#555555", label="engine alone")
    axes.set(xlabel="cores", ylabel="evaluations a day")
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    axes.set_title("One coordinator, one scheduler, small bodies (modelled)", loc="left", fontsize=10)


def draw_optimizers(axes: Any, rows: list[Row], engine: list[Row]) -> None:
    parameters = min(row["parameters"] for row in rows)
    names = list(dict.fromkeys(row["strategy"] for row in rows))
    for name, colour, marker in zip(names, COLOURS, MARKERS, strict=False):
        mine = [row for row in rows if row["strategy"] == name and row["parameters"] == parameters]
        x, y = [row["population"] for row in mine], [1e6 * row["seconds"] / row["population"] for row in mine]
        axes.plot(x, y, color=colour, marker=marker, markersize=4, linewidth=1.5, label=name)
    rate = max(row["rate"] for row in engine if row["parameters"] == parameters)
    axes.axhline(1e6 * 1800 / rate, linestyle=":", color="#555555", label="simulating it on one core")
    axes.set(xscale="log", yscale="log")
    low, high = axes.get_ylim()
    axes.set(xlabel="population", ylabel="ask + tell [µs an agent]", ylim=(low / 4, high))  # room for the legend
    axes.legend(frameon=False, fontsize=8, loc="lower center", ncols=2)
    axes.set_title(f"What an agent costs the optimizer, {parameters:.0f} parameters", loc="left", fontsize=10)
