"""The command line: what it makes, what it says, and every error in one line."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from turgor.body import SIZES
from turgor.cli import COMMANDS, main
from turgor.control import Distributed
from turgor.evolution import STRATEGIES
from turgor.evolution.loop import evolve
from turgor.evolution.strategy import built_in
from turgor.files import read_arrays, write_arrays
from turgor.runs import Run
from turgor.simulate import Simulator
from turgor.task import TASKS, make_task, variant_names

FAST = ["--task", "flat", "--steps", "40"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of 2 s of simulated time."""
    out = tmp_path_factory.mktemp("cli") / "made"
    task = make_task("escape", steps=120)
    recipe = {"name": "escape", "body": "small", "seed": 0}
    evolve(task, 42, out=out, robust_repeats=3, recipe=recipe)
    return out


def turgor(*argv: str, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "turgor", *argv]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def complaints(err: str) -> list[str]:
    """Lines on stderr, apart from the one that says why the first call takes longer."""
    return [line for line in err.splitlines() if not line.startswith("turgor: compiling the engine")]


# --- help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("argv", [[], ["--help"], ["-h"], ["help"]])
def test_help_lists_every_command(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 0
    out = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert f"  {name}" in out
        assert command.summary in out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: turgor {name} ")
    assert COMMANDS[name].summary in out
    assert f"  turgor {name}" in out  # an example


def test_help_tells_every_variant_task_and_body(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["evolve", "--help"]) == 0
    out = capsys.readouterr().out
    for name in variant_names():
        told = re.search(rf"^  --{name.replace('_', '-')} .*?(?=^  --|^$)", out, re.DOTALL | re.MULTILINE)
        assert told is not None, name
        assert "default: " in told[0]
    for name in [*TASKS, *SIZES, *STRATEGIES]:
        assert name in out or name == "inflation"  # which evolves nothing


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("turgor 0.")


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from turgor.cli import main, COMMANDS\n"
        "for argv in [['--help'], *([name, '--help'] for name in COMMANDS)]: main(argv)\n"
        "heavy = {'numpy', 'numba', 'matplotlib', 'scipy', 'cma', 'pygame', 'av', 'rich', 'tyro',\n"
        "         'starlette', 'uvicorn', 'websockets'} & set(sys.modules)\n"
        "sys.exit(' '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        (["evolv"], "there is no command 'evolv'; did you mean evolve?"),
        (["--seed", "1", "evolve"], "expected a command first, as in turgor evolve; got --seed"),
        (["evolve", "--gravty", "9"], "turgor evolve: there is no option --gravty; did you mean --gravity?"),
        (["evolve", "--grav=9"], "turgor evolve: there is no option --grav"),
        (["evolve", "hilly"], "turgor evolve: expected options; got 'hilly'"),
        (["evolve", "--gravity"], "--gravity: expected one argument"),
        (["evolve", "--gravity", "x"], "--gravity: expected a number; got 'x'"),
        (["evolve", "--gravity", "nan"], "--gravity: expected a number that is finite; got 'nan'"),
        (["evolve", "--gravity", "-1"], "gravity: expected a number that is not negative, up to 1e+09; got -1.0"),
        (["evolve", "--window", "1.5"], "--window: expected a whole number; got '1.5'"),
        (["evolve", "--observation", "x"], "--observation: expected one of signed, unit; got 'x'"),
        (
            ["evolve", "--task", "moon"],
            "task: expected one of hilly, flat, escape, escape-authors, inflation; got 'moon'",
        ),
        (["evolve", "--body", "huge"], "body: expected one of small, medium, large; got 'huge'"),
        (["evolve", "--condition", "none"], "condition: expected one of pressure, springs, passive; got 'none'"),
        (["evolve", "--condition", "passive"], "expected a condition that controls something; got hilly, passive"),
        (["evolve", "--task", "inflation"], "expected a condition that controls something; got inflation, passive"),
        (
            ["evolve", "--controller", "pid"],
            "controller: expected one of linear, mlp, sinusoid, distributed; got 'pid'",
        ),
        (["evolve", "--hidden", "4"], "hidden: expected a controller that has it (mlp, distributed); got linear"),
        (
            ["evolve", "--controller", "mlp", "--messages", "2"],
            "expected a controller that has it (distributed); got mlp",
        ),
        (["evolve", "--controller", "mlp", "--hidden", "0"], "hidden: expected a whole number, 1 to 1000; got 0"),
        (["evolve", "--radius", "-1"], "radius: expected a positive number of metres, up to 1e+06; got -1.0"),
        (["evolve", "--mass-count", "2"], "mass_count: expected a whole number, 3 to 1000; got 2"),
        (["evolve", "--evaluations", "0"], "--evaluations: expected a whole number, at least 1; got 0"),
        (["evolve", "--threads", "0"], "--threads: expected a whole number, at least 1; got 0"),
        (["evolve", "--seed", "-1"], "seed: expected a whole number, 0 or more; got -1"),
        (
            ["evolve", "--strategy", "cma"],
            "strategy: expected one of cma-es, sep-cma-es, lm-ma-es, openai-es; got 'cma'",
        ),
        (["evolve", "--population", "3"], "population: expected a whole number, 4 to 1000000; got 3"),
        (["evolve", "--strategy", "openai-es", "--population", "5"], "an even whole number, 4 to 1000000; got 5"),
        (["evolve", "--sigma", "0"], "sigma: expected a positive number; got 0.0"),
        (["evolve", "--out", "full"], "out: expected a new or empty folder; got full, which is not empty"),
        (["evolve", "--out", "full/file/run"], "Not a directory"),
        (["evaluate"], "turgor evaluate: expected RUN"),
        (["evaluate", "nowhere"], "nowhere: expected the folder of a run; got nothing there"),
        (["evaluate", "full"], "full: expected the folder of a run; got no run.json in it"),
        (["evaluate", "full/file"], "full/file: expected the folder of a run; got a file"),
        (["evaluate", "full", "--repeats", "0"], "--repeats: expected a whole number, at least 1; got 0"),
        (["resume", "full"], "full: expected the folder of a run; got no run.json in it"),
        (["resume", "made", "--evaluations", "42"], "evaluations: expected more than the 42 that are done; got 42"),
        (["video", "full"], "full: expected the folder of a run; got no run.json in it"),
        (["video", "made", "--size", "big"], "--size: expected WIDTHxHEIGHT in pixels, as in 1280x720; got 'big'"),
        (["video", "made", "--size", "7x7"], "size: expected"),
        (["video", "made", "--out", "a.avi"], "format of the video: expected one of .mp4, .webm, .gif; got '.avi'"),
        (["video", "made", "--out", "nowhere/a.mp4"], "expected a file in a folder that exists; got nowhere/a.mp4"),
        (["evaluate", "broken"], "champion.npz: expected theta as float64 [374]; got float64 [7]"),
        (["evaluate", "young"], "young: expected a run with a champion; got none yet (no champion.npz)"),
    ],
)
def test_errors_are_one_line(
    argv: list[str], text: str, here: Path, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "full").mkdir()
    (here / "full" / "file").write_text("")
    for name in ("made", "broken", "young"):
        shutil.copytree(made, here / name)
    write_arrays(here / "broken" / "champion.npz", {**read_arrays(made / "champion.npz"), "theta": np.zeros(7)})
    (here / "broken" / "checkpoint.npz").unlink()
    (here / "young" / "champion.npz").unlink()
    before = sorted(here.rglob("*"))
    assert main(argv) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("turgor: error: ")
    assert text in line
    assert sorted(here.rglob("*")) == before


def test_error_of_the_process_has_no_traceback() -> None:
    process = turgor("evaluate", "nowhere")
    out, err = process.communicate()
    assert (process.returncode, out) == (2, "")
    assert err == "turgor: error: nowhere: expected the folder of a run; got nothing there\n"


# --- commands -----------------------------------------------------------------------------------------------------


def test_evolve_makes_a_run_with_its_figure_and_video(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    variants = ["--gravity", "9.81", "--window", "15", "--observation", "unit", "--pressure-unit", "1", "--steps", "6"]
    assert main(["evolve", "--task", "flat", "--evaluations", "30", "--seed", "5", *variants]) == 0
    out = here / "runs" / "flat-small-pressure-s5"
    files = ["champion.mp4", "champion.npz", "checkpoint.npz", "fitness.png", "history.csv", "run.json"]
    assert sorted(file.name for file in out.iterdir()) == files
    run = Run.open(out)
    expected = make_task("flat", seed=5, gravity=9.81, window=15, observation="unit", pressure_unit=1.0, steps=6)
    assert run.task.identity == expected.identity
    assert run.settings.recipe is not None
    assert make_task(**run.settings.recipe).identity == expected.identity
    said = capsys.readouterr()
    assert "evolving flat, small, pressure, seed 5: 374 parameters, 30 evaluations" in said.out
    for word in ("best ", "robust ", "time ", "folder ", "next "):
        assert f"\n{word}" in said.out
    assert "42/30  best " in said.out  # progress in a pipe: the last generation at least
    assert complaints(said.err) == []


def test_next_run_gets_a_folder_of_its_own(here: Path) -> None:
    for _ in range(2):
        assert main(["evolve", *FAST, "--evaluations", "21", "--no-video"]) == 0
    assert sorted(f.name for f in (here / "runs").iterdir()) == ["flat-small-pressure-s0", "flat-small-pressure-s0-2"]


def test_threads_do_not_change_a_bit(here: Path) -> None:
    for threads in "12":
        argv = ["evolve", *FAST, "--evaluations", "100", "--no-video", "--threads", threads, "--out", threads]
        assert main(argv) == 0
    one, two = (
        [line.rpartition(",")[0] for line in (here / threads / "history.csv").read_text().splitlines()]
        for threads in "12"
    )
    assert one == two
    assert (here / "1" / "champion.npz").read_bytes() == (here / "2" / "champion.npz").read_bytes()


def test_evolve_takes_a_controller(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["evolve", *FAST, "--evaluations", "21", "--no-video", "--controller", "distributed", "--hidden", "3"]
    assert main(argv) == 0
    run = Run.open(here / "runs" / "flat-small-pressure-distributed-s0")
    expected = make_task("flat", steps=40, controller=Distributed(hidden=3))
    assert run.task.identity == expected.identity
    assert run.settings.recipe is not None
    assert make_task(**run.settings.recipe).identity == expected.identity
    assert "evolving flat, small, pressure, distributed, seed 0: 40 parameters" in capsys.readouterr().out


def test_resume_evolves_further(here: Path, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(made, here / "run")
    assert main(["resume", "run", "--evaluations", "84", "--no-video"]) == 0
    assert Run.open(here / "run").evaluations == 84
    assert "resuming escape, small, pressure, seed 0 after 42 evaluations" in capsys.readouterr().out


@pytest.mark.parametrize("name", STRATEGIES)
def test_resume_takes_the_strategy_that_the_run_was_evolved_with(
    name: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = ["--strategy", name, "--population", "8", "--sigma", "0.2"]
    assert main(["evolve", *FAST, *chosen, "--evaluations", "16", "--no-video", "--out", "run"]) == 0
    settings = json.loads((here / "run" / "run.json").read_text())["settings"]
    assert (settings["strategy"], settings["population"], settings["sigma"]) == (name, 8, 0.2)
    assert main(["resume", "run", "--evaluations", "32", "--no-video"]) == 0
    assert f", {name} " in capsys.readouterr().out  # where the time went
    run = Run.open(here / "run")
    whole = evolve(run.task, 32, strategy=partial(built_in(name), population=8, sigma=0.2))
    assert [row[:-1] for row in run.rows] == [row[:-1] for row in whole.rows]


def test_evaluate_tells_statistics_and_writes_only_what_is_asked(
    here: Path, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(made, here / "run")
    before = sorted(here.rglob("*"))
    assert main(["evaluate", "run", "--repeats", "8"]) == 0
    out = capsys.readouterr().out
    assert "the same bits" in out
    assert "of 8 starts moved by 1e-6 m" in out
    assert "solved     0 of 8" in out
    assert sorted(here.rglob("*")) == before
    assert main(["evaluate", "run", "--repeats", "8", "--json", "result.json"]) == 0
    result = json.loads((here / "result.json").read_text())
    champion = Run.open(made).checked_champion()
    assert result["fitness"] == result["again"] == champion.fitness
    assert result["median"] == pytest.approx(np.median(result["each"]))
    assert (len(result["each"]), result["solved"]) == (8, 0)
    capsys.readouterr()
    assert main(["evaluate", "run", "--repeats", "8", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == result


def test_video_of_another_size(here: Path, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["video", str(made), "--out", "champion.webm", "--size", "128x96"]) == 0
    assert (here / "champion.webm").stat().st_size > 1000
    assert capsys.readouterr().out == "champion.webm\n"


def test_video_of_a_part_in_another_format(here: Path, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(made, here / "run")
    argv = ["video", "run", "--format", "gif", "--size", "128x96", "--from", "0.5", "--to", "1"]
    assert main(argv) == 0
    assert capsys.readouterr().out == str(Path("run") / "champion.gif") + "\n"
    with av.open(str(here / "run" / "champion.gif")) as container:
        assert len(list(container.decode(video=0))) == 13
    assert main([*argv, "--out", "champion.mp4"]) == 2
    assert "--format: expected --out to end with .gif; got champion.mp4" in capsys.readouterr().err
    assert main(["video", "run", "--from", "3"]) == 2
    assert "expected 0 <= start <= stop <= 2 s" in capsys.readouterr().err


# --- signals, pipes, terminals ------------------------------------------------------------------------------------


def test_ctrl_c_keeps_what_was_evolved_and_resume_goes_on_with_the_same_bits(here: Path) -> None:
    process = turgor("evolve", *FAST, "--evaluations", "1000000", "--out", "run")
    history, deadline = here / "run" / "history.csv", time.monotonic() + 60
    while not (history.exists() and history.read_text().count("\n") > 5):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "turgor: interrupted; kept in run; turgor resume run goes on"
    assert "Traceback" not in err
    run = Run.open(here / "run")
    champion = run.checked_champion()
    assert run.status == "interrupted"
    assert Simulator(run.task).rollout(champion.theta[None]).fitness[0] == champion.fitness
    more = run.evaluations + 42
    assert main(["resume", "run", "--evaluations", str(more), "--no-video"]) == 0
    whole = evolve(run.task, more)
    assert [row[:-1] for row in Run.open(here / "run").rows] == [row[:-1] for row in whole.rows]


def test_ctrl_c_while_drawing_keeps_the_whole_run(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("turgor.view.video.write_video", interrupted)
    assert main(["evolve", *FAST, "--evaluations", "21", "--out", "run"]) == 130
    (line,) = complaints(capsys.readouterr().err)
    assert line == "turgor: interrupted; kept in run, whole; turgor video run draws it"
    assert Run.open(here / "run").status == "done"


def test_progress_in_a_pipe_is_plain_lines(here: Path) -> None:
    process = turgor("evolve", *FAST, "--evaluations", "100", "--no-video")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, complaints(err)) == (0, [])
    assert "\x1b" not in out
    assert "\r" not in out
    lines = [line for line in out.splitlines() if "/100  best " in line]
    assert 1 <= len(lines) <= 5  # generations
    assert lines[-1].startswith("105/100  best ")
    assert lines[-1].endswith("0:00 left")


def test_reader_that_leaves_does_not_stop_the_evolution(here: Path) -> None:
    with turgor("evolve", *FAST, "--evaluations", "100", "--no-video", "--out", "run") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert complaints(process.stderr.read()) == []
    assert process.returncode == 0
    assert Run.open(here / "run").status == "done"


def test_progress_on_a_terminal_is_a_live_line(here: Path) -> None:
    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "turgor", "evolve", *FAST, "--evaluations", "100", "--no-video"]
    process = subprocess.Popen(command, stdout=follower, env={**os.environ, "TERM": "xterm", "COLUMNS": "100"})
    os.close(follower)
    shown = b""
    while True:
        try:
            shown += os.read(leader, 65536)
        except OSError:  # the other end is closed
            break
    os.close(leader)
    assert process.wait(60) == 0
    assert b"105/100  best " in shown
    assert b"\x1b[" in shown
