"""Replays: a `Recording` as one compact binary file for the browser, and back.

All numbers are little endian:

    bytes 0 to 3    the ASCII letters TGR1
    bytes 4 to 7    uint32 N, the length of the header
    N bytes         the header: JSON in UTF-8
    the rest        one zlib stream ("deflate" of DecompressionStream): the arrays, one after the other, no padding

The header's fields (`Header`, where the units are) end with `arrays`: name, type and shape of each array in the order
of the stream, the last axis fastest. Index t is the state after step t, as in a `Recording`:

    origin     int32    [mass, 2]                      position at t = 0 [mm]
    position   int16    [steps, mass, 2]               position at t + 1 - that at t [mm]; int32 where needed
    rest       uint8    [steps + 1, spring]            commanded length: 0 is spring_range[0], 255 spring_range[1]
    pressure   float32  [steps + 1, chamber]           [Pa]
    touch      uint8    [steps + 1, ceil(mass / 8)]    a bit a mass, the first the highest of its byte; 1: it touches

Positions are rounded, then subtracted: no error adds up, and every one is within 0.5 mm.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from turgor.arrays import LARGEST
from turgor.body import SIZES
from turgor.control import CONTROLLERS
from turgor.errors import InvalidInput, describe, one_of
from turgor.recording import Recording
from turgor.runs import Run
from turgor.scene import Scene
from turgor.task import Leave, Task
from turgor.view.shapes import SOLID, span, wall_shapes

MAGIC = b"TGR1"
FORMAT = 1
MILLIMETRE = 1e-3  # [m], what a position is rounded to
FACTS = ("title", "unit", "fitness", "robust", "solved", "name", "body", "condition", "controller", "seed")
WHICH = ("best", "solver")
REPLAY_BYTES = 200_000_000  # of its arrays, at most


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay says of itself before its arrays."""

    format: int = FORMAT
    title: str
    unit: str  # of the fitness, with a space before it
    fitness: float | None
    robust: float | None  # median fitness from moved starts
    solved: bool
    dt: float  # [s]
    steps: int
    masses: int
    springs: list[list[int]]  # the two masses of each
    chambers: list[list[int]]  # loops of masses
    angle: list[float]  # [rad], of each square
    side: list[float]  # [m], of each square
    rest: list[float]  # [m], L0 of each spring
    spring_range: tuple[float, float]  # [1], what the array `rest` spans, of L0
    strain_range: tuple[float, float]  # [1], what the springs' colours span, of L0
    pressure_range: tuple[float, float]  # [Pa], p_min and p_max; without a task what was recorded
    area_reference: list[float]  # [m^2], pi r^2 of each chamber
    mass: list[float]  # [kg]
    radius: float  # [m], of the body at rest
    extent: float  # [m], largest of the body's width and height at rest
    scene: dict[str, Any]  # of `scene_facts`
    end: float | None  # [m], half width that has to be left
    name: str
    body: str
    condition: str
    controller: str
    seed: int | None
    arrays: list[dict[str, Any]]


def replay_of_run(path: Path, which: str = "best", every: int = 1) -> bytes:
    """The replay of the champion of the run in the folder `path`: its best agent, or the best that solved the task.

    `which` is "best" or "solver"; of the steps, one in `every` is kept. Raises `InvalidInput`.
    """
    if which not in WHICH:
        raise one_of("which", WHICH, which)
    run = Run.open(path)
    champion = run.checked_champion()
    if which == "solver":
        if run.solver is None:
            raise InvalidInput(f"{path}: expected a run in which an agent solved the task", "none so far")
        champion = run.solver
    from turgor.simulate import Simulator  # compiles the engine

    recording = Simulator(run.task, threads=1).record(champion.theta)
    facts = {"robust": champion.robust_fitness, **facts_of_run(run)}
    if run.settings.robust is None:  # else it was chosen for what it achieved in other worlds than the one that is seen
        facts |= {"fitness": champion.fitness, "solved": champion.solved}
    return replay_of_recording(recording, run.task, every=every, **facts)


def facts_of_run(run: Run) -> dict[str, Any]:
    """What a run's replay is called, and what it says of the task."""
    task, recipe = run.task, run.settings.recipe or {}
    body = recipe.get("body")
    body = body if isinstance(body, str) and body in SIZES else "custom"
    controller = next(name for name, kind in CONTROLLERS.items() if kind is type(task.controller))
    controlled = [task.condition] if controller == "linear" else [task.condition, controller]
    robust = ["robust"] if run.settings.robust else []
    seed = recipe.get("seed", run.settings.seed)
    return {
        "title": ", ".join([task.name, body, *controlled, *robust, f"seed {seed}"]),
        "unit": " m/s" if task.fitness in ("progress", "distance", "elapsed") else "",
        "name": task.name,
        "body": body,
        "condition": task.condition,
        "controller": controller,
        "seed": seed,
    }


def replay_of_recording(recording: Recording, task: Task | None = None, *, every: int = 1, **facts: Any) -> bytes:
    """The replay of `recording`, of which one step in `every` is kept.

    `task`: where the ends of the pressure and of the scene come from; `facts` are those of `FACTS`. Raises
    `InvalidInput` for a recording that cannot be written.
    """
    for name in facts:
        if name not in FACTS:
            raise one_of("fact", FACTS, name)
    if not isinstance(every, int) or every < 1:
        raise InvalidInput("every: expected a whole number, at least 1", describe(every))
    body = recording.body
    position = np.asarray(recording.position, dtype=np.float64)[::every]
    if not (np.abs(position) < 2**30 * MILLIMETRE).all():  # NaN as well
        raise InvalidInput("recording: expected finite positions within 1000 km", "NaN, infinity or further")
    arrays, spring_range = _arrays(recording, position, every)
    defaults: dict[str, Any] = {
        "title": "",
        "unit": "",
        "fitness": recording.fitness,
        "robust": None,
        "solved": recording.solved,
        "name": "" if task is None else task.name,
        "body": "custom",
        "condition": "" if task is None else task.condition,
        "controller": "",
        "seed": None,
    }
    reach = max(float((1 - body.shortest).max(initial=0)), float((body.longest - 1).max(initial=0)), 0.05)
    limits = np.zeros((0, 2)) if task is None else task.pressure_range
    gas = (float(limits[:, 0].min()), float(limits[:, 1].max())) if len(limits) else span(recording.pressure)
    radii = [body.chamber_radius(c) for c in range(body.chamber_count)]
    extent = (np.ptp(body.position, axis=0) + body.side.max()).max()
    header = Header(
        dt=recording.dt * every,
        steps=len(position) - 1,
        masses=body.mass_count,
        springs=body.springs.tolist(),
        chambers=[list(loop) for loop in body.chambers],
        angle=body.angle.tolist(),
        side=body.side.tolist(),
        rest=body.rest_length.tolist(),
        spring_range=spring_range,
        strain_range=(1 - reach, 1 + reach),
        pressure_range=gas,
        area_reference=[math.pi * r**2 for r in radii],
        mass=body.mass.tolist(),
        radius=body.radius,
        extent=float(extent),
        scene=scene_facts(recording.scene),
        end=task.end.half_width if task is not None and isinstance(task.end, Leave) else None,
        arrays=[{"name": n, "type": a.dtype.name, "shape": list(a.shape)} for n, a in arrays.items()],
        **{**defaults, **facts},
    )
    text = msgspec.json.encode(header)
    stream = b"".join(a.astype(a.dtype.newbyteorder("<"), copy=False).tobytes() for a in arrays.values())
    return MAGIC + struct.pack("<I", len(text)) + text + zlib.compress(stream, 9)


def _arrays(
    recording: Recording, position: np.ndarray, every: int
) -> tuple[dict[str, np.ndarray], tuple[float, float]]:
    """The arrays in the order of the stream, and what `rest` spans [1]."""
    body = recording.body
    millimetres = np.rint(position / MILLIMETRE).astype(np.int64)
    moved = np.diff(millimetres, axis=0)
    kind = np.int16 if np.abs(moved).max(initial=0) < 2**15 else np.int32
    share = np.asarray(recording.rest_length, dtype=np.float64)[::every] / body.rest_length  # of L0
    low = min(float(body.shortest.min(initial=1)), float(share.min(initial=1)))
    high = max(float(body.longest.max(initial=1)), float(share.max(initial=1)), low + 1e-6)
    touch = np.asarray(recording.touch, dtype=bool)
    # that a mass touched something in a step that is left out is not lost
    kept = [touch[max(t - every + 1, 0) : t + 1].any(axis=0) for t in range(0, len(touch), every)]
    arrays = {
        "origin": millimetres[0].astype(np.int32),
        "position": moved.astype(kind),
        "rest": np.rint(255 * (share - low) / (high - low)).astype(np.uint8),
        "pressure": np.asarray(recording.pressure, dtype=np.float32)[::every],
        "touch": np.packbits(np.array(kept), axis=1),
    }
    return arrays, (low, high)


def scene_facts(scene: Scene) -> dict[str, Any]:
    """A scene for the browser: its segments [m] and depths [m], and the polygons [m] that its walls are drawn as."""
    polygons: dict[str, list[Any]] = {"solid": [], "surface": []}
    for colour, corners in wall_shapes(scene):
        polygons["solid" if colour == SOLID else "surface"].append(corners.round(4).tolist())
    return {"segments": scene.segments.round(4).tolist(), "depth": scene.depth.tolist(), **polygons}


class Replay(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A replay that was read."""

    header: Header
    position: np.ndarray  # [m], shape [step + 1, mass, 2]
    rest_length: np.ndarray  # [m], shape [step + 1, spring]
    pressure: np.ndarray  # [Pa], shape [step + 1, chamber]
    touch: np.ndarray  # bool, shape [step + 1, mass]


Kind = Literal["int32", "int16", "uint8", "float32"]
BROKEN = (ValueError, KeyError, TypeError, OverflowError, RecursionError, struct.error, zlib.error, msgspec.DecodeError)


def read_replay(data: bytes) -> Replay:
    """The `Replay` in `data`; raises `InvalidInput` for anything else."""
    try:
        header, end = _header(data)
        declared = [
            (math.prod(entry["shape"]), np.dtype(msgspec.convert(entry["type"], Kind))) for entry in header.arrays
        ]
        size = sum(count * kind.itemsize for count, kind in declared)
        if not 0 <= size <= REPLAY_BYTES:
            raise ValueError(f"arrays of {size} bytes")
        unpack, first, arrays = zlib.decompressobj(), 0, {}
        stream = unpack.decompress(data[end:], size + 1)
        if len(stream) != size or not unpack.eof:
            raise ValueError(f"a stream that is not of {size} bytes")
        for entry in header.arrays:
            kind, shape = np.dtype(msgspec.convert(entry["type"], Kind)).newbyteorder("<"), entry["shape"]
            count = math.prod(shape)
            arrays[entry["name"]] = np.frombuffer(stream, kind, count, first).reshape(shape)
            first += count * kind.itemsize
        moved = np.concatenate([arrays["origin"][None], arrays["position"]]).astype(np.int64)
        if moved.shape[1:] != (header.masses, 2):
            raise ValueError(f"positions of shape {list(moved.shape)}")
        low, high = header.spring_range
        if not max(abs(low), abs(high), *map(abs, header.rest)) <= LARGEST:
            raise ValueError("springs of no length")
        return Replay(
            header=header,
            position=moved.cumsum(axis=0) * MILLIMETRE,
            rest_length=(low + arrays["rest"] * ((high - low) / 255)) * np.array(header.rest),
            pressure=arrays["pressure"],
            touch=np.unpackbits(arrays["touch"], axis=1, count=header.masses).astype(bool),
        )
    except BROKEN as error:
        raise InvalidInput("replay: expected the bytes of a replay", describe(error)) from None


def read_header(data: bytes) -> Header:
    """The `Header` of the replay in `data`, without its arrays; raises `InvalidInput` for anything else."""
    try:
        return _header(data)[0]
    except BROKEN as error:
        raise InvalidInput("replay: expected the bytes of a replay", describe(error)) from None


def _header(data: bytes) -> tuple[Header, int]:
    """The header, and where the arrays begin."""
    if data[:4] != MAGIC:
        raise ValueError(f"the first bytes {data[:4]!r}")
    end = 8 + struct.unpack("<I", data[4:8])[0]
    return msgspec.json.decode(data[8:end], type=Header), end
