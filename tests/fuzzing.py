"""Fuzzing: hostile inputs, what they are put into, and what counts as a failure.

An input is bytes, so that it can be kept in a file and tried again: a file of a run, a command line or a message as
JSON, a theta as JSON that tells how it is made. A `Target` makes inputs from a `random.Random` and tries them on the
code that users reach, in this process. `try_input` says what became of one: refused in one line, or accepted; all
else raises. `tests/fuzz.py` runs many of them under a watchdog, `tests/test_fuzz.py` some.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import json
import math
import os
import shutil
import struct
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import msgspec
import numpy as np

from turgor.cli import main
from turgor.control import MLP, Distributed, Linear, Sinusoid
from turgor.errors import InvalidInput
from turgor.evolution.loop import evolve, resume
from turgor.evolution.worlds import check_worlds, draw_worlds
from turgor.files import DIGEST, write_arrays
from turgor.runs import Run
from turgor.simulate import Simulator
from turgor.task import Task, make_task, task_from_json, task_to_json
from turgor.variants import Robust
from turgor.web.replay import read_header, read_replay, replay_of_run
from turgor.web.server import MESSAGE_BYTES
from turgor.web.session import Control, Drag, Drop, Reset, Session, Start, read
from turgor.web.watch import RunWatch

FILES = ("run.json", "history.csv", "champion.npz", "checkpoint.npz")
ALONE = 128  # added to the first byte of an input: there is no checkpoint to take from what cannot be read
STRATEGIES = ("cma-es", "sep-cma-es", "lm-ma-es", "openai-es")


class Target(NamedTuple):
    """What takes input from outside."""

    name: str
    make: Callable[[Random], bytes]
    use: Callable[[bytes], bool | None]  # False: refused without an exception, as a command does


class Failed(Exception):
    """An input that was neither refused in one line nor came to a good end."""


def try_input(target: Target, data: bytes) -> bool:
    """Whether `target` accepts `data`; what is raised is a failure."""
    try:
        return target.use(data) is not False
    except InvalidInput as refused:
        if len(str(refused).splitlines()) != 1 or len(str(refused)) > 2000:
            raise Failed(f"not one short line: {refused!r}") from None
        return False


# --- mutation -----------------------------------------------------------------------------------------------------

NUMBERS: list[Any] = [
    0, -1, 1, 2, 3, 10**4, 10**6, 10**9, 10**12, 2**31 - 1, 2**31, 2**53, 2**63 - 1, 2**63, 2**64, 10**30, -(2**63),
    0.0, -0.0, 0.5, -0.5, 1e-3, 1e-10, 1e-38, 1e-45, 1e-310, 5e-324, 1e10, 1e15, -1e15, 1e19, 1e30, 1e38, 1e39,
    1e154, 1e300, -1e300, 1.7976931348623157e308, math.nan, math.inf, -math.inf,
]  # fmt: skip
VALUES: list[Any] = [
    *NUMBERS, None, True, False, "", "x", "0", "1e999", "\x00", "\ud800", "é" * 40, "x" * 5000, "function os.system",
    "../../etc/passwd", "pressure", "linear", [], [[]], [[], []], {}, {"": {}}, [0] * 1000, [[0.0, 0.0]] * 1000,
    [[0, 1]] * 3, [math.nan], [1e308, 1e308], {"type": "mlp", "hidden": 10**9}, {"type": "leave", "half_width": -1},
    {"type": "distributed", "hidden": 1000, "messages": 1000}, [[[[[[[[]]]]]]]],
]  # fmt: skip
TOKENS = [
    b"1e999", b"-0", b"9223372036854775808", b"\\u0000", b"NaN", b"Infinity", b"null", b"true", b'"', b"{", b"}", b"[",
    b"]", b",", b":", b"\x00", b"\xff", b"\xed\xa0\x80", b"[" * 2000, b'{"":' * 2000, b"0" * 400, b"1" * 5000, b"\n",
    b"\r", b"-", b".", b"1e-999", b"\xef\xbb\xbf", b'"\\ud800"', b" " * 3000, b",,,,", b"'",
]  # fmt: skip


def mutated(random: Random, data: bytes) -> bytes:
    """`data` with a few bytes flipped, cut, doubled, moved or replaced by tokens."""
    for _ in range(random.choice((1, 1, 1, 2, 4, 16))):
        a, b = sorted(random.randrange(len(data) + 1) for _ in range(2))
        b = min(b, a + random.choice((1, 4, 64, len(data))))
        what = random.randrange(7)
        if what == 0 and data:
            k = random.randrange(len(data))
            data = data[:k] + bytes([data[k] ^ (1 << random.randrange(8))]) + data[k + 1 :]
        elif what == 1:
            data = data[:a] + data[b:]
        elif what == 2:
            data = data[:b] + data[a:b] * random.choice((1, 2, 50)) + data[b:]
        elif what == 3:
            data = data[:a]
        elif what == 4:
            data = data[:a] + random.randbytes(random.choice((1, 4, 40))) + data[b:]
        else:
            data = data[:a] + random.choice(TOKENS) + data[random.choice((a, b)) :]
        data = data[:2_000_000]
    return data


def twisted(random: Random, value: Any) -> Any:
    """`value`, decoded JSON, with a few of its parts replaced by hostile ones, removed, doubled or exchanged."""
    value = json.loads(json.dumps(value))
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        places = list(_places(value))
        if not places:
            return deepcopy(random.choice(VALUES))
        holder, key = random.choice(places)
        what = random.randrange(8)
        if what == 0:
            del holder[key]
        elif what == 1 and isinstance(holder, list):
            holder.insert(key, deepcopy(holder[key]))
        elif what == 1:
            holder[random.choice(("", "x", str(key) + "x", "type", "end"))] = deepcopy(holder[key])
        elif what == 2 and isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
            holder[key] = _rescaled(random, holder[key])
        elif what == 3:
            other, there = random.choice(places)
            with contextlib.suppress(KeyError, IndexError):
                holder[key] = json.loads(json.dumps(other[there]))
        elif what == 4 and isinstance(holder[key], int | float):
            holder[key] = random.choice(NUMBERS)
        else:
            holder[key] = deepcopy(random.choice(VALUES))
    return value


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every (holder, key) in decoded JSON; of long lists some."""
    keys = value if isinstance(value, dict) else range(min(len(value), 12)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from _places(value[key])


def _rescaled(random: Random, number: float) -> float:
    try:
        return random.choice((number * 10 ** random.randint(-40, 40), -number, number + 1, number - 1, 1 / number))
    except (OverflowError, ZeroDivisionError):
        return math.inf


def as_json(value: Any) -> bytes:
    """`value` as JSON, with NaN and Infinity as Python writes them."""
    return json.dumps(value).encode("utf-8", "surrogatepass")


# --- the files of a run -------------------------------------------------------------------------------------------


@cache
def corpus() -> tuple[Path, ...]:
    """Folders of real runs, one for each strategy and controller, made once a process."""
    place = Path(tempfile.mkdtemp(prefix="turgor-fuzz-"))
    import atexit

    atexit.register(shutil.rmtree, place, True)
    tasks = (
        make_task("flat", steps=20),
        make_task("escape", steps=20, controller=Sinusoid(), body="medium"),
        make_task("hilly", steps=20, controller=Distributed(hidden=2), hill_extent=100.0),
        make_task("flat", steps=20, controller=MLP(hidden=2), condition="springs", window=2),
    )
    from functools import partial

    from turgor.evolution.strategy import built_in

    folders = []
    for name, task in zip(STRATEGIES, tasks, strict=True):
        folder = place / name
        recipe = {"name": task.name, "body": "small", "seed": 0}
        strategy = partial(built_in(name), population=4)
        robust = Robust(worlds=2) if task.name == "hilly" else None
        evolve(task, 12, 0, folder, strategy=strategy, threads=1, robust_repeats=2, recipe=recipe, robust=robust)
        folders.append(folder)
    return tuple(folders)


@cache
def scratch() -> Path:
    """An empty folder of this process."""
    return corpus()[0].parent / "scratch"


@cache
def _original(k: int, name: str) -> bytes:
    return (corpus()[k] / name).read_bytes()


def _packed(k: int, data: bytes) -> bytes:
    """An input that says first which run of the corpus the file belongs to."""
    return bytes([k]) + data


def with_file(name: str, data: bytes) -> Path:
    """A folder of a run whose file `name` is `data`."""
    folder, k = scratch(), data[0] % len(corpus())
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for file in FILES:
        (folder / file).write_bytes(data[1:] if file == name else _original(k, file))
    if data[0] >= ALONE:
        for file in {"checkpoint.npz"} - {name}:
            (folder / file).unlink()
        if name == "history.csv":  # as while it grows: without a checksum
            record = json.loads(_original(k, "run.json"))
            (folder / "run.json").write_bytes(sealed({**record, "history": None, "status": "interrupted"}))
    return folder


def look_at(folder: Path) -> None:
    """Has the viewer look at a run: it may find a problem, never more."""
    watch = RunWatch("", folder)
    watch.look()
    msgspec.json.encode(watch.summary)
    if watch.problem is not None and "cannot be read; got" in watch.problem:
        raise Failed(f"the viewer: {watch.problem}")


def make_record(random: Random) -> bytes:
    k = random.randrange(len(corpus()))
    data = _original(k, "run.json")
    if random.random() < 0.25:
        return _packed(k, mutated(random, data))
    return _packed(k, sealed(twisted(random, json.loads(data))) if random.random() < 0.9 else data[:-9] + b"}")


def sealed(record: Any) -> bytes:
    """run.json with the checksum of what it says, so that what is behind that check is reached."""
    if isinstance(record, dict):
        record.pop("checksum", None)
        with contextlib.suppress(msgspec.MsgspecError, OverflowError, UnicodeError, RecursionError):
            fields = msgspec.json.decode(as_json(record))
            record["checksum"] = hashlib.sha256(msgspec.json.encode(fields)).hexdigest()
    return as_json(record)


def use_record(data: bytes) -> None:
    folder = with_file("run.json", data)
    look_at(folder)
    run = Run.open(folder)
    try_task(run.task)
    if run.settings.robust is not None:
        check_worlds(run.task, run.settings.robust)
        for task in draw_worlds(run.task, run.settings.robust, run.settings.seed, 1)[:2]:
            try_task(task)


def try_task(task: Task) -> None:
    """Two steps of two agents."""
    pressure = None if task.pressure is None else task.pressure[:2]
    short = msgspec.structs.replace(task, steps=min(task.steps, 2), pressure=pressure)
    simulator = Simulator(short, threads=1)
    simulator.rollout(np.ones((2, task.parameter_count)))
    task_from_json(task_to_json(task))


def make_history(random: Random) -> bytes:
    k = random.randrange(len(corpus()))
    data = _original(k, "history.csv")
    k += random.choice((0, ALONE))
    if random.random() < 0.5:
        return _packed(k, mutated(random, data))
    rows = [line.split(",") for line in data.decode().splitlines()]
    for _ in range(random.choice((1, 2, 5))):
        row = random.choice(rows) if rows else []
        what = random.randrange(4)
        if what == 0 and row:
            row[random.randrange(len(row))] = str(random.choice(VALUES))[:6000]
        elif what == 1:
            rows.insert(random.randrange(len(rows) + 1), list(row))
        elif what == 2 and rows:
            rows.pop(random.randrange(len(rows)))
        elif row:
            row[random.randrange(len(row))] = f"{random.choice(('', ' ', '+', '0x', '-'))}{random.choice(NUMBERS)}"
    end = random.choice(("\n", "\n", "\n", "\r\n", "", "\r"))
    return _packed(k, "".join(",".join(row) + end for row in rows).encode("utf-8", "surrogatepass"))


def use_history(data: bytes) -> None:
    folder = with_file("history.csv", data)
    look_at(folder)
    run = Run.open(folder)
    assert len(run.history["best"]) == run.generation
    go_on(run)


def make_champion(random: Random) -> bytes:
    return make_arrays(random, "champion.npz")


def use_champion(data: bytes) -> None:
    folder = with_file("champion.npz", data)
    look_at(folder)
    run = Run.open(folder)
    champion = run.checked_champion()
    assert isinstance(repr(champion), str)
    out = Simulator(msgspec.structs.replace(run.task, steps=2), threads=1).rollout(champion.theta[None])
    assert np.isfinite(out.position).all()
    run.write_record()


def make_checkpoint(random: Random) -> bytes:
    return make_arrays(random, "checkpoint.npz")


def use_checkpoint(data: bytes) -> None:
    run = Run.open(with_file("checkpoint.npz", data))
    run.read_checkpoint()
    go_on(run)


def go_on(run: Run) -> None:
    """Resumes the run for a generation, and opens it again."""
    assert run.path is not None
    if run.evaluations > 100:  # a history may say anything; what is told is not evolved anew
        return
    resume(run, run.evaluations + 4, threads=1)
    again = Run.open(run.path)
    assert again.rows == run.rows
    look_at(run.path)


# --- .npz ---------------------------------------------------------------------------------------------------------

DTYPES = [
    "<f8", ">f8", "<f4", "<f2", "<i8", "<i4", "|i1", "|u1", "<u8", "|b1", "<c16", "<U3", "|S3", "<M8[s]", "|V8", "|O",
    "<f16",
]  # fmt: skip
HEADERS = [
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1152921504606846976,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4611686018427387904, 4611686018427387904), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (200000000,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-8, -8), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 99999999999999999999), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (True,), }",
    "{'descr': '<f8', 'fortran_order': True, 'shape': (2, 2), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a', '<f8'), ('b', '|O')], 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (4,), }",
    "{'descr': ('<f8', (1000, 1000, 1000)), 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '|V1000000000', 'fortran_order': False, 'shape': (10,), }",
    "{'descr': '<U1000000000', 'fortran_order': False, 'shape': (), }",
    "{'descr': '|S0', 'fortran_order': False, 'shape': (1000000000000,), }",
    "{'descr': '|V0', 'fortran_order': False, 'shape': (1000000000000,), }",
    "{'descr': '<f8', 'fortran_order': 1, 'shape': [4], }",
    "{'descr': '<f8', 'shape': (4,), }",
    "{'descr': 'nonsense', 'fortran_order': False, 'shape': (4,), }",
    "__import__('os').system('false')",
    "{'descr': '<f8', 'fortran_order': False, 'shape': " + "(" * 3000 + ", }",
    "{" * 60000,
    "",
    "[]",
    "\x00" * 100,
]


def make_arrays(random: Random, name: str) -> bytes:
    """A .npz file that was `name` of a run."""
    k = random.randrange(len(corpus()))
    data = _original(k, name)
    k += random.choice((0, ALONE))
    if random.random() < 0.25:
        return _packed(k, mutated(random, data))
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files if name != DIGEST}
    if random.random() < 0.6:
        return _packed(k, saved(other_arrays(random, arrays)))
    return _packed(k, other_archive(random, {f"{n}.npy": _npy(a) for n, a in arrays.items()}))


def saved(arrays: dict[str, np.ndarray]) -> bytes:
    """The bytes that turgor writes, whatever the arrays are."""
    with tempfile.TemporaryDirectory(dir=corpus()[0].parent) as place:
        path = Path(place) / "a.npz"
        try:
            write_arrays(path, arrays)
        except (AssertionError, ValueError):  # nothing that turgor would write
            np.savez(path, **{name: a for name, a in arrays.items() if name != "file"})  # ty: ignore
        return path.read_bytes()


def other_arrays(random: Random, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays with other names, shapes, types and numbers."""
    for _ in range(random.choice((1, 1, 2, 3))):
        name = random.choice(sorted(arrays))
        array = arrays[name]
        what = random.randrange(7)
        if what == 0:
            del arrays[name]
        elif what == 1:
            arrays[random.choice(("x", "strategy_x", "theta", "solver_theta", name + "x"))] = array
        elif what == 2:
            shapes = ((), (0,), (1,), (2, 2), (*array.shape, 1), (1, *array.shape), (7,), (0, 5))
            arrays[name] = np.resize(array, random.choice(shapes))
        elif what == 3:
            with contextlib.suppress(ValueError, TypeError, RuntimeError), np.errstate(all="ignore"):
                arrays[name] = array.astype(random.choice(DTYPES))
        elif what == 4:
            arrays[name] = np.full(array.shape, random.choice(("x", b"y", True, 1j, 2**63, -1, 0.5)))
        else:
            number = random.choice(NUMBERS)
            with contextlib.suppress(OverflowError, ValueError, TypeError), np.errstate(all="ignore"):
                array = np.array(array)
                if random.random() < 0.5 or not array.ndim:
                    array[...] = number
                elif array.size:
                    array.flat[random.randrange(array.size)] = number
                arrays[name] = array
        if not arrays:
            break
    return arrays


def _npy(array: np.ndarray) -> bytes:
    data = io.BytesIO()
    np.lib.format.write_array(data, np.asarray(array))
    return data.getvalue()


def other_archive(random: Random, members: dict[str, bytes]) -> bytes:
    """A zip file of `members` with hostile headers, names, sizes and checksums."""
    name = random.choice(sorted(members))
    what = random.randrange(8)
    entries = list(members.items())
    place = entries.index((name, members[name]))
    method = zipfile.ZIP_STORED
    if what <= 1:
        text = random.choice(HEADERS).encode("latin1")
        version = random.choice((b"\x01\x00", b"\x01\x00", b"\x02\x00", b"\x03\x00", b"\x09\x00"))
        size = struct.pack("<H" if version == b"\x01\x00" else "<I", min(len(text), 65535))
        entries[place] = (name, b"\x93NUMPY" + version + size + text + bytes(32))
    elif what == 2:  # a bomb
        method = zipfile.ZIP_DEFLATED
        entries[place] = (name, _bomb(random.choice((10**5, 10**7))))
    elif what == 3:
        entries.append(random.choice(entries))
    elif what == 4:
        entries[place] = (random.choice(("../x.npy", "/etc/x.npy", name[:-4], "é.npy", "file.npy")), b"x")
    elif what == 5:
        entries[place] = (name, mutated(random, members[name]))
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", method) as archive:
        for key, value in entries:
            archive.writestr(key, value)
    raw = bytearray(data.getvalue())
    if what >= 5:  # the fields of one of the archive's own records
        marks = (b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06")
        starts = [k for mark in marks for k in _all(bytes(raw), mark)]
        at = random.choice(starts) + random.randrange(4, 46)
        hostile = random.choice(
            (b"\xff\xff\xff\xff", b"\x00\x00\x00\x00", b"\x01\x00", b"\x63\x00", b"\x7f\xff\xff\xff")
        )
        raw[at : at + len(hostile)] = hostile
    return bytes(raw)


@cache
def _bomb(count: int) -> bytes:
    return _npy(np.zeros(count))


def _all(data: bytes, mark: bytes) -> Iterator[int]:
    at = data.find(mark)
    while at >= 0:
        yield at
        at = data.find(mark, at + 1)


# --- tasks and replays --------------------------------------------------------------------------------------------


def make_json_task(random: Random) -> bytes:
    data = msgspec.json.decode(_original(random.randrange(len(corpus())), "run.json"))["task"]
    if random.random() < 0.2:
        return mutated(random, as_json(data))
    return as_json(twisted(random, data))


def use_json_task(data: bytes) -> None:
    try_task(task_from_json(data))


@cache
def _replay() -> bytes:
    return replay_of_run(corpus()[1])


def make_replay(random: Random) -> bytes:
    data = _replay()
    if random.random() < 0.4:
        return mutated(random, data)
    end = 8 + struct.unpack("<I", data[4:8])[0]
    header, stream = json.loads(data[8:end]), data[end:]
    if random.random() < 0.2:
        stream = zlib.compress(bytes(random.choice((0, 10**4, 10**7, 10**8))))
    text = as_json(twisted(random, header))
    return data[:4] + struct.pack("<I", len(text)) + text + stream


def use_replay(data: bytes) -> None:
    read_header(data)
    read_replay(data)


# --- theta, commands, starts, pushes, actions -----------------------------------------------------------------------

CONTROLLERS = (Linear(), MLP(hidden=3), Sinusoid(), Distributed(hidden=3, messages=2))
HOSTILE_THETA = [
    math.inf, -math.inf, math.nan, 1e30, -1e30, 1e15, -1e15, 9.99e14, 1e16, 3.5e38, 1e-310, 5e-324, 1e-45, 1e-38, -0.0,
    0.0, 1e6, -1e6, 1e-7, 3.0, 127.0, -1e-40, 1e-20,
]  # fmt: skip
WAYS = ("rollout", "record", "step", "position", "push", "env", "odd")
ODD: list[Any] = [None, "x", True, 3, [], [[]], [["x"]], {"a": 1}, [[None]], [[1], [1, 2]], [[[0.0]]], "\x00"]


@cache
def _world(controller: int, task: str, body: str, condition: str) -> Simulator:
    return Simulator(
        make_task(task, body=body, condition=condition, controller=CONTROLLERS[controller], steps=40), threads=1
    )


def make_theta(random: Random) -> bytes:
    """How hostile numbers are laid out, as JSON: rows of [index, number] over a background."""
    return as_json(
        {
            "way": random.choice(WAYS),
            "controller": random.randrange(len(CONTROLLERS)),
            "task": random.choice(("flat", "hilly", "escape")),
            "body": random.choice(("small", "medium", "large")),
            "condition": random.choice(("pressure", "springs")),
            "background": random.choice(("zero", "normal", "all", "alternate")),
            "numbers": [random.choice(HOSTILE_THETA) for _ in range(random.choice((1, 2, 8)))],
            "seed": random.randrange(2**31),
            "odd": random.randrange(len(ODD)),
        }
    )


def hostile_array(spec: dict[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    """The numbers of `spec` in an array: all of it, turn by turn with both signs, or in a few places."""
    draw, numbers = np.random.default_rng(spec["seed"]), np.array(spec["numbers"], dtype=np.float64)
    if spec["background"] == "all":
        return np.resize(numbers, shape)
    if spec["background"] == "alternate":
        return np.resize(np.stack([numbers, -numbers], axis=1).ravel(), shape)
    array = draw.standard_normal(shape) if spec["background"] == "normal" else np.zeros(shape)
    if array.size:
        array.flat[draw.integers(array.size, size=len(numbers))] = numbers
    return array


def use_theta(data: bytes) -> None:
    spec = json.loads(data)
    simulator = _world(spec["controller"], spec["task"], spec["body"], spec["condition"])
    task, way = simulator.task, spec["way"]
    masses = task.body.mass_count
    outputs = task.body.spring_count + (task.condition == "pressure")
    start = task.position[None].repeat(2, axis=0)
    if way == "odd":
        _odd(simulator, ODD[spec["odd"]])
    elif way == "rollout":
        out = simulator.rollout(hostile_array(spec, (2, task.parameter_count)))
        expect_finite(out.position, out.com, out.fitness)
    elif way == "record":
        recording = simulator.record(hostile_array(spec, (task.parameter_count,)))
        expect_finite(recording.position, recording.velocity, recording.pressure, recording.observation)
    elif way == "position":
        out = simulator.rollout(np.zeros((2, task.parameter_count)), start + hostile_array(spec, start.shape))
        expect_finite(out.position, out.com, out.fitness)
    elif way == "env":
        _act(spec, task)
    else:
        now = simulator.reset(2)
        for k in range(20):
            if way == "push" and k % 5 == 0:
                simulator.push(hostile_array(spec, (2, masses, 2)))
            commands = hostile_array(spec, (2, outputs)) if way == "step" else np.zeros((2, outputs))
            now = simulator.step(commands, out=now)
            expect_finite(now.position, now.velocity, now.pressure, now.observation)


def _odd(simulator: Simulator, value: Any) -> None:
    """Things that are no arrays, wherever an array is expected; one of them is to refuse it."""
    simulator.reset(1)
    verbs = (simulator.step, simulator.push, simulator.restart, simulator.rollout, simulator.record)
    refused = 0
    for verb in verbs:
        try:
            verb(value)
        except InvalidInput:
            refused += 1
    theta = np.zeros((1, simulator.task.parameter_count))
    if value is not None:
        with contextlib.suppress(InvalidInput):
            simulator.rollout(theta, value)
        with contextlib.suppress(InvalidInput):
            simulator.reset(1, value)
    if refused != len(verbs):
        raise Failed(f"{value!r} was taken by {len(verbs) - refused} of {len(verbs)}")
    raise InvalidInput("refused by all")


def _act(spec: dict[str, Any], task: Task) -> None:
    import gymnasium as gym

    env = _environment(spec["task"], spec["body"], spec["condition"])
    observation, _ = env.reset(seed=spec["seed"])
    for _ in range(10):
        try:
            action = hostile_array(spec, env.action_space.shape)
            observation, reward, terminated, truncated, _ = env.step(action)
        except gym.error.InvalidAction as refused:
            raise InvalidInput(str(refused)) from None
        expect_finite(observation, np.array(reward))
        if terminated or truncated:
            break


@cache
def _environment(task: str, body: str, condition: str) -> Any:
    import gymnasium as gym

    import turgor  # noqa: F401

    name = {"flat": "Flat", "hilly": "Hilly", "escape": "Escape"}[task]
    return gym.make(f"turgor/{name}-v0", body=body, condition=condition, disable_env_checker=True)


def expect_finite(*arrays: np.ndarray) -> None:
    for array in arrays:
        if not np.isfinite(array).all():
            raise Failed("NaN or infinity in what was simulated")


# --- messages -----------------------------------------------------------------------------------------------------

MESSAGES: list[dict[str, Any]] = [
    {"type": "start", "task": "hilly", "body": "small", "seed": 3, "gravity": 10.0, "frequency": 8.0},
    {"type": "start", "task": "flat", "body": "large"},
    {"type": "control", "pressure": 0.5, "wave": {"amplitude": 1.0, "frequency": 1.0, "length": 1.0, "direction": -1}},
    {"type": "control", "pressure": 0.7},
    {"type": "drag", "mass": 3, "x": 1.0, "y": -2.0},
    {"type": "drop"},
    {"type": "pause", "on": True},
    {"type": "reset"},
    {"type": "seen"},
]


def make_message(random: Random) -> bytes:
    message = random.choice(MESSAGES)
    if random.random() < 0.3:
        return mutated(random, as_json(message))
    return as_json(twisted(random, message))


@cache
def _session() -> Session:
    return Session(Start(task="flat"))


def use_message(data: bytes) -> None:
    """The message of a visitor in the middle of a session, and a step after it."""
    try:
        event: dict[str, Any] = {"text": data.decode("utf-8", "surrogatepass")}
    except UnicodeDecodeError:
        event = {"bytes": data}
    message, session = read(event), _session()
    if isinstance(message, Start):
        session = Session(message)
    elif isinstance(message, Control):
        session.tell(message)
    elif isinstance(message, Drag):
        session.drag(message)
    elif isinstance(message, Drop):
        session.drag(None)
    elif isinstance(message, Reset):
        session.restart()
    session.step()
    expect_finite(np.frombuffer(session.frame()[: 12 + 8 * session.task.body.mass_count], "<f4"))
    json.loads(session.scene())
    if session.lost:
        session.restart()


# --- the viewer's server ------------------------------------------------------------------------------------------

REQUESTS = (b"/", b"/api/library", b"/api/run/cma-es", b"/api/replay/lm-ma-es", b"/api/campaign/", b"/static/run.js")
HEADER_LINES = [
    b"Host: 127.0.0.1", b"Host: evil.example", b"Origin: http://evil.example", b"Cookie: turgor=x; ;=;", 
    b"Range: bytes=-",
    b"Range: bytes=0-99999999999999999999", b"Content-Length: 99999999999999999999", b"Content-Length: -1",
    b"Transfer-Encoding: chunked", b"Upgrade: websocket", b"Sec-WebSocket-Key: x", b"X: " + b"y" * 70000, b": ",
    b"\x00: x",
    b"If-Modified-Since: yesterday", b"If-None-Match: *", b"Accept-Encoding: " + b"gzip," * 500,
    b"Expect: 100-continue",
]  # fmt: skip


@cache
def served() -> tuple[str, int]:
    """Host and port of a real server of the viewer, over the corpus, in a thread."""
    import threading

    from turgor.web.library import Library
    from turgor.web.server import Server, listen, make_app

    listener = listen("127.0.0.1", 0)
    port = listener.getsockname()[1]
    app, hub = make_app(Library(corpus()[0].parent), host="127.0.0.1", port=port, token=None)
    ready = threading.Event()
    server = Server(app, hub, ready.set)
    threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True).start()
    assert ready.wait(30)
    return "127.0.0.1", port


def make_request(random: Random) -> bytes:
    path = random.choice(REQUESTS)
    if random.random() < 0.7:
        junk = (
            b"%00",
            b"..",
            b"/",
            b"%2e%2e/",
            b"%ff",
            b"?which=x",
            b"?token=%00",
            b"//",
            b"%",
            b"\xff",
            b"a" * 9000,
            b"#",
        )
        k = random.randrange(len(path) + 1)
        path = path[:k] + random.choice(junk) * random.choice((1, 2, 20)) + path[k:]
    lines = [random.choice((b"GET", b"GET", b"GET", b"HEAD", b"POST", b"X" * 300, b"")) + b" " + path + b" HTTP/1.1"]
    lines += [b"Host: 127.0.0.1:%d"] if random.random() < 0.9 else []
    lines += [random.choice(HEADER_LINES) for _ in range(random.choice((0, 0, 1, 2)))]
    data = b"\r\n".join([*lines, b"Connection: close", b"", b""])
    return mutated(random, data) if random.random() < 0.3 else data


def use_request(data: bytes) -> bool:
    """Sends raw bytes to the server, which answers or hangs up, and never with an error of its own."""
    import socket

    host, port = served()
    with socket.create_connection((host, port), timeout=5) as client:
        with contextlib.suppress(OSError):
            client.sendall(data.replace(b"%d", str(port).encode()))
        answer = b""
        client.settimeout(0.3)  # of an unfinished request there is no answer
        with contextlib.suppress(ConnectionError, TimeoutError):
            while more := client.recv(65536):
                answer += more
                if b"text/event-stream" in answer[:2000]:
                    break
    status = answer[9:12]
    if status.startswith(b"5") or b"Traceback" in answer:
        raise Failed(f"answered {answer[:200]!r}")
    return status.startswith(b"2")


def make_visit(random: Random) -> bytes:
    """Messages of one visitor, as JSON: text, or {"bytes": hex}."""
    said: list[Any] = [json.dumps(MESSAGES[1])] if random.random() < 0.8 else []
    for _ in range(random.choice((1, 5, 20))):
        data = make_message(random)
        try:
            said.append(data.decode())
        except UnicodeDecodeError:
            said.append({"bytes": data.hex()})
    return as_json(said)


def use_visit(data: bytes) -> None:
    """A visit to the playground on a real socket: it ends without an error of the server's."""
    asyncio.run(_visit(json.loads(data)))


async def _visit(messages: list[Any]) -> None:
    import websockets

    host, port = served()
    try:
        async with asyncio.timeout(10), websockets.connect(f"ws://{host}:{port}/api/play", max_size=None) as socket:
            for said in [*messages, '{"type":"farewell"}']:
                with contextlib.suppress(UnicodeEncodeError):  # nothing that can be sent
                    await socket.send(bytes.fromhex(said["bytes"]) if isinstance(said, dict) else said)
            while "farewell" not in str(await socket.recv()):
                pass
    except TimeoutError:
        raise Failed("no answer in 10 s") from None
    except websockets.ConnectionClosed as end:
        if any(len(as_json(said)) > MESSAGE_BYTES for said in messages):  # hung up on, at times before it is told why
            raise InvalidInput("a message that is too long") from None
        if end.rcvd is None or end.rcvd.code == 1011:
            raise Failed(f"the visit ended with {end}") from None


# --- command lines ------------------------------------------------------------------------------------------------

WORDS = [
    "", " ", "x", "-", "--", "-1", "0", "1", "nan", "inf", "-inf", "1e999", "1e-320",
    "10000000000000000000000000000000",
    "1" * 400, "1" * 5000, "1e30", "-0", "0x10", "1_000", "1,000", "½", "٣", "é", "\x00", "a\x00b", "\udc80",
    "x" * 5000, "a/" * 3000, "../x", "true", "None", "[]", "{}", "%s%n", "\n", "a\nb", "\x1b[31m", "--help", "--seed",
    "@file", "=",
    "1000000000000", "1000000", "100000x100000", "0x0", "1x1", "-5x-5", "64x64x64", "9" * 30 + "x2", "nanxnan",
]  # fmt: skip
PATHS = ["", ".", "..", "/dev/null", "/dev/null/x", "/proc/self/nothing/x", "a\x00b", "\udc80", "x" * 300, "y/" * 2500,
         "new/deep/er", "file.txt", "run", "é", "-", "--", "~", "run/run.json", "/dev/full"]  # fmt: skip
# what would be long or large if it were accepted, and is not: these take no number that is merely large
LASTING = {"--evaluations", "--steps", "--repeats", "--robust-worlds", "--seeds", "--to", "--size"}
REFUSED_NUMBERS = [w for w in WORDS if w not in ("1000000000000", "1000000", "1,000", "1_000", "٣")]


@cache
def options_of(name: str) -> tuple[str, ...]:
    """The options of a command, as its help has them."""
    from turgor.cli import COMMANDS
    from turgor.cli.command import Parser

    parser = Parser("turgor", "", "")
    COMMANDS[name].options(parser)
    return tuple(sorted(parser._option_string_actions))


CHEAP: dict[str, list[str]] = {
    "evolve": ["--task", "flat", "--controller", "sinusoid", "--evaluations", "4", "--population", "4", "--steps", "3",
               "--no-video", "--out", "out", "--threads", "1"],
    "resume": ["run", "--evaluations", "13", "--no-video", "--threads", "1"],
    "evaluate": ["run", "--repeats", "2", "--threads", "1"],
    "video": ["run", "--size", "64x64", "--to", "0.05", "--out", "v.mp4"],
    "export": ["run", "--out", "r.html"],
    # those that would go on for long have something that is refused
    "view": ["nothing-there", "--no-browser"],
    "reproduce": ["--body", "tiny", "--out", "campaign"],
    "crosscheck": ["run", "--engines", "nothing", "--out", "crossed"],
    "bench": ["--only", "nothing"],
}  # fmt: skip


def make_command(random: Random) -> bytes:
    """A list of arguments as JSON."""
    name = random.choice(tuple(CHEAP))
    argv = [name, *CHEAP[name]]
    for _ in range(random.choice((1, 1, 2, 3))):
        what = random.random()
        option = random.choice(options_of(name))
        words = PATHS if option in ("--out", "--json", "--csv", "--gallery", "--campaign") else WORDS
        words = REFUSED_NUMBERS if option in LASTING else words
        value = random.choice(words)
        if what < 0.6:
            if option in argv:
                at = argv.index(option)
                argv[at + 1 : at + 2] = [value]
            elif random.random() < 0.5:
                argv += [option, value]
            else:
                argv.append(f"{option}={value}")
        elif what < 0.7 and name in ("resume", "evaluate", "video", "export", "crosscheck"):
            argv[1] = random.choice(PATHS)
        elif what < 0.8 and name not in ("view", "reproduce", "bench"):
            argv.insert(random.randrange(1, len(argv) + 1), random.choice(REFUSED_NUMBERS))
        elif what < 0.9 and name in ("view", "reproduce", "bench"):
            argv += [random.choice(("--host", "--port", "--threads", "--seeds", "--nonsense")), random.choice(WORDS)]
        elif what < 0.93:
            argv = [random.choice(("", "evolv", "-h", "--version", "help", "\x00", "x" * 5000)), *argv[1:]]
    return json.dumps(argv).encode()


def use_command(data: bytes) -> bool:
    """The command in an empty folder that has a run in it; whether it ended with 0."""
    argv = json.loads(data)
    place, before = scratch(), Path.cwd()
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    shutil.copytree(corpus()[1], place / "run")
    (place / "file.txt").write_text("mine")
    out, err = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace")
    try:
        os.chdir(place)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(argv)
    finally:
        os.chdir(before)
    told, said = (file.seek(0) or file.read() for file in (err, out))
    if status not in (0, 2, 130) or len(told.split("\n")) > 2 or "Traceback" in told + said:
        raise Failed(f"status {status}: {told[-500:]}")
    if status == 2 and (not told.startswith("turgor: error: ") or "not enough memory" in told or len(told) > 2000):
        raise Failed(f"told in another way: {told[:500]}")
    return status == 0


TARGETS = {
    target.name: target
    for target in (
        Target("run.json", make_record, use_record),
        Target("history.csv", make_history, use_history),
        Target("champion.npz", make_champion, use_champion),
        Target("checkpoint.npz", make_checkpoint, use_checkpoint),
        Target("command", make_command, use_command),
        Target("message", make_message, use_message),
        Target("visit", make_visit, use_visit),
        Target("request", make_request, use_request),
        Target("task", make_json_task, use_json_task),
        Target("replay", make_replay, use_replay),
        Target("theta", make_theta, use_theta),
    )
}


def input_of(target: Target, seed: int, k: int) -> bytes:
    """Input `k` of a target: the same for the same `seed`, whatever was tried before."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of NumPy and zipfile, at what they are made to write
        return target.make(Random(f"{seed} {target.name} {k}"))
