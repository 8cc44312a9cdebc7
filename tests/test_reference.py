"""The plain NumPy reference, against a part of the golden Box2D data and against what physics demands."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from turgor.body import LARGE, MEDIUM, SMALL, Body
from turgor.physics import reference
from turgor.physics.reference_control import observe
from turgor.scene import GROUND_DEPTH, Scene, flat
from turgor.task import Physics, Task, make_task

GOLDEN = Path(__file__).parent / "golden"
BODIES = {"small": SMALL, "medium": MEDIUM, "large": LARGE}
NOWHERE = Scene([])  # free space
STIFFNESS = 0.5 * 2500 * (16 * math.pi) ** 2  # k = m ω² [N/m]: reduced mass of two squares, 8 Hz


def read(file: str, prefix: str) -> dict[str, np.ndarray]:
    """The arrays of a golden file whose keys start with `prefix` and two underscores, by the rest of the key."""
    prefix += "__"
    with np.load(GOLDEN / f"{file}.npz") as arrays:
        return {key.removeprefix(prefix): arrays[key] for key in arrays if key.startswith(prefix)}


def ground(edges: np.ndarray, *, cage: bool = False) -> Scene:
    """The scene of `edges`: all but upright ones are ground; in a cage, only the first is."""
    depth = np.where(edges[:, 0] == edges[:, 2], 0.0, GROUND_DEPTH)
    if cage:
        depth[1:] = 0.0
    return Scene(edges.astype(np.float64), depth)


# --- Box2D --------------------------------------------------------------------------------------------------

CASES = {
    "small__free__random1": 1e-4,
    "large__free__ramp": 1e-4,
    "small__hills__random1": 1e-4,
    "large__hills__ramp": 2e-3,  # the chaos floor is 2e-4 here
    "medium__flat__ramp": 1e-4,
    "medium__cage__random0": 1e-4,
    "small__gas__random": 1e-4,
    "medium__gas__rest": 1e-4,
}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("case", CASES)
def test_open_loop_to_step_60(case: str, dtype: type) -> None:
    size, scene, _ = case.split("__")
    g, body = read("2_gas_law" if scene == "gas" else "1_open_loop", case), BODIES[size]
    s = g["s100"][:60] / 100
    span = np.where(s > 0, 1 - body.shortest, body.longest - 1) * body.rest_length
    rec = reference.replay(
        body,
        ground(g["edges"], cage=scene == "cage"),
        (body.rest_length - s * span).astype(np.float32),
        g.get("p"),
        position=g["start"],
        gravity=0.0 if scene == "free" else 10.0,
        dtype=dtype,
    )
    frames = g["frames"][g["frames"] <= 60]
    error = np.abs(rec.position[frames] - g["pos"][: len(frames)]).max(axis=(1, 2))
    assert rec.position.dtype == dtype
    assert error.max() <= CASES[case], f"{case}: {error.max():.2e} m at step {frames[error.argmax()]}"


with np.load(GOLDEN / "3_squares.npz") as squares:
    SQUARES = [str(name) for name in squares["names"]]


@pytest.fixture(scope="module")
def golden_squares() -> dict[str, np.ndarray]:
    with np.load(GOLDEN / "3_squares.npz") as arrays:
        return dict(arrays)


@pytest.mark.parametrize("name", SQUARES)
def test_squares(name: str, golden_squares: dict[str, np.ndarray]) -> None:
    arrays = ("bodies", "springs", "edges", "gravity", "out")
    start, springs, edges, gravity, out = (golden_squares[f"{name}__{key}"].astype(float) for key in arrays)
    body = Body(start[:, :2], start[:, 2], springs[:, :2], rest_length=springs[:, 2])
    scene = Scene(edges).two_sided() if name.startswith("wallend") else ground(edges)
    rest = np.tile(body.rest_length, (len(out) - 1, 1))
    rec = reference.replay(body, scene, rest, None, velocity=start[:, 3:], gravity=float(gravity))
    position, velocity = np.abs(rec.position - out[..., :2]).max(), np.abs(rec.velocity - out[..., 2:]).max()
    limits = (1e-3, 1e-3) if name == "squeeze" else (1e-5, 1e-4)
    assert position <= limits[0], f"{name}: {position:.2e} m"
    assert velocity <= limits[1], f"{name}: {velocity:.2e} m/s"


@pytest.mark.parametrize("condition", ["pressure", "springs"])
def test_closed_loop_to_step_60(condition: str) -> None:
    g = read("4_controllers", f"small__loop__{condition}")
    task = make_task("hilly", condition=condition)
    theta = np.random.default_rng(0).uniform(-1, 1, task.parameter_count)
    rec = reference.rollout(task, theta, 61)
    frames = g["frames"][g["frames"] <= 60].astype(int)
    count, touch = len(frames), np.unpackbits(g["touch"])[:1200].reshape(120, 10)
    assert np.abs(rec.position[frames] - g["pos"][:count]).max() <= 1e-4
    assert np.abs(rec.observation[frames] - g["obs"][:count]).max() <= 1e-5
    assert np.abs(rec.rest_length[frames + 1] - g["rest"][:count]).max() <= 1e-5
    assert (
        np.abs(rec.pressure[frames, 0] / task.pressure_range[0, 1] - g["p"][:count] / task.pressure_range[0, 1]).max()
        <= 1e-6
    )
    np.testing.assert_array_equal(rec.touch[:60], touch[:60])


# --- physics ------------------------------------------------------------------------------------------------


def crumpled(task: Task) -> reference.State:
    """A start whose masses are scattered by 1 m."""
    scatter = np.random.default_rng(1).uniform(-1, 1, task.position.shape)
    return reference.start(task, task.position + scatter)


@pytest.mark.parametrize("size", BODIES)
def test_pressure_forces_sum_to_zero(size: str) -> None:
    task = make_task("flat", body=size)
    force = reference.pressure_force(crumpled(task), task)
    assert np.abs(force).max() > 1e4
    assert np.abs(force.sum(axis=0)).max() <= 1e-12 * np.abs(force).sum()


def test_commanded_lengths_make_momentum_from_nothing() -> None:
    task = make_task("flat", pressure_length="commanded")
    assert np.abs(reference.pressure_force(crumpled(task), task).sum(axis=0)).max() > 1e3


def test_forces_of_two_chambers_add_up() -> None:
    square = np.array([[0.0, 0.0], [3, 0], [3, 3], [0, 3], [6, 0], [6, 3]])
    body = Body(square, chambers=[[0, 1, 2, 3], [1, 4, 5, 2]], gas_amount=[100.0, 100.0])
    task = Task(name="two", body=body, scene=NOWHERE, position=square, condition="passive")
    state = reference.start(task)
    force = reference.pressure_force(state, task)
    push = state.pressure[0] * 3 / 2
    np.testing.assert_allclose(force / push, [[-1, -1], [0, -2], [0, 2], [-1, 1], [1, -1], [1, 1]], atol=1e-12)


def test_momentum_is_kept_in_free_space() -> None:
    rng, body = np.random.default_rng(2), SMALL
    rest = body.rest_length * rng.uniform(0.75, 1.25, (120, 10))
    velocity = rng.uniform(-3, 3, (10, 2))
    rec = reference.replay(body, NOWHERE, rest, None, velocity=velocity, gravity=0.0)
    assert np.abs(rec.spring_length[-1] - body.rest_length).max() > 0.1
    assert np.abs(rec.com_velocity - velocity.mean(axis=0)).max() <= 1e-12


@pytest.mark.parametrize("size", BODIES)
def test_inflated_radius(size: str) -> None:
    """A mass is in balance where p l cos(π/n) = 2 k (l - L0) sin(π/n): R = r / (1 - p cot(π/n) / (2 k))."""
    body, steps = BODIES[size], 900  # large breathes for 10 s
    pressure = make_task("flat", body=size).pressure_range[0, 1]
    rest = np.tile(body.rest_length, (steps, 1))
    rec = reference.replay(body, NOWHERE, rest, np.full(steps, pressure), gravity=0.0)
    radius = np.linalg.norm(rec.position[-1] - rec.com[-1], axis=1)
    expected = body.radius / (1 - pressure / math.tan(math.pi / body.mass_count) / (2 * STIFFNESS))
    assert expected > 1.02 * body.radius
    np.testing.assert_allclose(radius, expected, rtol=1e-6)


def lone_square(y: float, scene: Scene, steps: int = 60, **physics: float) -> np.ndarray:
    """The last position [m] of a square that starts at rest at (0, y)."""
    rest = np.zeros((steps, 0))
    return reference.replay(Body([[0.0, y]]), scene, rest, None, physics=Physics(**physics)).position[-1, 0]


def test_a_resting_square_stands_at_its_skins_and_the_slop() -> None:
    assert lone_square(0.6, flat()) == pytest.approx([0, 0.515], abs=1e-4)


@pytest.mark.parametrize(("y", "stays"), [(-1.9, True), (-2.1, False)])
def test_ground_pushes_out_what_lies_within_its_depth(y: float, stays: bool) -> None:
    assert (lone_square(y, flat())[1] > 0.5) == stays


def test_a_wall_ignores_what_is_behind_it() -> None:
    ceiling = Scene([[-5, 0, 5, 0]])  # its free side is below
    assert lone_square(0.1, ceiling)[1] < -4.9
    assert lone_square(-0.45, ceiling, 10, gravity=0.0)[1] == pytest.approx(-0.515, abs=1e-2)


def test_travel_is_limited() -> None:
    assert lone_square(0.0, NOWHERE, 1, gravity=1e4)[1] == pytest.approx(-2.0)


# --- sensing ------------------------------------------------------------------------------------------------


def test_observations_are_averaged_over_the_window() -> None:
    task = make_task("flat", condition="passive", window=3)
    state = reference.start(task)
    single = []
    for _ in range(5):
        single.append(observe(state, task))
        np.testing.assert_allclose(reference.step(state, task), np.mean(single[-3:], axis=0), atol=1e-15)


def test_unit_observations_are_the_signed_ones_shifted() -> None:
    signed, unit = (make_task("flat", observation=name) for name in ("signed", "unit"))
    o, u = (observe(crumpled(task), task) for task in (signed, unit))
    np.testing.assert_allclose(u[10:32], (o[10:32] + 1) / 2)
    np.testing.assert_array_equal(u[[*range(10), 32]], o[[*range(10), 32]])


def test_inflation_gives_the_pressure_and_keeps_the_springs_at_rest() -> None:
    task = make_task("inflation", rest_steps=5, ramp_steps=10)
    rec = reference.rollout(task, steps=20)
    np.testing.assert_array_equal(rec.pressure[1:], task.pressure[:20])
    np.testing.assert_array_equal(rec.rest_length, np.tile(task.body.rest_length, (21, 1)))
    assert rec.fitness == pytest.approx(rec.area_ratio[-1, 0])


def test_a_rollout_ends_when_the_task_is_solved() -> None:
    task = msgspec.structs.replace(make_task("escape", condition="passive"), steps=50)
    rec = reference.rollout(task, position=task.position + np.array([20, 0]))
    assert (rec.solved, rec.steps) == (True, 1)
    assert not reference.rollout(task, steps=3).solved
