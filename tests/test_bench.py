"""The benchmark runner on a tiny plan: its rows and files, not its figures; and the peer's agent against the engine."""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from turgor import bench
from turgor.bench import measuring, page, parts, peers, scaling
from turgor.bench.report import read_record, rows_of
from turgor.errors import InvalidInput
from turgor.simulate import Simulator, available_cores
from turgor.task import make_task

TINY = bench.Plan(
    bodies=("small",),
    tasks=("hilly", "escape"),
    batches=(1, 20),
    steps=20,
    seconds=0.0,
    repeats=1,
    generations=2,
    curve_bodies=("small",),
    curve_batches=(1, 20),
    curve_masses=(10, 30),
    curve_segments=(10, 100),
    curve_agents=3,
    curve_crowd=40,
    curve_steps=20,
    curve_seconds=0.0,
    environment_bodies=("small",),
    environments=(5,),
    memory_body="small",
    memory_agents=30,
    starts=1,
    evaluations=21,
    peer_bodies=("small",),
    peer_agents=1,
    peer_batch=20,
)
COLUMNS = [
    *("machine", "cpu", "date", "turgor", "python", "numba", "other_load"),
    *("name", "body", "task", "controllers", "batch", "threads", "size", "value", "unit", "what"),
]
RECORDS = Path(__file__).parents[1] / "benchmarks" / "results"
DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def peer() -> Any:
    try:
        return peers.load_peer()
    except bench.Skipped as reason:
        pytest.skip(str(reason))


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)


def test_kernel_has_a_row_for_every_combination() -> None:
    rows = list(parts.kernel(TINY))
    threads = [t for t in (1, 2) if t <= available_cores()]
    expected = [
        ("small", task, controllers, batch, t)
        for task in ("hilly", "escape")
        for controllers in ("random", "inflated", "evolved")
        for batch in (1, 20)
        for t in threads
    ]
    rates = [row for row in rows if row.name == "kernel"]
    assert [(r.body, r.task, r.controllers, r.batch, r.threads) for r in rates] == expected
    scaling = [row for row in rows if row.name == "kernel.scaling"]
    assert [(r.batch, r.threads) for r in scaling] == [(20, t) for _ in range(6) for t in threads[1:]]
    assert all(row.value > 0 and row.unit and row.what for row in rows)


@pytest.mark.parametrize("kind", ["random", "inflated", "evolved"])
def test_controllers_do_not_depend_on_the_batch(kind: str) -> None:
    task = measuring.make_task("hilly", "small", TINY.steps)
    many = measuring.controllers(kind, task, 50, TINY.generations)
    assert many.shape == (50, task.parameter_count)
    assert len(np.unique(many, axis=0)) == 50
    few = measuring.controllers(kind, task, 3, TINY.generations)
    np.testing.assert_array_equal(few, many[:3])
    measuring.evolved.cache_clear()
    np.testing.assert_array_equal(measuring.controllers(kind, task, 50, TINY.generations), many)


def test_memory_startup_and_evolution(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "FIRST_ROLLOUT", "pass")  # compiling takes long
    rows = {row.name: row for part in ("memory", "startup", "evolution") for row in bench.PARTS[part](TINY)}
    wanted = {"memory.peak", "startup.import", "startup.cold", "startup.warm", "evolution.wall", "evolution.robust"}
    assert wanted <= set(rows)
    assert 20 < rows["memory.peak"].value < 2000
    assert rows["memory.peak"].batch == 30
    shares = [rows[f"evolution.{part}"].value for part in ("simulation", "strategy", "disk", "python")]
    assert min(shares) > 0
    assert sum(shares) == pytest.approx(rows["evolution.wall"].value)


# --- scaling ----------------------------------------------------------------------------------------------------------


def test_scaling_has_a_row_for_every_point_of_its_curves() -> None:
    rows = list(scaling.scaling(TINY))
    threads = [t for t in (1, 2) if t <= available_cores()]
    points = [(row.batch, row.threads) for row in rows_of(rows, "scaling.batch")]
    assert points == [(batch, t) for batch in (1, 20) for t in threads]
    points = [(row.size, row.controllers) for row in rows_of(rows, "scaling.masses")]
    assert points == [(masses, shape) for masses in (10, 30) for shape in scaling.SHAPES]
    assert [row.size for row in rows_of(rows, "scaling.segments")] == [10, 100]
    (growth,) = rows_of(rows, "scaling.segments.growth")
    (short, long) = rows_of(rows, "scaling.segments")
    assert growth.value == pytest.approx(short.value / long.value)
    assert [row.threads for row in rows_of(rows, "scaling.threads")] == scaling.thread_counts(available_cores())
    assert all(row.value > 0 and row.unit and row.what for row in rows)
    assert len({bench.report.identity(row) for row in rows}) == len(rows)


def test_thread_counts_end_with_all_cores() -> None:
    assert [scaling.thread_counts(cores) for cores in (1, 2, 6, 8)] == [[1], [1, 2], [1, 2, 4, 6], [1, 2, 4, 8]]


def test_terrains_have_their_segments_and_starts_all_over_them() -> None:
    for segments in (10, 1000):
        task = scaling.terrain_task(segments, 1)
        assert len(task.scene.segments) == segments
        starts = scaling.spread_starts(task, 7)
        left, right = task.scene.segments[0, 0], task.scene.segments[-1, 0]
        assert left < starts[..., 0].min() < left + 2 * scaling.ROOM
        assert right - 2 * scaling.ROOM < starts[..., 0].max() < right


def test_a_step_costs_no_more_on_a_long_terrain() -> None:
    """A thousand times the segments. Where agents were put at the start by walking through the terrain's columns, these
    20 steps took 6 times as long; a walk in every step would take far longer."""
    times = scaling.segment_times((10, 10_000), agents=64, steps=20, seconds=0.1, repeats=20)
    assert times[10_000] < 3 * times[10]


def test_bodies_of_the_curves_are_what_they_are_called() -> None:
    """Inflated ones are discs, collapsed ones flat with masses on each other; points weigh as much, and pass by."""
    steps, reach = 600, 1.02  # [m]: squares that touch face to face, skins included
    area, touching = {}, {}
    for shape in scaling.SHAPES:
        task = scaling.ring_task(20, shape, steps)
        np.testing.assert_allclose(task.body.mass, 2500)
        out = Simulator(task).rollout(measuring.controllers("random", task, 16, 0))
        area[shape] = (task.body.area(out.position)[:, 0] / task.area_reference[0]).mean()
        apart = np.abs(out.position[:, :, None] - out.position[:, None]).max(axis=3)
        i, j = np.triu_indices(20, 2)
        touching[shape] = (apart[:, i, j][:, j - i < 19] < reach * task.body.side[0]).sum(axis=1).mean()
    assert min(area["inflated"], area["inflated, passive"]) > 0.9
    assert max(area["collapsed"], area["collapsed, points"]) < 0.1
    assert touching["inflated"] == 0
    assert touching["collapsed"] > 0.5
    assert touching["collapsed, points"] < touching["collapsed"] / 5


# --- environments -----------------------------------------------------------------------------------------------------


def test_environment_rows() -> None:
    rows = list(parts.environment(TINY))
    threads = [t for t in (1, 2) if t <= available_cores()]
    names = ["environment", "environment.rollout", "environment.overhead"]
    assert [(row.name, row.batch, row.threads) for row in rows] == [(name, 5, t) for t in threads for name in names]
    assert rows[2].value == pytest.approx(rows[1].value / rows[0].value)


def test_environments_do_what_the_rollout_does() -> None:
    """The same agents: as far as rounding, over the steps before chaos sets in."""
    import gymnasium

    task = measuring.make_task("hilly", "small", 30, "inflated")
    theta = measuring.controllers("inflated", task, 5, 0)
    envs: Any = gymnasium.make_vec("turgor/Hilly-v0", num_envs=5, steps=30, pressure_unit=1.0, seed_terrain=0)
    assert envs.task.identity == task.identity
    actions = parts.actions_of(envs, task, theta)
    assert actions.shape == (30, 5, 11)
    assert np.abs(actions[:, :, :-1]).max() > 0.1
    envs.reset(seed=0)
    for action in actions:
        *_, info = envs.step(action)
    np.testing.assert_allclose(info["fitness"], Simulator(task).rollout(theta).fitness, atol=1e-3)


# --- peers ------------------------------------------------------------------------------------------------------------


def test_peer_rows(peer: Any) -> None:
    rows = list(peers.peer(TINY))
    others = list(peers.peers(peer))
    names = [f"peer.{name}" for name in (*others, "engine", "engine")]
    names += [name for other in others for name in 2 * [bench.report.ratio_name(other)]] + ["peer.difference"]
    assert [row.name for row in rows] == 3 * names
    few, many = rows_of(rows, "peer.engine", controllers="random")
    assert [few.batch, many.batch] == [1, 20]
    for name in others:
        (rate,) = rows_of(rows, f"peer.{name}", controllers="random")
        ratios = rows_of(rows, bench.report.ratio_name(name), controllers="random")
        assert [row.value for row in ratios] == pytest.approx([few.value / rate.value, many.value / rate.value])
    assert max(row.value for row in rows_of(rows, "peer.difference")) <= 1e-4


def test_peer_in_box2d_v3_is_the_agent_of_crosscheck(peer: Any) -> None:
    pytest.importorskip("pyb2d3")
    from turgor.fidelity.drive import new_trace, run
    from turgor.fidelity.engines import load_world

    task = make_task("hilly", body="small", steps=30)
    theta = np.random.default_rng(1).uniform(-1, 1, (1, task.parameter_count))
    trace = new_trace()
    run(load_world("box2d-v3"), task, theta, task.position[None], trace=trace)
    there = peer.trajectory(task, theta[0], 30, peer.AgentV3)
    np.testing.assert_allclose(there, trace.position, rtol=0, atol=1e-4)
    assert np.abs(there - peer.trajectory(task, theta[0], 30)).max() > 1e-4  # another solver


@pytest.mark.parametrize("task_name", ["hilly", "flat"])
@pytest.mark.parametrize("body", ["small", "medium", "large"])
def test_peer_is_the_same_agent(peer: Any, body: str, task_name: str) -> None:
    """30 steps are before chaos sets in, whatever the machine; on flat ground the agent stands from the first on."""
    task = make_task(task_name, body=body)
    theta = np.random.default_rng(1).uniform(-1, 1, task.parameter_count)
    there = peer.trajectory(task, theta, 30)
    here = Simulator(task, threads=1).record(theta).position[:31]
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-4)
    assert np.abs(there[-1] - there[0]).max() > 0.1  # something happened


@pytest.mark.parametrize("changes", [{"name": "escape"}, {"condition": "springs"}, {"slop": 0.01}])
def test_peer_refuses_what_it_does_not_cover(peer: Any, changes: dict[str, Any]) -> None:
    task = make_task(**changes)
    with pytest.raises(ValueError, match="expected"):
        peer.Agent(task, np.zeros(task.parameter_count))


@pytest.mark.usefixtures("tiny")
def test_command_writes_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = bench.main(["--quick", "--only", "kernel", "--csv", str(tmp_path), "--json", str(tmp_path / "rows.json")])
    assert status == 0
    machine = bench.environment()["machine"]
    with open(tmp_path / f"{machine}.csv", encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    whole = json.loads((tmp_path / "rows.json").read_text(encoding="utf-8"))
    assert list(table[0]) == COLUMNS
    assert [*whole, *whole["rows"][0]] == [*COLUMNS[:7], "rows", *COLUMNS[7:]]
    assert [float(row["value"]) for row in table] == pytest.approx([r["value"] for r in whole["rows"]], rel=1e-3)
    printed = capsys.readouterr()
    assert len(printed.out.splitlines()) == len(table) + 2  # a title and the columns' names
    assert "evolving controllers" in printed.err
    assert all(row["machine"] == machine for row in table)


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("kind", ["csv", "json"])
def test_command_compares_with_an_earlier_run(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, only = tmp_path / f"rows.{kind}", ["--quick", "--only", "kernel"]
    assert bench.main([*only, f"--{kind}", str(file)]) == 0
    if kind == "json":
        changed = json.loads(file.read_text(encoding="utf-8"))
        changed["machine"], changed["rows"] = "another", changed["rows"][1:]
        file.write_text(json.dumps(changed), encoding="utf-8")
    capsys.readouterr()
    assert bench.main([*only, "--compare", str(file)]) == 0
    out = capsys.readouterr().out
    assert "now / before" in out
    assert ("ANOTHER MACHINE" in out) == ("without a figure before: 1" in out) == (kind == "json")
    compared = out[out.index("now / before") :].splitlines()[1:]
    rows = out[: out.index("\nagainst ")].splitlines()[2:]
    assert len(compared) == len(rows) - (kind == "json")
    for line in compared:
        before, now, ratio = map(float, line.split()[-3:])
        assert ratio == pytest.approx(now / before, rel=0.002, abs=0.001)  # as far as figures are printed


def test_files_without_the_column_size_still_compare(tmp_path: Path) -> None:
    rows = [bench.Row(name="kernel", batch=1, value=2.0, unit="s", what="before")]
    text = bench.as_csv(rows, bench.environment()).replace(",size,", ",").replace(",1,,,2", ",1,,2")
    (tmp_path / "old.csv").write_text(text, encoding="utf-8")
    assert "size" not in text
    assert read_record(tmp_path / "old.csv").rows == rows


# --- the page ---------------------------------------------------------------------------------------------------------


def test_the_published_page_says_what_its_rows_say() -> None:
    """Where this fails: ./run turgor bench --from benchmarks/results/MACHINE.csv --page docs"""
    text = (DOCS / "benchmarks.md").read_text(encoding="utf-8")
    machine = text.partition("--from benchmarks/results/")[2].partition(".csv")[0]
    record = read_record(RECORDS / f"{machine}.csv")
    assert text == page.page_text(record)
    for line in text.splitlines():
        if line.startswith("!["):
            picture = line.partition("](")[2].rstrip(")")
            assert (DOCS / picture).stat().st_size > 10_000


@pytest.mark.usefixtures("tiny")
def test_page_is_the_same_from_measuring_and_from_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(parts, "FIRST_ROLLOUT", "pass")  # compiling takes long
    rows, new, again = tmp_path / "rows.csv", tmp_path / "new", tmp_path / "again"
    assert bench.main(["--quick", "--csv", str(rows), "--page", str(new)]) == 0
    assert bench.main(["--from", str(rows), "--page", str(again)]) == 0
    text = (new / "benchmarks.md").read_text(encoding="utf-8")
    assert (again / "benchmarks.md").read_text(encoding="utf-8") == text
    heads = [line for line in text.splitlines() if line.startswith("## ")]
    assert heads[:5] == [
        *("## The kernel", "## How it scales", "## Environments", "## Whole evolutions", "## Start and memory")
    ]
    assert "nan" not in text
    for name in (page.SCALING, page.EVOLUTION):
        assert (again / "images" / name).read_bytes() == (new / "images" / name).read_bytes()
    assert "segments" in capsys.readouterr().out


def test_parts_that_were_not_measured_are_left_out_of_the_page() -> None:
    facts = bench.environment()
    rows = [bench.Row(name="startup.help", value=0.04, unit="s", what="turgor --help")]
    text = page.page_text(page.Record(facts=facts, rows=rows))
    assert "| turgor --help | 0.04 s |" in text
    assert "How it scales" not in text
    assert "Peers" not in text


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--from", "nowhere.csv"], "expected a file of an earlier run"),
        (["--from", "rows.json", "--only", "kernel"], "--from: expected with --page or --compare alone"),
        (["--from", "rows.json", "--evogym", "python"], "--from: expected with --page or --compare alone"),
        (["--from", "rows.json"], "expected what --csv or --json wrote; got no cpu"),
        (["--page", "rows.json"], "--page: expected a folder"),
    ],
)
def test_wrong_sources_and_pages_are_told(
    arguments: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rows.json").write_text('{"rows": [{"name": "x", "value": 1, "unit": "s", "what": ""}]}', encoding="utf-8")
    assert bench.main(arguments) == 2
    printed = capsys.readouterr()
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert printed.out == ""


# --- what cannot be ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["", "{", '{"rows": [{}]}', "name,value\nx,y\n", "name\nx\n"])
def test_comparing_with_something_else_is_told(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rows").write_text(text, encoding="utf-8")
    assert bench.main(["--compare", str(tmp_path / "rows")]) == 2
    assert bench.main(["--compare", str(tmp_path / "nowhere")]) == 2
    told = capsys.readouterr().err
    assert "expected what --csv or --json wrote" in told
    assert "expected a file of an earlier run" in told


@pytest.mark.usefixtures("tiny")
def test_a_part_that_cannot_be_measured_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(plan: bench.Plan) -> Any:
        raise RuntimeError("no luck")
        yield

    peers.load_peer.cache_clear()
    monkeypatch.setattr(peers, "PEER", Path("nowhere/box2d_peer.py"))
    monkeypatch.setitem(bench.PARTS, "memory", broken)
    assert bench.main(["--quick", "--only", "memory", "peer"]) == 1
    told = capsys.readouterr().err
    assert "memory: failed: RuntimeError: no luck" in told
    assert "peer: skipped, because benchmarks/box2d_peer.py" in told


@pytest.mark.parametrize(
    "arguments", [["--csv", "no/such/folder/rows.csv"], ["--only", "peer", "--skip", "peer"]], ids=["csv", "nothing"]
)
def test_wrong_options_are_told_before_measuring(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert "expected" in printed.err


@pytest.mark.parametrize("place", ["a_file/rows", "no_folder/rows", "n" * 300], ids=["below a file", "nowhere", "long"])
def test_files_are_tried_before_measuring(place: str, tmp_path: Path) -> None:
    (tmp_path / "a_file").write_text("kept", encoding="utf-8")
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    options = parser.parse_args(["--csv", str(tmp_path / "rows.csv"), "--json", str(tmp_path / place)])
    with pytest.raises(InvalidInput, match=r"^--json: expected a file that can be written; got .*\(.+\)$"):
        bench.run(options)
    assert [file.name for file in tmp_path.iterdir()] == ["a_file"]
    assert (tmp_path / "a_file").read_text(encoding="utf-8") == "kept"


def test_ctrl_c_keeps_what_was_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(plan: bench.Plan) -> Any:
        yield bench.Row(name="first", value=1.0, unit="s", what="before Ctrl-C")
        raise KeyboardInterrupt

    monkeypatch.setitem(bench.PARTS, "memory", interrupted)
    assert bench.main(["--only", "memory", "startup"]) == 130
    assert "before Ctrl-C" in capsys.readouterr().out
