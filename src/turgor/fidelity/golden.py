"""The golden data of Box2D 2.3.2 (tests/golden), replayed in any engine: how fast do trajectories part from it?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from turgor.body import LARGE, MEDIUM, SMALL, Body
from turgor.errors import InvalidInput
from turgor.fidelity.compare import HERE
from turgor.fidelity.drive import Script, new_trace, run
from turgor.fidelity.engines import load_world
from turgor.scene import GROUND_DEPTH, Scene, flat
from turgor.simulate import replay
from turgor.task import Physics, Task

FOLDER = Path(__file__).parents[3] / "tests" / "golden"  # of the repository; not part of the installed package
BODIES = {"small": SMALL, "medium": MEDIUM, "large": LARGE}
STEPS = (30, 60, 120, 300)  # at which errors are told
CURVE = 10  # [step], between the points of a curve


class Case(NamedTuple):
    """A body under a given course of springs and gas, and where Box2D 2.3.2 saw it go."""

    file: str
    name: str
    says: str
    body: Body
    scene: Scene
    two_sided: bool  # something meets a segment from behind
    gravity: float  # [m/s^2]
    position: np.ndarray  # [m], shape [mass, 2], the start
    velocity: np.ndarray  # [m/s], shape [mass, 2]
    script: Script
    frames: np.ndarray  # [frame], steps
    expected: np.ndarray  # [m], shape [frame, mass, 2]
    floor: np.ndarray | None  # [m], shape [frame]: what four starts moved by 1e-6 m make of it in Box2D itself


class Growth(msgspec.Struct, frozen=True, kw_only=True):
    """How far an engine is from the golden data after so many steps."""

    case: str
    engine: str
    step: int
    error: float  # [m], largest of any coordinate
    floor: float  # [m], of Box2D itself, the start moved by 1e-6 m


class Square(msgspec.Struct, frozen=True, kw_only=True):
    """How far an engine gets from the golden data of one, two or three squares."""

    case: str
    says: str
    engine: str
    steps: int
    position: float  # [m], largest error of any coordinate in any step
    velocity: float  # [m/s]


class Inflation(msgspec.Struct, frozen=True, kw_only=True):
    """How far a body's area is from the golden data while it is inflated (RQ0), in windows of 1 s."""

    body: str
    engine: str
    worst: float  # [1], of the window means of area / (pi r^2)
    median: float


def read_file(folder: Path, name: str) -> dict[str, np.ndarray]:
    """The arrays of a golden file by key. Raises `InvalidInput`."""
    path = folder / f"{name}.npz"
    try:
        with np.load(path) as file:
            return dict(file)
    except (OSError, ValueError) as error:
        raise InvalidInput(f"{path}: expected the golden data, which are in the repository", str(error)) from None


def open_loop_cases(folder: Path) -> Iterator[Case]:
    """Rings under random and rising signals, in free flight, on a plane, on hills and in the cage."""
    for file in ("1_open_loop", "2_gas_law"):
        arrays = read_file(folder, file)
        for key in arrays:
            if not key.endswith("__s100"):
                continue
            name = key.removesuffix("__s100")
            size, scene, signal = name.split("__")
            of = {k.removeprefix(name + "__"): v for k, v in arrays.items() if k.startswith(name + "__")}
            body, s = BODIES[size], of["s100"] / 100
            span = np.where(s > 0, 1 - body.shortest, body.longest - 1) * body.rest_length
            lengths = (body.rest_length - s * span).astype(np.float32).astype(np.float64)
            pressure = of["p"].astype(np.float64)[:, None] if "p" in of else None
            yield Case(
                file=file,
                name=name,
                says=f"{size}, {scene}, {signal}",
                body=body,
                scene=scene_of(of["edges"], is_cage=scene == "cage"),
                two_sided=False,
                gravity=0.0 if scene == "free" else 10.0,
                position=of["start"].astype(np.float64),
                velocity=np.zeros_like(of["start"], dtype=np.float64),
                script=Script(lengths, pressure),
                frames=of["frames"],
                expected=of["pos"],
                floor=of["floor"],
            )


def square_cases(folder: Path) -> Iterator[Case]:
    """Single squares, pairs and springs."""
    arrays = read_file(folder, "3_squares")
    for name in arrays["names"].tolist():
        of = {k.removeprefix(name + "__"): v for k, v in arrays.items() if k.startswith(name + "__")}
        start, springs = of["bodies"].astype(np.float64), of["springs"].astype(np.float64)
        body = Body(start[:, :2], start[:, 2], springs[:, :2], rest_length=springs[:, 2])
        steps = len(of["out"]) - 1
        yield Case(
            file="3_squares",
            name=name,
            says=str(of["desc"]),
            body=body,
            scene=scene_of(of["edges"]),
            two_sided=name.startswith("wallend"),
            gravity=float(of["gravity"]),
            position=start[:, :2],
            velocity=start[:, 3:],
            script=Script(np.tile(body.rest_length, (steps, 1)), None),
            frames=np.arange(steps + 1),
            expected=of["out"],
            floor=None,
        )


def scene_of(edges: np.ndarray, *, is_cage: bool = False) -> Scene:
    """The scene of `edges`: all but upright ones are ground; in a cage, only the first is."""
    depth = np.where(edges[:, 0] == edges[:, 2], 0.0, GROUND_DEPTH)
    if is_cage:
        depth[1:] = 0.0
    return Scene(edges.astype(np.float64), depth)


def replay_in(engine: str, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m] and velocities [m/s] of a case in `engine`, both [step + 1, mass, 2]."""
    lengths, pressure = case.script
    if engine == HERE:
        scene = case.scene.two_sided() if case.two_sided else case.scene
        rec = replay(case.body, scene, lengths, pressure, case.position, case.velocity, gravity=case.gravity)
        return rec.position, rec.velocity
    task = Task(
        name=case.name,
        body=case.body,
        scene=case.scene,
        position=case.position,
        condition="passive",
        physics=Physics(gravity=case.gravity),
        steps=len(lengths),
    )
    trace, nothing = new_trace(), np.zeros((1, 0))
    start, velocity = case.position[None], case.velocity[None]
    run(load_world(engine), task, nothing, start, velocity=velocity, script=case.script, trace=trace)
    return np.array(trace.position), np.array(trace.velocity)


# --- rows ---------------------------------------------------------------------------------------------------------


def growth_rows(engine: str, folder: Path) -> list[Growth]:
    """Error growth of every open-loop case in `engine`."""
    rows = []
    for case in open_loop_cases(folder):
        position, _ = replay_in(engine, case)
        error = np.abs(position[case.frames] - case.expected).max(axis=(1, 2))
        floor: Any = case.floor
        rows += [
            Growth(case=case.name, engine=engine, step=int(step), error=float(error[k]), floor=float(floor[k]))
            for k, step in enumerate(case.frames)
            if step and step % CURVE == 0
        ]
    return rows


def square_rows(engine: str, folder: Path) -> list[Square]:
    """Largest errors of every case of single squares in `engine`."""
    rows = []
    for case in square_cases(folder):
        error = np.abs(np.concatenate(replay_in(engine, case), axis=2) - case.expected)
        rows.append(
            Square(
                case=case.name,
                says=case.says,
                engine=engine,
                steps=len(error) - 1,
                position=float(error[..., :2].max()),
                velocity=float(error[..., 2:].max()),
            )
        )
    return rows


def inflation_rows(engine: str, folder: Path) -> list[Inflation]:
    """Area while the bodies are inflated on a plane, in `engine`."""
    rows, arrays = [], read_file(folder, "2_gas_law")
    for size, body in BODIES.items():
        of = {k.removeprefix(f"{size}__rq0__"): v for k, v in arrays.items() if k.startswith(f"{size}__rq0__")}
        pressure = of["p"].astype(np.float64)[:, None]
        case = Case(
            file="2_gas_law",
            name=f"{size}__rq0",
            says="",
            body=body,
            scene=flat(),
            two_sided=False,
            gravity=10.0,
            position=of["start"].astype(np.float64),
            velocity=np.zeros_like(of["start"], dtype=np.float64),
            script=Script(np.tile(body.rest_length, (len(pressure), 1)), pressure),
            frames=of["frames"],
            expected=np.zeros(0),
            floor=None,
        )
        position, _ = replay_in(engine, case)
        rho = body.area(position.astype(np.float64))[:, 0] / (np.pi * body.chamber_radius(0) ** 2)
        means = np.array([rho[w + 1 : w + 61].mean() for w in of["window_start"]])
        error = np.abs(means - of["window_mean"])
        rows.append(Inflation(body=size, engine=engine, worst=float(error.max()), median=float(np.median(error))))
    return rows
