"""The engine against Box2D 2.3, at the tolerances of golden/README.md: every file, every row of its table.

A tolerance here is never tuned: a failure means that the engine is wrong, and its message says by how much.
"""

from __future__ import annotations

import functools
from pathlib import Path

import msgspec
import numpy as np
import pytest

import turgor
from turgor.body import LARGE, MEDIUM, SMALL, Body
from turgor.scene import GROUND_DEPTH, Scene, flat, polyline
from turgor.task import Task, make_task

GOLDEN = Path(__file__).parent / "golden"
BODIES = {"small": SMALL, "medium": MEDIUM, "large": LARGE}
AGENTS = 60  # controllers, or perturbed starts, of each condition


@functools.cache
def golden(name: str) -> dict[str, np.ndarray]:
    """The arrays of one file by key."""
    with np.load(GOLDEN / f"{name}.npz") as file:
        return dict(file)


def group(file: str, prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose keys start with `prefix` and two underscores, by the rest of the key."""
    prefix += "__"
    return {key[len(prefix) :]: array for key, array in golden(file).items() if key.startswith(prefix)}


def groups(file: str, with_array: str) -> list[str]:
    """The prefixes of all groups of a file that hold `with_array`."""
    end = f"__{with_array}"
    return sorted(key.removesuffix(end) for key in golden(file) if key.endswith(end))


def scene_of(edges: np.ndarray, *, cage: bool = False) -> Scene:
    """The scene of `edges`: all but upright ones are ground; in a cage, only the first is."""
    depth = np.where(edges[:, 0] == edges[:, 2], 0.0, GROUND_DEPTH)
    if cage:
        depth[1:] = 0.0
    return Scene(edges.astype(np.float64), depth)


def perturbed(start: np.ndarray, repeat: int, size: float) -> np.ndarray:
    """`start` with one coordinate moved by `size` [m] as in the golden data, by a float32 ulp at least."""
    position, n = start.astype(np.float32), len(start)
    mass, coordinate, sign = repeat % n, repeat // n % 2, 1 if repeat < 2 * n else -1
    old = position[mass, coordinate]
    new = np.float32(old + np.float32(sign * size))
    position[mass, coordinate] = np.nextafter(old, np.float32(sign * np.inf)) if new == old else new
    return position.astype(np.float64)


def table(errors: dict[str, float]) -> str:
    """The measured errors, worst first, for a failure's message."""
    return "\n".join(f"{name}: {error:.2e}" for name, error in sorted(errors.items(), key=lambda e: -e[1]))


@pytest.mark.parametrize("size", BODIES)
def test_bodies_are_those_of_the_golden_data(size: str) -> None:
    count, radius, gas, length, low, high = golden("1_open_loop")[f"{size}__preset"]
    task = make_task("flat", body=size)
    body = task.body
    assert (body.mass_count, body.gas_amount[0]) == (count, gas)
    np.testing.assert_allclose(body.radius, radius, rtol=1e-12)
    np.testing.assert_allclose(body.rest_length, length, rtol=1e-12)
    np.testing.assert_allclose(task.pressure_range[0], [low, high], rtol=1e-9)


# --- open loop and gas law ----------------------------------------------------------------------------------

FILES = {
    **{k: "1_open_loop" for k in groups("1_open_loop", "s100")},
    **{k: "2_gas_law" for k in groups("2_gas_law", "s100")},
}
FREE = [case for case in FILES if "__free__" in case]
CALM = [case for case in FILES if case not in FREE and case.endswith(("__ramp", "__rest"))]
RANDOM = [case for case in FILES if case not in FREE and "__random" in case]


@functools.cache
def open_loop(case: str) -> tuple[dict[int, float], dict[int, float]]:
    """The largest coordinate error [m] of a replay, and the chaos floor [m], by step."""
    g, (size, scene, _) = group(FILES[case], case), case.split("__")
    body, s = BODIES[size], g["s100"] / 100
    span = np.where(s > 0, 1 - body.shortest, body.longest - 1) * body.rest_length
    rec = turgor.replay(
        body,
        scene_of(g["edges"], cage=scene == "cage"),
        (body.rest_length - s * span).astype(np.float32),
        g.get("p"),  # none: gas law
        position=g["start"],
        gravity=0.0 if scene == "free" else 10.0,
    )
    assert np.isfinite(rec.position).all(), f"{case}: NaN"
    error = np.abs(rec.position[g["frames"]] - g["pos"]).max(axis=(1, 2))
    frames = g["frames"].tolist()
    return dict(zip(frames, error.tolist(), strict=True)), dict(zip(frames, g["floor"].tolist(), strict=True))


def test_every_open_loop_case_is_there() -> None:
    assert (len(FREE), len(CALM), len(RANDOM)) == (9, 12, 21)


@pytest.mark.parametrize("case", FREE)
def test_free_flight(case: str) -> None:
    error, floor = open_loop(case)
    assert error[60] <= 1e-4, f"{case}: {error[60]:.2e} m at step 60, floor {floor[60]:.1e}"
    assert error[120] <= 1e-3, f"{case}: {error[120]:.2e} m at step 120, floor {floor[120]:.1e}"


@pytest.mark.parametrize("case", CALM)
def test_calm_signals(case: str) -> None:
    error, floor = open_loop(case)
    large_hills = case.startswith("large__hills")
    for step, tolerance in ((60, 2e-3 if large_hills else 1e-4), (300, 2e-3 if large_hills else 1e-3)):
        assert error[step] <= tolerance, f"{case}: {error[step]:.2e} m at step {step}, floor {floor[step]:.1e}"


@pytest.mark.parametrize(
    ("step", "tolerance", "share"), [(30, 1e-4, 0.9), (60, 1e-3, 0.9), (60, 5e-3, 1.0), (120, None, 0.75)]
)
def test_random_signals(step: int, tolerance: float | None, share: float) -> None:
    errors = {case: open_loop(case)[0][step] for case in RANDOM}
    limits = {case: tolerance or max(1e-3, 30 * open_loop(case)[1][step]) for case in RANDOM}
    within = np.mean([errors[case] <= limits[case] for case in RANDOM])
    assert within >= share, f"{within:.0%} of the cases within tolerance at step {step}\n{table(errors)}"


# --- single squares, pairs, springs -------------------------------------------------------------------------

SQUARES = [str(name) for name in golden("3_squares")["names"]]
SLOPES = [name for name in SQUARES if name.startswith("slope")]


@functools.cache
def squares(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity [step + 1, mass, 4] of the engine, and of Box2D."""
    g = group("3_squares", name)
    start, springs = g["bodies"].astype(np.float64), g["springs"].astype(np.float64)
    body = Body(start[:, :2], start[:, 2], springs[:, :2], rest_length=springs[:, 2])
    scene = scene_of(g["edges"])
    if name.startswith("wallend"):
        scene = Scene(g["edges"].astype(np.float64)).two_sided()
    rec = turgor.replay(
        body,
        scene,
        np.tile(body.rest_length, (len(g["out"]) - 1, 1)),
        None,
        position=start[:, :2],
        velocity=start[:, 3:],
        gravity=float(g["gravity"]),
    )
    return np.concatenate([rec.position, rec.velocity], axis=2), g["out"]


@pytest.mark.parametrize("name", SQUARES)
def test_squares(name: str) -> None:
    mine, box2d = squares(name)
    error = np.abs(mine - box2d)
    position, velocity = error[..., :2].max(), error[..., 2:].max()
    limits = (1e-3, 1e-3) if name == "squeeze" else (1e-5, 1e-4)
    description = group("3_squares", name)["desc"]
    assert position <= limits[0], (
        f"{name} ({description}): {position:.2e} m at step {error[..., :2].max((1, 2)).argmax()}"
    )
    assert velocity <= limits[1], (
        f"{name} ({description}): {velocity:.2e} m/s at step {error[..., 2:].max((1, 2)).argmax()}"
    )


@pytest.mark.parametrize("name", SLOPES)
def test_a_square_sticks_to_a_slope_or_slips_as_in_box2d(name: str) -> None:
    mine, box2d = (np.linalg.norm(out[-1, 0, :2] - out[0, 0, :2]) for out in squares(name))
    slips = float(name.split("_")[0].removeprefix("slope")) > 55
    assert (box2d > 0.1) == slips, f"{name}: Box2D moved {box2d:.2e} m"
    assert (mine > 0.1) == slips, f"{name}: moved {mine:.2e} m, in Box2D {box2d:.2e} m"


# --- inflation (RQ0) ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", BODIES)
def test_inflation(size: str) -> None:
    g, body = group("2_gas_law", f"{size}__rq0"), BODIES[size]
    rest = np.tile(body.rest_length, (len(g["p"]), 1))
    rec = turgor.replay(body, flat(), rest, g["p"], position=g["start"])
    rho = rec.area_ratio[:, 0]
    mean = np.array([rho[w + 1 : w + 61].mean() for w in g["window_start"]])
    error = np.abs(mean - g["window_mean"])
    worst = error.argmax()
    assert error[worst] <= 0.03, f"{size}: {error[worst]:.4f} in the window at step {g['window_start'][worst]}"
    assert np.median(error) <= 0.01, f"{size}: {np.median(error):.4f} in the median window"


# --- controllers --------------------------------------------------------------------------------------------


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation (no ties)."""
    return float(np.corrcoef(a.argsort().argsort(), b.argsort().argsort())[0, 1])


def kolmogorov_smirnov(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference of the two samples' distribution functions."""
    both = np.concatenate([a, b])
    shares = [np.searchsorted(np.sort(x), both, side="right") / len(x) for x in (a, b)]
    return float(np.abs(shares[0] - shares[1]).max())


def controllers_task(size: str, name: str, condition: str) -> Task:
    """The task on the golden data's own edges and start."""
    g = group("4_controllers", f"{size}__{name}")
    scene = scene_of(g["edges"], cage=name == "escape")
    task = make_task(name, body=size, condition=condition)
    return msgspec.structs.replace(task, scene=scene, position=g["start"])


def thetas(task: Task) -> np.ndarray:
    """The 60 random controllers, shape [agent, parameter]."""
    seeds = golden("4_controllers")["seeds"]
    return np.array([np.random.default_rng(seed).uniform(-1, 1, task.parameter_count) for seed in seeds])


@functools.cache
def fitnesses(size: str, name: str, condition: str) -> tuple[np.ndarray, np.ndarray]:
    """Fitness of the 60 agents in the engine, and in Box2D."""
    task = controllers_task(size, name, condition)
    position = np.repeat(task.position[None], AGENTS, axis=0)
    if condition == "passive":
        for k in range(AGENTS):
            position[k] = perturbed(task.position, k % 30, 1e-6 if k < 30 else 2e-6)
    out = turgor.Simulator(task).rollout(thetas(task), position=position)
    return np.asarray(out.fitness), group("4_controllers", f"{size}__{name}__{condition}")["fitness_base"]


@pytest.mark.parametrize("condition", ["pressure", "springs"])
@pytest.mark.parametrize("size", BODIES)
def test_random_controllers_on_hills(size: str, condition: str) -> None:
    mine, box2d = fitnesses(size, "hilly", condition)
    rank, distance, sd = spearman(mine, box2d), kolmogorov_smirnov(mine, box2d), box2d.std(ddof=1)
    difference = abs(mine.mean() - box2d.mean())
    measured = f"Spearman {rank:.3f}, KS {distance:.3f}, means differ by {difference:.4f} m/s, sd {sd:.4f}"
    assert rank >= 0.85, measured
    assert distance <= 0.2, measured
    assert difference <= 0.15 * sd, measured


@pytest.mark.parametrize("condition", ["pressure", "springs"])
@pytest.mark.parametrize("size", BODIES)
def test_random_controllers_in_the_cage(size: str, condition: str) -> None:
    mine, box2d = fitnesses(size, "escape", condition)
    distance, sd = kolmogorov_smirnov(mine, box2d), box2d.std(ddof=1)
    difference = abs(mine.mean() - box2d.mean())
    measured = f"KS {distance:.3f}, means differ by {difference:.4f} m/s, sd {sd:.4f}"
    assert distance <= 0.25, measured
    assert difference <= 0.3 * sd, measured


@pytest.mark.parametrize("name", ["hilly", "escape"])
@pytest.mark.parametrize("size", BODIES)
def test_passive_bodies(size: str, name: str) -> None:
    mine, box2d = fitnesses(size, name, "passive")
    difference = abs(mine.mean() - box2d.mean())
    assert difference <= 0.01, f"means {mine.mean():.4f} and {box2d.mean():.4f} m/s differ by {difference:.4f}"


LOOPS = groups("4_controllers", "obs")


@pytest.mark.parametrize("case", LOOPS)
def test_closed_loop_step_by_step(case: str) -> None:
    """What the first controller saw and did: at the positions' tolerances of random signals, to step 60."""
    size, _, condition = case.split("__")
    g, n, steps = group("4_controllers", case), BODIES[size].mass_count, 120
    task = msgspec.structs.replace(controllers_task(size, "hilly", condition), steps=steps)
    rec = turgor.Simulator(task).record(thetas(task)[0])
    frames = g["frames"].astype(int)
    before, touch = frames[:-1], np.unpackbits(g["touch"])[: steps * n].reshape(steps, n)
    errors = {
        "position [m]": np.abs(rec.position[frames] - g["pos"]).max(axis=(1, 2)),
        "observation": np.abs(rec.observation[before] - g["obs"]).max(axis=1),
        "rest length [m]": np.abs(rec.rest_length[before + 1] - g["rest"]).max(axis=1),
        "pressure / p_max": np.abs(rec.pressure[frames, 0] - g["p"]) / task.pressure_range[0, 1],
    }
    for step, tolerance in ((30, 1e-4), (60, 1e-3)):
        until = {name: float(error[: frames.tolist().index(step) + 1].max()) for name, error in errors.items()}
        assert max(until.values()) <= tolerance, f"{case} to step {step}\n{table(until)}"
    wrong = np.flatnonzero((rec.touch[:steps] != touch).any(axis=1))
    assert not (wrong < 60).any(), f"{case}: touch differs as sensed in steps {(wrong + 1).tolist()}"


# --- champions ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", groups("5_champions", "theta"))
def test_champions(case: str) -> None:
    size, condition = case.split("__")
    g = group("5_champions", case)
    task = make_task("hilly", body=size, condition=condition)
    task = msgspec.structs.replace(task, scene=polyline(g["terrain"]), position=g["start"])
    position = np.array([perturbed(g["start"], k, 1e-6) for k in range(30)])
    theta = np.repeat(g["theta"][None].astype(np.float64), 30, axis=0)
    mine = np.median(turgor.Simulator(task).rollout(theta, position=position).fitness)
    box2d = np.median(g["fitness"])
    assert abs(mine / box2d - 1) <= 0.05, f"{case}: median {mine:.3f} m/s, in Box2D {box2d:.3f}"
