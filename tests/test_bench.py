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
from turgor.bench import parts
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
    *("name", "body", "task", "controllers", "batch", "threads", "value", "unit", "what"),
]


@pytest.fixture(scope="module")
def peer() -> Any:
    try:
        return parts.load_peer()
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
    task = parts.make_task("hilly", "small", TINY.steps)
    many = parts.controllers(kind, task, 50, TINY.generations)
    assert many.shape == (50, task.parameter_count)
    assert len(np.unique(many, axis=0)) == 50
    few = parts.controllers(kind, task, 3, TINY.generations)
    np.testing.assert_array_equal(few, many[:3])
    parts.evolved.cache_clear()
    np.testing.assert_array_equal(parts.controllers(kind, task, 50, TINY.generations), many)


def test_memory_startup_and_evolution(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "FIRST_ROLLOUT", "pass")  # compiling takes long
    rows = {row.name: row for part in ("memory", "startup", "evolution") for row in bench.PARTS[part](TINY)}
    wanted = {"memory.peak", "startup.import", "startup.cold", "startup.warm", "evolution.wall", "evolution.robust"}
    assert wanted <= set(rows)
    assert 20 < rows["memory.peak"].value < 2000
    assert rows["memory.peak"].batch == 30
    assert rows["evolution.wall"].value > rows["evolution.simulation"].value > 0


def test_peer_rows(peer: Any) -> None:
    rows = list(parts.peer(TINY))
    names = ["peer.box2d", "peer.engine", "peer.engine", "peer.ratio", "peer.ratio", "peer.difference"]
    assert [row.name for row in rows] == 3 * names
    assert [row.batch for row in rows[:6]] == [1, 1, 20, 1, 20, 1]
    assert rows[4].value == pytest.approx(rows[2].value / rows[0].value)
    assert rows[5].value <= 1e-4


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

    parts.load_peer.cache_clear()
    monkeypatch.setattr(parts, "PEER", Path("nowhere/box2d_peer.py"))
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
