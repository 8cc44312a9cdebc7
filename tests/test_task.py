"""Bodies, scenes and tasks as they are made, refused, named, written and read."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from turgor.body import LARGE, MEDIUM, SMALL, Body, ring
from turgor.control import check_theta, parameter_count, rows
from turgor.errors import InvalidInput
from turgor.scene import Scene, cage, flat, hills
from turgor.simulate import Simulator, replay
from turgor.task import Leave, Physics, Task, make_task, task_from_json, task_to_json
from turgor.variants import variant_names

GOLDEN = Path(__file__).parent / "golden"
BODIES = {"small": SMALL, "medium": MEDIUM, "large": LARGE}


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(GOLDEN / "4_controllers.npz") as file:
        return {name: file[name] for name in file if name.endswith(("__terrain", "__edges", "__start"))}


# --- what is refused ----------------------------------------------------------------------------------------

SQUARE = [[0.0, 0], [1, 0], [1, 1], [0, 1]]


def own(**fields: Any) -> Task:
    usual = {"name": "own", "body": SMALL, "scene": flat(), "position": SMALL.position}
    return Task(**(usual | fields))


# what is done, words of what was expected, words of what came
REFUSED: dict[str, tuple[Any, str, str]] = {
    "too few masses": (lambda: ring(2, 5.0), "mass_count: expected a whole number, 3 to 1000", "2"),
    "half a mass": (lambda: ring(3.5, 5.0), "mass_count: expected a whole number", "3.5"),
    "negative radius": (lambda: ring(10, -5.0), "radius: expected a positive number", "-5.0"),
    "radius of nothing": (lambda: ring(10, math.nan), "radius: expected a positive number", "nan"),
    "radius of words": (lambda: ring(10, "wide"), "radius: expected a positive number", "wide"),
    "negative gas": (lambda: ring(10, 5.0, gas_amount=-1.0), "gas_amount: expected a finite number, 0 or more", "-1"),
    "gas of nothing": (lambda: ring(10, 5.0, gas_amount=math.inf), "gas_amount: expected finite", "infinity"),
    "no side": (lambda: ring(10, 5.0, side=0.0), "side: expected positive", "0"),
    "negative density": (lambda: ring(10, 5.0, density=-1.0), "density: expected positive", "-1"),
    "no frequency": (lambda: ring(10, 5.0, frequency=0.0), "frequency: expected positive", "0"),
    "negative damping": (
        lambda: ring(10, 5.0, damping_ratio=-0.1),
        "damping_ratio: expected a finite number, 0 or more",
        "-0.1",
    ),
    "shortest above 1": (lambda: ring(10, 5.0, shortest=1.2), "expected shortest <= 1 <= longest", "1.2"),
    "longest below 1": (lambda: ring(10, 5.0, longest=0.9), "expected shortest <= 1 <= longest", "0.9"),
    "negative friction": (lambda: ring(10, 5.0, friction=-1.0), "friction: expected a finite number", "-1"),
    "positions of words": (lambda: Body([["a", "b"]]), "position: expected numbers", "a"),
    "positions in space": (lambda: Body([[0.0, 0, 0]]), "position: expected shape [any, 2]", "[1, 3]"),
    "position of NaN": (lambda: Body([[0.0, math.nan]]), "position: expected finite", "NaN"),
    "spring to nowhere": (lambda: Body(SQUARE, springs=[(0, 4)]), "springs: expected pairs", "4"),
    "spring to itself": (lambda: Body(SQUARE, springs=[(2, 2)]), "springs: expected pairs of different", "2"),
    "spring of no length": (lambda: Body([[0.0, 0], [0, 0]], springs=[(0, 1)]), "rest_length: expected positive", "0"),
    "chamber of two": (lambda: Body(SQUARE, chambers=[(0, 1)]), "chambers: expected loops of 3", "(0, 1)"),
    "chamber elsewhere": (lambda: Body(SQUARE, chambers=[(0, 1, 9)]), "chambers: expected loops", "9"),
    "chamber that crosses": (lambda: Body(SQUARE, chambers=[(0, 1, 0)]), "different masses", "(0, 1, 0)"),
    "sides of another body": (lambda: Body(SQUARE, side=[1, 1]), "side: expected shape [4]", "[2]"),
    "segment of one point": (lambda: Scene([[1, 1, 1, 1]]), "segments: expected two different ends", "1."),
    "segments of words": (lambda: Scene("ground"), "segments: expected numbers", "ground"),
    "far segments": (lambda: Scene([[0, 0, 1e9, 0]]), "segments: expected coordinates within", "larger"),
    "segments of NaN": (lambda: Scene([[0, 0, math.nan, 0]]), "segments: expected coordinates", "NaN"),
    "negative depth": (lambda: Scene([[0, 0, 1, 0]], -1.0), "depth: expected 0 m or more", "-1"),
    "negative ground friction": (lambda: flat(friction=-1), "friction: expected a finite", "-1"),
    "aperture above roof": (lambda: cage(width=15, roof=5, aperture=6), "aperture < roof", "6"),
    "cage of no width": (lambda: cage(width=0, roof=5, aperture=1), "expected width > 0", "0"),
    "hills of no step": (lambda: hills(step=0), "expected height >= 0, step > 0", "0"),
    "unknown task": (lambda: make_task("uphill"), "task: expected one of hilly, flat, escape", "'uphill'"),
    "unknown body": (lambda: make_task(body="huge"), "body: expected one of small, medium, large", "'huge'"),
    "unknown condition": (lambda: make_task(condition="free"), "condition: expected one of pressure", "'free'"),
    "unknown variant": (lambda: make_task(gravitas=1), "variant: expected one of", "'gravitas'"),
    "negative seed": (lambda: make_task(seed=-1), "seed: expected a whole number", "-1"),
    "seed of words": (lambda: make_task(seed="one"), "seed: expected a whole number", "one"),
    "variant of words": (lambda: make_task(gravity="strong"), "gravity: expected a number", "strong"),
    "negative gravity": (lambda: make_task(gravity=-1.0), "gravity: expected a number that is not negative", "-1"),
    "no time step": (lambda: make_task(dt=0.0), "dt: expected", "0"),
    "no window": (lambda: make_task(window=0), "window: expected a whole number", "0"),
    "unknown observation": (lambda: make_task(observation="raw"), "observation: expected one of signed, unit", "raw"),
    "unknown length": (
        lambda: make_task(pressure_length="long"),
        "pressure_length: expected one of true, commanded",
        "long",
    ),
    "no steps": (lambda: make_task(steps=0), "steps: expected a whole number", "0"),
    "unknown fitness": (lambda: own(fitness="speed"), "fitness: expected one of", "'speed'"),
    "side of an own body": (lambda: make_task(body=SMALL, side=2.0), "side: expected a named body", ""),
    "controlled inflation": (lambda: make_task("inflation", condition="springs"), 'condition "passive"', "springs"),
    "start of another body": (lambda: own(position=SQUARE), "position: expected finite numbers of shape [10, 2]", "[4"),
    "start of NaN": (lambda: own(position=SMALL.position * math.nan), "position: expected finite", ""),
    "unit of NaN": (lambda: own(pressure_unit=math.nan), "pressure_unit: expected a number", "nan"),
    "pressure without gas": (lambda: own(body=Body(SQUARE), position=SQUARE), "a body with a chamber", "none"),
    "short pressure": (lambda: own(pressure=[1.0, 2.0], condition="passive"), "shape [1800, 1]", "[2, 1]"),
    "theta of one agent": (lambda: check_theta(np.zeros(374), SMALL, "pressure"), "theta[None]", "[374]"),
    "theta of a springs task": (lambda: check_theta(np.zeros((2, 340)), SMALL, "pressure"), "[agent, 374]", "[2, 340]"),
    "theta of NaN": (lambda: check_theta(np.full((2, 374), math.nan), SMALL, "pressure"), "finite", "agent 0"),
    "theta of words": (lambda: check_theta("good", SMALL, "pressure"), "theta: expected numbers", "good"),
    "theta too large": (lambda: check_theta(np.full((1, 374), 1e20), SMALL, "pressure"), "within 1e15", "1e+20"),
    "no threads": (lambda: Simulator(own(), threads=0), "threads: expected a whole number", "0"),
    "starts of too few": (
        lambda: Simulator(own()).rollout(np.zeros((2, 374)), position=SMALL.position[None]),
        "shape [2, 10, 2]",
        "[1, 10, 2]",
    ),
    "commands of another body": (lambda: stepped(np.zeros((2, 10))), "commands: expected shape", "[2, 10]"),
    "commands of NaN": (lambda: stepped(np.full((2, 11), math.nan)), "commands: expected finite", "[2, 11]"),
    "lengths of another body": (
        lambda: replay(SMALL, flat(), np.ones((5, 9))),
        "rest_length: expected finite numbers of shape [5, 10]",
        "[5, 9]",
    ),
    "JSON that is a list": (lambda: task_from_json(b"[1]"), "task: expected a JSON object", "[1]"),
    "JSON of another thing": (lambda: task_from_json({"name": "x"}), "task", "body"),
}


# where the words come from msgspec, or nothing came
WITHOUT_GOT = {
    "side of an own body",
    "JSON of another thing",
}


def stepped(commands: np.ndarray) -> None:
    simulator = Simulator(own())
    simulator.reset(2)
    simulator.step(commands)


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(case: str) -> None:
    make, expected, got = REFUSED[case]
    with pytest.raises(InvalidInput) as error:
        make()
    message = str(error.value)
    assert "\n" not in message
    assert len(message) < 1500
    assert expected in message
    assert got in message
    assert ("; got " in message) == (case not in WITHOUT_GOT)


# --- the paper's numbers ------------------------------------------------------------------------------------


def test_parameter_counts() -> None:
    counts = {
        condition: [parameter_count(body, condition) for body in BODIES.values()]
        for condition in ("pressure", "springs", "passive")
    }
    assert counts == {"pressure": [374, 784, 1344], "springs": [340, 735, 1280], "passive": [0, 0, 0]}
    assert [make_task(body=body).parameter_count for body in BODIES] == counts["pressure"]


@pytest.mark.parametrize("condition", ["pressure", "springs"])
def test_theta_is_springs_weights_and_biases_then_pressure(condition: str) -> None:
    """theta = [W_s row-major, b_s, W_p, b_p]."""
    n, inputs = 10, 33
    theta = np.arange(2 * parameter_count(SMALL, condition), dtype=float).reshape(2, -1)
    weights, biases = rows(theta, SMALL, condition)
    for agent in (0, 1):
        start = theta[agent, 0]
        np.testing.assert_array_equal(weights[agent, :n].ravel(), start + np.arange(n * inputs))
        np.testing.assert_array_equal(biases[agent, :n], start + n * inputs + np.arange(n))
        if condition == "pressure":
            np.testing.assert_array_equal(weights[agent, n], start + n * (inputs + 1) + np.arange(inputs))
            assert biases[agent, n] == theta[agent, -1]
    assert weights.shape == (2, n + (condition == "pressure"), inputs)


@pytest.mark.parametrize(("size", "n", "r", "gas"), [("small", 10, 5, 1400.67), ("large", 20, 10, 2801.34)])
def test_bodies_are_the_papers(size: str, n: int, r: float, gas: float) -> None:
    body, task = BODIES[size], make_task("flat", body=size)
    angle = 2 * np.pi * np.arange(n) / n
    np.testing.assert_allclose(body.position, r * np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=1e-12)
    np.testing.assert_allclose(body.angle, angle)
    np.testing.assert_array_equal(body.springs, [[i, (i + 1) % n] for i in range(n)])
    np.testing.assert_allclose(body.mass, 2500)
    np.testing.assert_allclose(body.rest_length, 2 * r * np.sin(np.pi / n))
    full = 1.25 * gas * 8.314462618 * 288.15 / (np.pi * r * r)
    np.testing.assert_allclose(task.pressure_range, [[0.2 * full, full]])
    np.testing.assert_allclose(task.pressure_step, full / 1000)
    area = 0.5 * n * r * r * np.sin(2 * np.pi / n)
    np.testing.assert_allclose(task.pressure_start, min(gas * 8.314462618 * 288.15 / area, full))
    assert make_task("flat", body=size, pressure_unit=1.0).pressure_step.tolist() == [1.0]
    assert (task.steps, task.duration) == (1800, pytest.approx(30))


@pytest.mark.parametrize("size", BODIES)
def test_terrain_is_that_of_the_golden_data(size: str, golden: dict[str, np.ndarray]) -> None:
    task = make_task("hilly", body=size, seed=0)
    terrain, ground = golden[f"{size}__terrain"], task.scene.segments[1:-1]
    np.testing.assert_array_equal(ground[:, 2:], terrain[:-1])
    np.testing.assert_array_equal(ground[:, :2], terrain[1:])
    np.testing.assert_array_equal(task.scene.segments, golden[f"{size}__hilly__edges"])
    np.testing.assert_allclose(task.position, golden[f"{size}__hilly__start"], atol=2e-6)
    np.testing.assert_array_equal(task.scene.depth, [0.0] + [2.0] * len(ground) + [0.0])


@pytest.mark.parametrize("size", BODIES)
def test_cage_is_that_of_the_golden_data(size: str, golden: dict[str, np.ndarray]) -> None:
    task, r = make_task("escape", body=size), BODIES[size].radius
    np.testing.assert_array_equal(task.scene.segments, golden[f"{size}__escape__edges"])
    np.testing.assert_allclose(task.position, golden[f"{size}__escape__start"], atol=2e-6)
    assert task.end == Leave(half_width=1.5 * r + 1)
    authors = make_task("escape-authors", body=size).scene.segments
    assert (authors[5, 1], authors[5, 3]) == (3 * r, r)


def test_terrains_differ_by_seed_and_are_long() -> None:
    scenes = [make_task("hilly", seed=seed).scene for seed in range(5)]
    assert len({scene.segments.tobytes() for scene in scenes}) == 5
    for scene in scenes:
        x = scene.segments[1:-1, [2, 0]]
        assert x[0, 0] == -20
        assert 380 < x[-1, 1] <= 400
        assert (x[:, 1] - x[:, 0] >= 1 - 1e-9).all()
        assert (scene.segments[1:-1, [1, 3]] >= 0).all()
        np.testing.assert_array_equal(x[1:, 0], x[:-1, 1])
        np.testing.assert_allclose(np.hypot(*scene.normal.T), 1)
        assert (scene.normal[1:-1, 1] > 0).all()
        assert scene.normal[[0, -1]].tolist() == [[1, 0], [-1, 0]]


# --- writing, reading, identity -----------------------------------------------------------------------------

STORED = {
    "hilly": make_task("hilly", body="medium", seed=3, steps=60),
    "escape": make_task("escape", condition="springs", fitness="elapsed", steps=60),
    "inflation": make_task("inflation", steps=60, rest_steps=10, ramp_steps=20),
    "variants": make_task("flat", observation="unit", window=15, gravity=9.81, pressure_unit=1.0, steps=60),
    "own": Task(
        name="own",
        body=Body(SQUARE, springs=[(0, 1), (2, 1), (3, 0)], chambers=[(0, 1, 2, 3)], gas_amount=12.3, side=0.3),
        scene=Scene([[9, 0.1, -9, 1 / 3]], 2.0, 0.7),
        position=np.array(SQUARE) * 1.7 + 1 / 7,
        end=Leave(half_width=3.3),
        steps=60,
    ),
}


@pytest.mark.parametrize("case", STORED)
def test_a_task_read_back_is_the_same_task(case: str) -> None:
    task = STORED[case]
    data = task_to_json(task)
    for again in (task_from_json(data), task_from_json(msgspec.json.decode(data))):
        assert task_to_json(again) == data
        assert again.identity == task.identity
        theta = np.random.default_rng(0).uniform(-1, 1, (3, task.parameter_count))
        mine, other = Simulator(task).rollout(theta), Simulator(again).rollout(theta)
        assert mine.position.tobytes() == other.position.tobytes()
        assert mine.fitness.tobytes() == other.fitness.tobytes()


def test_functions_are_named_but_not_read_back() -> None:
    for field in ("fitness", "end"):
        task = msgspec.structs.replace(STORED["hilly"], **{field: np.mean})
        assert task.identity != STORED["hilly"].identity
        with pytest.raises(InvalidInput, match=f"{field}: expected the task to be passed"):
            task_from_json(task_to_json(task))


def test_identity() -> None:
    task = make_task("hilly", seed=1)
    assert re.fullmatch("[0-9a-f]{16}", task.identity)
    assert make_task("hilly", seed=1).identity == task.identity
    others = [
        make_task("hilly", seed=2),
        make_task("flat"),
        make_task("escape"),
        make_task("escape-authors"),
        make_task("hilly", seed=1, body="medium"),
        make_task("hilly", seed=1, condition="springs"),
        msgspec.structs.replace(task, name="hilly too"),
        msgspec.structs.replace(task, end=Leave(1.0)),
        msgspec.structs.replace(task, position=np.nextafter(task.position, 100)),
        msgspec.structs.replace(task, scene=Scene(task.scene.segments, 1.0)),
    ]
    assert len({other.identity for other in others} | {task.identity}) == len(others) + 1


@pytest.mark.parametrize("name", Physics.__struct_fields__)
def test_identity_changes_with_every_number_of_physics(name: str) -> None:
    old = getattr(Physics(), name)
    new = "commanded" if isinstance(old, str) else old + 1 if isinstance(old, int) else float(np.nextafter(old, 1e9))
    task = make_task("flat")
    changed = msgspec.structs.replace(task, physics=msgspec.structs.replace(task.physics, **{name: new}))
    assert changed.identity != task.identity


BODY_FIELDS = [name for name in Body.__struct_fields__ if name not in ("springs", "chambers")]


@pytest.mark.parametrize("name", BODY_FIELDS)
def test_identity_changes_with_every_number_of_a_body(name: str) -> None:
    value = np.array(getattr(SMALL, name), dtype=float)
    value.flat[-1] = np.nextafter(value.flat[-1], 1e9)
    new = float(value) if value.ndim == 0 else value
    task = make_task("flat")
    assert msgspec.structs.replace(task, body=msgspec.structs.replace(SMALL, **{name: new})).identity != task.identity


def test_a_task_cannot_be_changed() -> None:
    task = STORED["hilly"]
    for array in (task.position, task.body.position, task.body.side, task.scene.segments, task.scene.depth):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(AttributeError):
        task.steps = 3
    start = np.array(task.position)
    copied = msgspec.structs.replace(task, position=start)
    start[0] = 1e3
    np.testing.assert_array_equal(copied.position, task.position)


def test_variants_are_named_once_and_default_to_the_preset() -> None:
    names = variant_names()
    defaults = {name: getattr(group(), name) for name, group in names.items()}
    # values of None or of a named body's own stand for the preset too
    assert make_task("hilly", **defaults).identity == make_task("hilly").identity
    assert {"gravity", "window", "observation", "pressure_length", "fitness", "ground_friction"} <= set(names)


def test_stepping_needs_agents() -> None:
    simulator = Simulator(make_task("flat"))
    with pytest.raises(InvalidInput, match="call reset first"):
        simulator.step(np.zeros((1, 11)))
    with pytest.raises(InvalidInput, match="at least 1; got 0"):
        simulator.reset(0)
