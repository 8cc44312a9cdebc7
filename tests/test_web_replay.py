"""Replays and the pages that hold them: what is written is what was recorded."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from turgor.cli import main
from turgor.errors import InvalidInput
from turgor.evolution.loop import evolve
from turgor.recording import Recording
from turgor.runs import Run
from turgor.simulate import Simulator, replay
from turgor.task import Task, make_task
from turgor.web.export import STATIC, export_folder, export_gallery, export_replays, inlined
from turgor.web.replay import facts_of_run, read_header, read_replay, replay_of_recording, replay_of_run


def recorded(task: Task, seed: int = 0) -> Recording:
    theta = np.random.default_rng(seed).normal(size=task.parameter_count)
    return Simulator(task, threads=1).record(theta)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two short runs, one below another folder."""
    folder = tmp_path_factory.mktemp("runs")
    for name, body, path in (("hilly", "small", "a"), ("escape", "medium", "deep/b")):
        recipe = {"name": name, "body": body, "condition": "pressure", "seed": 3}
        task = make_task(name, body=body, steps=240, seed=3 if name == "hilly" else 0)
        evolve(task, 40, out=folder / path, robust_repeats=3, recipe=recipe)
    return folder


@pytest.mark.parametrize(("name", "body"), [("hilly", "large"), ("escape", "medium"), ("flat", "small")])
def test_what_is_read_is_what_was_recorded(name: str, body: str) -> None:
    task = make_task(name, body=body, steps=600)
    recording = recorded(task)
    back = read_replay(replay_of_recording(recording, task, title="a title", seed=4))
    header = back.header
    assert (header.steps, header.masses, header.dt) == (recording.steps, task.body.mass_count, recording.dt)
    assert (header.title, header.seed, header.name) == ("a title", 4, name)
    assert np.abs(back.position - recording.position).max() <= 0.5e-3 + 1e-9
    level = (header.spring_range[1] - header.spring_range[0]) / 255 * task.body.rest_length
    assert (np.abs(back.rest_length - recording.rest_length) <= 0.5 * level + 1e-6).all()
    np.testing.assert_array_equal(back.pressure, recording.pressure)
    np.testing.assert_array_equal(back.touch, recording.touch)
    assert header.pressure_range == pytest.approx((task.pressure_range[0, 0], task.pressure_range[0, 1]))
    assert header.area_reference == pytest.approx(task.area_reference.tolist())
    np.testing.assert_allclose(header.scene["segments"], task.scene.segments, atol=1e-4)
    assert header.end == (task.end.half_width if name == "escape" else None)


def test_a_large_replay_of_30_s_is_small() -> None:
    task = make_task("hilly", body="large")
    data = replay_of_recording(recorded(task), task)
    assert read_header(data).steps == 1800
    assert len(data) < 700_000  # what the page allows
    assert len(data) < 250_000  # what it is, with room


def test_one_step_in_two_keeps_the_time_and_every_touch() -> None:
    task = make_task("flat", steps=101)
    recording = recorded(task)
    back = read_replay(replay_of_recording(recording, task, every=2))
    assert (back.header.steps, back.header.dt) == (50, 2 * recording.dt)
    assert np.abs(back.position - recording.position[::2]).max() <= 0.5e-3 + 1e-9
    both = np.asarray(recording.touch[1:101]).reshape(50, 2, -1).any(axis=1)
    np.testing.assert_array_equal(back.touch[1:], both)


def test_bodies_without_springs_or_gas_and_fast_ones() -> None:
    from turgor.body import Body
    from turgor.scene import flat

    square = Body(position=[[0.0, 0.0]])
    back = read_replay(
        replay_of_recording(replay(square, flat(), np.zeros((20, 0)), position=[[0, 5]], velocity=[[100, 0]]))
    )
    assert (back.rest_length.shape, back.pressure.shape) == ((21, 0), (21, 0))
    task = make_task("flat", steps=5)
    position = np.zeros((6, 10, 2)) + np.arange(6)[:, None, None] * 50.0  # 50 m a step: more than 16 bits of mm
    leaping = msgspec.structs.replace(recorded(task), position=position)
    back = read_replay(replay_of_recording(leaping))
    assert back.header.arrays[1]["type"] == "int32"
    np.testing.assert_allclose(back.position, position)


def test_what_cannot_be_written_or_read_is_refused(runs: Path, tmp_path: Path) -> None:
    task = make_task("flat", steps=5)
    recording = recorded(task)
    broken = msgspec.structs.replace(recording, position=np.full((6, 10, 2), np.nan))
    with pytest.raises(InvalidInput, match="finite positions"):
        replay_of_recording(broken)
    with pytest.raises(InvalidInput, match="fact: expected one of title"):
        replay_of_recording(recording, colour="red")
    with pytest.raises(InvalidInput, match="every: expected"):
        replay_of_recording(recording, every=0)
    with pytest.raises(InvalidInput, match="which: expected one of best, solver"):
        replay_of_run(runs / "a", "worst")
    with pytest.raises(InvalidInput, match="an agent solved the task; got none"):
        replay_of_run(runs / "a", "solver")
    with pytest.raises(InvalidInput, match="expected the folder of a run"):
        replay_of_run(tmp_path)
    whole = replay_of_recording(recording)
    for data in (b"", b"TGR1", b"TGR2" + whole[4:], whole[:-9], whole[:40], whole[:8] + b"[]" + whole[10:]):
        with pytest.raises(InvalidInput, match="the bytes of a replay"):
            read_replay(data)


def test_replay_of_a_run_tells_what_it_is(runs: Path) -> None:
    run = Run.open(runs / "a")
    header = read_header(replay_of_run(runs / "a"))
    champion = run.checked_champion()
    assert (header.fitness, header.robust) == (champion.fitness, champion.robust_fitness)
    assert (header.name, header.body, header.condition) == ("hilly", "small", "pressure")
    assert (header.title, header.unit) == ("hilly, small, pressure, seed 3", " m/s")
    assert (header.controller, header.seed) == ("linear", 3)
    unknown = Run(run.task, msgspec.structs.replace(run.settings, recipe=None))
    assert facts_of_run(unknown)["body"] == "custom"


# --- pages --------------------------------------------------------------------------------------------------------


def test_modules_become_one_script() -> None:
    script = inlined("gallery.js", "showGallery")
    assert not re.search(r"^\s*(import|export)\b", script, re.MULTILINE)
    order = [script.index(f"const module_{name} =") for name in ("draw", "charts", "player", "gallery")]
    assert order == sorted(order)
    assert script.count("const module_draw =") == 1
    assert script.endswith("module_gallery.showGallery();\n")
    for path in STATIC.glob("*.js"):
        if path.name != "play.js":  # it knows no text but its own
            assert "innerHTML" not in path.read_text(encoding="utf-8")  # what a run is called is never HTML


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('import a from "./b.js";\n', "plain imports"),
        ('import { a } from "https://example.org/b.js";\n', "plain imports"),
        ("export default function () {}\n", "plain imports"),
        ('const later = import("./b.js");\n', "plain imports"),
        ('import { a } from "./a.js";\n', "circle"),
        ('const tag = "</script>";\n', "can stand in HTML"),
    ],
)
def test_modules_that_cannot_be_inlined_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.js").write_text(text)
    with pytest.raises(InvalidInput, match=message):
        inlined("a.js", "a", tmp_path)


def test_a_page_escapes_what_it_is_told() -> None:
    hostile = '<img src=x onerror="alert(1)"></script>'
    task = make_task("flat", steps=5)
    data = replay_of_recording(recorded(task), task, title=hostile, body=hostile, condition=hostile)
    for page in (export_replays([data]), export_gallery([data, data], title=hostile)):
        assert hostile not in page
        assert "<img" not in page
        assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
        assert "https://" not in page
        assert "default-src 'none'" in page
        assert "unsafe" not in page


def test_export_writes_one_file(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "replay.html"
    assert main(["export", str(runs / "a"), "--out", str(out)]) == 0
    assert re.search(r"replay\.html, \d+ kB\n$", capsys.readouterr().out)
    assert out.read_text().count('class="replay"') == 1
    assert main(["export", str(runs / "a"), str(runs / "deep" / "b"), "--out", str(out)]) == 0
    assert out.read_text().count('class="replay"') == 2
    assert [path.name for path in tmp_path.iterdir()] == ["replay.html"]


def test_gallery_shows_every_run_and_tells_of_those_that_cannot(runs: Path, tmp_path: Path) -> None:
    page, problems = export_folder(runs)
    assert page.count('class="gallery-card"') == page.count('class="replay"') == 2
    assert not problems
    page, problems = export_folder(runs / "deep")
    assert page.count('class="gallery-card"') == 1
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "run.json").write_text("{}")
    with pytest.raises(InvalidInput, match="expected runs with a champion"):
        export_folder(tmp_path)
    with pytest.raises(InvalidInput, match="nothing there"):
        export_folder(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "expected one run, two runs, or --gallery"),
        (["a", "--gallery", "."], "expected one run, two runs, or --gallery"),
        (["a", "a", "a"], "at most two runs"),
        (["nowhere"], "expected the folder of a run; got nothing there"),
        (["a", "--out", "no/such/file.html"], "--out: expected a file in a folder that exists"),
        (["a", "--which", "solver"], "in which an agent solved the task"),
        (["a", "--which", "worst"], "--which: invalid choice"),
        (["--gallery", "nowhere"], "expected a folder of runs; got nothing there"),
        (["--gallery", "empty"], "expected a folder with runs below it; got none"),
    ],
)
def test_export_tells_errors_in_one_line(
    argv: list[str], message: str, runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(runs)
    (runs / "empty").mkdir(exist_ok=True)
    assert main(["export", *argv]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not list(runs.glob("*.html"))
