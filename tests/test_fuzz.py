"""Bad input: a slice of the fuzzing for every target, what fuzzing has found, and round trips of everything."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fuzzing
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from turgor.arrays import as_numbers
from turgor.body import SMALL, Body, ring
from turgor.cli import main
from turgor.cli.words import say
from turgor.errors import InvalidInput
from turgor.evolution.cma_es import CMAES
from turgor.evolution.loop import evaluate, evolve, resume
from turgor.evolution.sep_cma_es import SepCMAES
from turgor.files import read_arrays, read_whole, write_arrays
from turgor.physics.ground import cut_into_columns
from turgor.records import Settings
from turgor.runs import Run
from turgor.scene import Scene, flat, hills
from turgor.simulate import Simulator
from turgor.task import Leave, make_task, task_from_json, task_to_json
from turgor.variants import Robust
from turgor.web.replay import read_replay

quick = settings(derandomize=True, deadline=None, max_examples=100, database=None)

SLICE = {
    "run.json": 100, "history.csv": 30, "champion.npz": 80, "checkpoint.npz": 30, "command": 40, "message": 500,
    "visit": 3, "request": 20, "task": 200, "replay": 100, "theta": 80,
}  # fmt: skip


@pytest.mark.parametrize("name", fuzzing.TARGETS)
def test_every_target_refuses_in_one_line_or_comes_to_a_good_end(name: str) -> None:
    target = fuzzing.TARGETS[name]
    ends = [fuzzing.try_input(target, fuzzing.input_of(target, 0, k)) for k in range(SLICE[name])]
    if name not in ("visit", "request"):
        assert set(ends) == {True, False}, "inputs that are all refused, or all taken, say little"


def test_what_is_not_hostile_is_taken() -> None:
    """The targets would find nothing if the path to what they try were broken."""
    for k in range(len(fuzzing.STRATEGIES)):
        for name in fuzzing.FILES:
            data = bytes([k]) + (fuzzing.corpus()[k] / name).read_bytes()
            assert fuzzing.try_input(fuzzing.TARGETS[name], data), name
    for name, argv in fuzzing.CHEAP.items():
        accepted = fuzzing.try_input(fuzzing.TARGETS["command"], fuzzing.as_json([name, *argv]))
        assert accepted == (name not in ("view", "reproduce", "crosscheck", "bench")), name
    for message in fuzzing.MESSAGES:
        assert fuzzing.try_input(fuzzing.TARGETS["message"], fuzzing.as_json(message))


# --- what fuzzing has found -----------------------------------------------------------------------------------------

RAGGED = [[0, 1], [1]]
FOUND: dict[str, tuple[Callable[[], Any], str]] = {
    "task that is no JSON": (lambda: task_from_json(b"[1"), "task: expected JSON; got "),
    "task of nothing but brackets": (lambda: task_from_json(b"[" * 100_000), "task: expected JSON; got "),
    "ragged springs": (lambda: Body(SMALL.position, springs=RAGGED), "springs: expected numbers"),
    "an odd number of indices": (lambda: Body(SMALL.position, springs=[1, 2, 3]), "springs: expected pairs"),
    "springs to infinity": (lambda: Body(SMALL.position, springs=[[0, np.inf]]), "springs: expected pairs"),
    "springs far away": (lambda: Body(SMALL.position, springs=[[0, 1e30]]), "springs: expected pairs"),
    "chambers of words": (lambda: Body(SMALL.position, chambers=["abc"]), "chambers: expected loops"),
    "chambers of no loops": (lambda: Body(SMALL.position, chambers=3), "chambers: expected loops"),
    "a ragged side": (lambda: ring(10, 5.0, side=RAGGED), "side: expected numbers"),
    "friction of words": (lambda: ring(10, 5.0, friction="much"), "friction: expected numbers"),
    "numbers in quotes": (lambda: ring(10, 5.0, side="1.0"), "side: expected numbers"),
    "a density of 1e-300": (
        lambda: ring(10, 5.0, density=1e-300), "density: expected positive numbers, 1e-09 to 1e+09",
    ),
    "too many masses": (lambda: ring(10**12, 5.0), "mass_count: expected a whole number, 3 to 1000"),
    "too many masses of one's own": (lambda: Body(np.zeros((1001, 2))), "expected at most 1000 masses"),
    "a mass in another galaxy": (lambda: Body([[1e20, 0.0]]), "within 1e+06 m"),
    "too many segments": (lambda: Scene(np.zeros((100_001, 4))), "segments: expected at most 100000"),
    "hills without end": (lambda: hills(extent=1e6, step=1e-9), "hills: expected fewer than 100000 vertices"),
    "friction of the ground of words": (lambda: Scene([], friction="much"), "segments: expected numbers"),
    "a ragged start": (lambda: msgspec.structs.replace(TASK, position=RAGGED), "position: expected numbers"),
    "a pressure unit of 1e300": (lambda: make_task("flat", pressure_unit=1e300), "pressure_unit: expected a number"),
    "an end beyond float32": (lambda: Leave(half_width=1e154), "half_width: expected 0 m or more, up to 1e+06 m"),
    "endless iterations": (
        lambda: make_task("flat", velocity_iterations=10**9), "a number from 0 to 1000; got 1000000000",
    ),
    "steps of no time": (lambda: make_task("flat", dt=1e-300), "dt: expected a number from 1e-06 to 10"),
    "a scale of nothing": (lambda: make_task("flat", velocity_scale=1e-300), "velocity_scale: expected a positive"),
    "a window over many masses": (
        lambda: Simulator(make_task("flat", body=ring(300, 100.0), window=10_000)),
        "a shorter window (16 agents' state), in at most 256 MB; got ",
    ),
    "a controller larger than memory": (
        lambda: Simulator(make_task("flat", body=ring(900, 300.0), controller={"type": "mlp", "hidden": 1000})),
        "in at most 256 MB; got ",
    ),
    "walls above walls": (
        lambda: Simulator(make_scene_task(Scene(np.tile([[500.0, 0, -500, 0]], (20_000, 1)) + _lifts(20_000)))),
        "segments: expected fewer that lie above each other, in at most 256 MB; got ",
    ),
    "a recording larger than memory": (
        lambda: record(make_task("flat", steps=10**7)), "steps: expected fewer to be recorded",
    ),
    "a given pressure larger than memory": (
        lambda: record(make_task("inflation", steps=10**6)), "steps: expected fewer",
    ),
    "a million threads": (lambda: Simulator(TASK, threads=10**6), "threads: expected a whole number, 1 to 1024"),
    "restarts of rows": (lambda: stepping().restart([[1], [1, 2]]), "which: expected numbers"),
    "commands of words": (lambda: stepping().step("go"), "commands: expected numbers; got go"),
    "commands beyond float32": (lambda: stepping().step(np.full((1, 11), 1e39)), "commands: expected finite numbers"),
    "a push that is too strong": (lambda: stepping().push(np.full((1, 10, 2), 1e30)), "beyond 1e+09 m/s"),
    "a start of words": (lambda: Simulator(TASK).rollout(np.zeros((1, 374)), "here"), "position: expected numbers"),
    "a population of 10^12": (
        lambda: SepCMAES(9, _rng(), population=10**12), "population: expected a whole number, 4 to 1000000",
    ),
    "a generation larger than memory": (
        lambda: SepCMAES(1344, _rng(), population=900_000), "at most 148809 for 1344 parameters",
    ),
    "a covariance larger than memory": (lambda: CMAES(10**6, _rng()), "expected at most 5000 parameters; sep-cma-es"),
    "repeats larger than memory": (
        lambda: evaluate(Simulator(TASK), np.zeros(374), 10**12), "repeats: expected a whole number",
    ),
    "a seed that JSON does not hold": (lambda: evolve(TASK, 30, seed=10**30), "seed: expected a whole number, 0 to"),
    "evaluations that JSON does not hold": (lambda: evolve(TASK, 10**30), "evaluations: expected a whole number"),
    "settings of 10^12 repeats": (
        lambda: settings_of(robust_repeats=10**12), "robust_repeats: expected a whole number",
    ),
    "a robust evolution in 10^12 worlds": (
        lambda: Robust(worlds=10**12), "robust worlds: expected a whole number, 1 to 100",
    ),
    "a spread that no number has": (lambda: Robust(gas=10**400), "robust gas: expected a number from 0 to 1"),
    "an endless value in a message": (lambda: task_from_json(b'{"name":"%s"}' % (b"x" * 5000)), "task: "),
    "a replay of 2^64 masses": (
        lambda: read_replay(replay_with("masses", 2**64)), "replay: expected the bytes of a replay"
    ),
    "a replay of endless springs": (
        lambda: read_replay(replay_with("spring_range", [-1e308, 1e308])), "replay: expected the bytes of a replay"
    ),
    "a replay of 2^53 masses": (
        lambda: read_replay(replay_with("masses", 2**53)), "bytes of a replay; got positions of shape"
    ),
    "a replay of nothing but brackets": (
        lambda: read_replay(b"TGR1" + struct.pack("<I", 100_000) + b"[" * 100_000), "replay: expected the bytes"
    ),
    "a replay that unpacks to 100 MB": (lambda: read_replay(bomb()), "replay: expected the bytes of a replay"),
}  # fmt: skip

TASK = make_task("flat", steps=20)


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


def _lifts(count: int) -> np.ndarray:
    """Moves segments apart [m], shape [segment, 4]."""
    k = np.arange(count)[:, None]
    return np.concatenate([k * 1e-3, k * 0.1, k * 1e-3, k * 0.1], axis=1)


def make_scene_task(scene: Scene) -> Any:
    return msgspec.structs.replace(TASK, scene=scene)


def record(task: Any) -> Any:
    return Simulator(task, threads=1).record(np.zeros(task.parameter_count))


def stepping() -> Simulator:
    simulator = Simulator(TASK, threads=1)
    simulator.reset(1)
    return simulator


def settings_of(**changes: Any) -> Settings:
    fields = {"evaluations": 10, "seed": 0, "strategy": "cma-es", "population": 4, "threads": 1}
    return Settings(**(fields | changes))


def replay_with(name: str, value: Any) -> bytes:
    data = fuzzing._replay()
    end = 8 + struct.unpack("<I", data[4:8])[0]
    text = msgspec.json.encode({**msgspec.json.decode(data[8:end]), name: value})
    return data[:4] + struct.pack("<I", len(text)) + text + data[end:]


def bomb() -> bytes:
    """A replay whose header declares a few numbers, and whose stream has many."""
    data = fuzzing._replay()
    end = 8 + struct.unpack("<I", data[4:8])[0]
    return data[:end] + zlib.compress(bytes(100_000_000))[:-4]


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_is_refused_in_one_line(name: str) -> None:
    act, text = FOUND[name]
    with pytest.raises(InvalidInput) as error:
        act()
    assert text in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) <= 1000


CHAMPION: dict[str, Any] = {
    "fitness": np.array(1j), "steps": np.array("1970-01-01", "M8[s]"), "generation": np.array(-1),
    "robust": np.zeros(0), "robust_solved": np.array(["x", "y"]), "solved": np.array(3, "m8[s]"),
}  # fmt: skip


@pytest.mark.parametrize("name", CHAMPION)
def test_a_champion_of_other_types_is_refused(name: str) -> None:
    with np.load(fuzzing.corpus()[0] / "champion.npz") as file:
        whole = {key: file[key] for key in file.files if key != "sha256"}
    data = fuzzing.saved({**whole, name: CHAMPION[name]})
    with pytest.raises(InvalidInput, match=rf"champion.npz: expected .* in {name}"):
        fuzzing.use_champion(bytes([fuzzing.ALONE]) + data)


STATE: dict[str, Any] = {
    "strategy_pc": np.zeros(374, "i1"), "strategy_generator": np.full(6, 2**64 - 1, "u8"), "history": np.zeros(3),
    "strategy_population": np.array(1e12),
}  # fmt: skip


@pytest.mark.parametrize("name", STATE)
def test_a_checkpoint_of_other_types_is_refused(name: str) -> None:
    with np.load(fuzzing.corpus()[0] / "checkpoint.npz") as file:
        whole = {key: file[key] for key in file.files if key != "sha256"}
    folder = fuzzing.with_file("checkpoint.npz", bytes(1) + fuzzing.saved({**whole, name: STATE[name]}))
    with pytest.raises(InvalidInput):
        resume(Run.open(folder), 16, threads=1)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_no_file_of_a_run(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "run.json")
    with pytest.raises(InvalidInput, match=r"run.json: expected a file; got something else"):
        Run.open(tmp_path)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with open(tmp_path / "run.json", "wb") as file:
        file.truncate(10**12)  # a hole
    with pytest.raises(InvalidInput, match="expected at most 50 MB; got 1000000 MB"):
        Run.open(tmp_path)
    with pytest.raises(InvalidInput, match="expected at most 1 MB"):
        read_whole(tmp_path / "run.json", 1_000_000)


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        (["evolve", "--out", "a\0b"], "expected text and names of files; got a NUL character"),
        (["evolve", "--seed", "1" * 400], "--seed: expected a whole number up to 2^53; got '111"),
        (["evolve", "--seed", "1" * 5000], "--seed: expected a whole number; got '111"),
        (["evaluate", "x", "--json=--"], "--json: expected a value; got --"),
        (["evolve", "--population", "1000000000000"], "population: expected a whole number, 4 to 1000000"),
        (["evolve", "--threads", "1000000"], "threads: expected a whole number, 1 to 1024"),
        (["evolve", "--evaluations", "1" + "0" * 30], "--evaluations: expected a whole number up to 2^53"),
        (["evolve", "--controller", "mlp", "--hidden", "1000000000"], "hidden: expected a whole number, 1 to 1000"),
        (["x" * 5000], "there is no command"),
        (["resume", "y/" * 2500], "turgor: error: "),
    ],
)
def test_a_command_line_is_refused_in_one_short_line(
    argv: list[str], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line
    assert len(line) < 1100
    assert not list(tmp_path.iterdir())


def test_names_that_are_no_text_are_said_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    said = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(said, "ascii"))
    say("\udc80 and ½")
    assert said.getvalue() == b"\\udc80 and \\xbd\n"


# --- properties -----------------------------------------------------------------------------------------------------


@quick
@given(
    st.dictionaries(
        st.text("abcdefghij_", min_size=1, max_size=8),
        arrays(st.sampled_from(["f8", "f4", "i8", "u1", "?"]), array_shapes(min_dims=0, max_dims=3, min_side=0)),
        max_size=4,
    )
)  # fmt: skip
def test_arrays_come_back(tmp_path_factory: pytest.TempPathFactory, given: dict[str, np.ndarray]) -> None:
    path = tmp_path_factory.getbasetemp() / "a.npz"
    write_arrays(path, given)
    back = read_arrays(path)
    assert back.keys() == given.keys()
    for name, array in given.items():
        assert back[name].dtype == array.dtype
        assert np.array_equal(back[name], array, equal_nan=array.dtype.kind == "f")


@quick
@given(st.data())
def test_a_changed_byte_is_refused_or_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "b.npz"
    write_arrays(path, {"theta": np.linspace(0, 1, 30), "fitness": np.array(0.5)})
    whole = read_arrays(path)
    raw = bytearray(path.read_bytes())
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(raw)
    try:
        back = read_arrays(path)
    except InvalidInput:
        return
    assert back.keys() == whole.keys()
    assert all(np.array_equal(back[name], array) for name, array in whole.items())


@quick
@given(
    st.sampled_from(["flat", "hilly", "escape", "inflation"]),
    st.sampled_from(["small", "large"]),
    st.integers(0, 2**53),
    st.fixed_dictionaries(
        {},
        optional={
            "gravity": st.floats(0, 1e9),
            "window": st.integers(1, 10_000),
            "friction": st.floats(0, 1e9),
            "frequency": st.floats(1e-9, 1e9),
            "skin": st.floats(0, 1e9),
            "pressure_unit": st.floats(-1e15, 1e15),
        },
    ),
)
def test_a_task_comes_back_from_json(name: str, body: str, seed: int, variants: dict[str, Any]) -> None:
    task = make_task(name, body=body, seed=seed, steps=5, hill_extent=50.0, **variants)
    again = task_from_json(task_to_json(task))
    assert again.identity == task.identity
    assert task_to_json(again) == task_to_json(task)


ANY = st.floats(width=64) | st.sampled_from(fuzzing.HOSTILE_THETA)


@quick
@given(
    st.integers(0, len(fuzzing.CONTROLLERS) - 1),
    st.sampled_from(["small", "large"]),
    st.sampled_from(["pressure", "springs"]),
    st.sampled_from(["flat", "escape"]),
    st.lists(ANY, min_size=1, max_size=40),
    st.booleans(),
)
def test_hostile_theta_is_refused_or_every_state_is_finite(
    controller: int, body: str, condition: str, task: str, numbers: list[float], everywhere: bool
) -> None:
    simulator = fuzzing._world(controller, task, body, condition)
    count = simulator.task.parameter_count
    theta = np.resize(numbers, count) if everywhere else np.pad(numbers, (0, count))[:count]
    if np.isfinite(theta).all() and np.abs(theta).max() <= 1e15:
        recording = simulator.record(theta)
        fuzzing.expect_finite(recording.position, recording.velocity, recording.pressure, recording.observation)
        assert np.abs(recording.velocity).max() < 120 * simulator.task.physics.max_travel  # max_travel a step
    else:
        with pytest.raises(InvalidInput, match="theta: expected"):
            simulator.record(theta)


@quick
@given(st.recursive(st.none() | st.booleans() | ANY | st.text(max_size=3) | st.integers(), st.lists, max_leaves=6))
def test_what_is_no_array_is_refused(value: Any) -> None:
    try:
        array = as_numbers("value", value)
    except InvalidInput:
        return
    assert array.dtype == np.float64


@quick
@given(st.lists(st.tuples(*[st.floats(-50, 50, width=32)] * 4), max_size=25), st.floats(0.1, 5))
def test_columns_list_exactly_the_segments_in_reach(ends: list[tuple[float, ...]], reach: float) -> None:
    scene = Scene([s for s in ends if np.hypot(s[2] - s[0], s[3] - s[1]) > 0.1])
    if not len(scene.segments):
        scene = flat()
    columns = cut_into_columns(scene, reach)
    x = scene.segments[:, ::2]
    low, high = x.min(axis=1) - reach, x.max(axis=1) + reach
    for left, right, listed, candidates in zip(*columns[7:9], *columns[11:], strict=True):
        expected = np.flatnonzero((low < right) & (high > left))
        assert listed == len(expected)
        assert candidates[:listed].tolist() == expected.tolist()
