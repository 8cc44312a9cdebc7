"""Random bodies, scenes and controllers: nothing is lost, whatever they are."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import turgor
from turgor.body import Body, ring
from turgor.scene import Scene, cage, flat, polyline
from turgor.simulate import Rollout, Simulator
from turgor.task import Leave, Task, make_task

quick = settings(
    derandomize=True,
    deadline=None,
    max_examples=30,
    database=None,
    suppress_health_check=list(HealthCheck),
    phases=[Phase.explicit, Phase.generate],  # a failing example is as good as it is found: shrinking takes minutes
)


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


@st.composite
def rings(draw: st.DrawFn, *, bursting: bool = False) -> Body:
    """Rings of 3 to 24 masses that stand clear of each other, with gas for up to three times the pressure that
    carries them, but no more than their springs hold; with up to fifty times of it if `bursting`."""
    count = draw(st.integers(3, 24))
    side = draw(number(0.3, 1.5))
    radius = max(draw(number(1, 12)), side / np.sin(np.pi / count))
    density = draw(number(500, 5000))
    frequency = draw(number(2, 10))
    mass = density * side**2
    carrying = count * mass * 10 / (2 * radius)
    # R = r / (1 - p cot(π/n) / (2 k)), k = m/2 ω²: at most 1.4 r
    holding = 0.3 * mass * (2 * np.pi * frequency) ** 2 * np.tan(np.pi / count)
    most = 50 * carrying if bursting else min(3 * carrying, holding)
    # p_max = 1.25 nRT / (π r²)
    amount = most * np.pi * radius**2 / (1.25 * 8.314 * 288.15)
    return ring(
        count,
        radius,
        gas_amount=draw(st.sampled_from([0, 0.01, 0.3, 1])) * amount,
        side=side,
        density=density,
        frequency=frequency,
        damping_ratio=draw(number(0, 1)),
        friction=draw(number(0, 20)),
    )


@st.composite
def heaps(draw: st.DrawFn) -> Body:
    """Bodies that are no rings: masses anywhere (overlapping ones too), springs and chambers between any of them."""
    count = draw(st.integers(1, 9))
    at = st.tuples(number(-6, 6), number(-6, 6))
    position = draw(st.lists(at, min_size=count, max_size=count))
    pairs = [(a, b) for a in range(count) for b in range(a) if np.hypot(*np.subtract(position[a], position[b])) > 0.01]
    springs = draw(st.lists(st.sampled_from(pairs), unique=True, max_size=12)) if pairs else []
    chambers = []
    for _ in range(draw(st.integers(0, 2)) if count >= 3 else 0):
        corners = draw(st.lists(st.integers(0, count - 1), min_size=3, max_size=count, unique=True))
        chambers.append(corners)
    per_mass = st.lists(number(0, 7), min_size=count, max_size=count)
    return Body(
        position,
        angle=draw(per_mass),
        springs=springs,
        chambers=chambers,
        gas_amount=draw(st.sampled_from([0.0, 1.0, 300.0, 5000.0])),
        side=draw(number(0.2, 2)),
        frequency=draw(number(0.5, 12)),
    )


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Polylines, cages, planes, isolated segments, nothing."""
    kind = draw(st.sampled_from(["hills", "cage", "flat", "segments", "nothing"]))
    friction = draw(number(0, 5))
    if kind == "hills":
        return hills_of(draw, friction)
    if kind == "cage":
        roof = draw(number(8, 30))
        return cage(width=draw(number(15, 60)), roof=roof, aperture=draw(number(0, 0.9)) * roof, friction=friction)
    if kind == "segments":
        ends = st.tuples(*[number(-30, 30)] * 4).filter(lambda s: np.hypot(s[2] - s[0], s[3] - s[1]) > 0.1)
        segments = draw(st.lists(ends, min_size=1, max_size=8))
        return Scene(segments, draw(st.sampled_from([0.0, 2.0])), friction)
    return flat(friction=friction) if kind == "flat" else Scene([], friction=friction)


def hills_of(draw: st.DrawFn, friction: float) -> Scene:
    steps = draw(st.lists(number(1.5, 15), min_size=4, max_size=25))
    heights = draw(st.lists(number(0, 6), min_size=len(steps) + 1, max_size=len(steps) + 1))
    x = np.cumsum([0.0, *steps])
    return polyline(np.stack([x - x[-1] / 2, heights], axis=1), friction=friction)


def task_of(body: Body, scene: Scene, lift: float, steps: int = 150) -> Task:
    condition = "pressure" if body.chamber_count and body.gas_amount.min() > 0 else "springs"
    start = body.position + np.array([0.0, lift - body.lowest_corner()])
    return Task(name="any", body=body, scene=scene, position=start, condition=condition, steps=steps)


def thetas(task: Task, agents: int, seed: int, scale: float) -> np.ndarray:
    return scale * np.random.default_rng(seed).uniform(-1, 1, (agents, task.parameter_count))


def finite(out: Rollout) -> bool:
    return all(np.isfinite(array).all() for array in (out.position, out.com, out.fitness))


def ground_under(scene: Scene, x: np.ndarray) -> np.ndarray:
    """Height of a polyline or plane at each x."""
    ground = scene.segments[scene.depth > 0]
    ends = ground.reshape(-1, 2)
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    return np.interp(x, ends[:, 0], ends[:, 1])


# --- hypothesis ---------------------------------------------------------------------------------------------


@quick
@given(body=st.one_of(rings(bursting=True), heaps()), scene=scenes(), seed=st.integers(0, 99), data=st.data())
def test_states_stay_finite(body: Body, scene: Scene, seed: int, data: st.DataObject) -> None:
    """Huge controllers, overlapping masses, fifty times the gas: never NaN, and never faster than the limit."""
    task = task_of(body, scene, data.draw(number(-3, 10)))
    scale = 10.0 ** data.draw(st.sampled_from([-3, 0, 2, 8, 15]))
    out = Simulator(task, threads=1).rollout(thetas(task, 3, seed, scale))
    assert finite(out)
    rec = Simulator(task, threads=1).record(thetas(task, 3, seed, scale)[1])
    for array in (rec.position, rec.velocity, rec.pressure, rec.rest_length, rec.observation):
        assert np.isfinite(array).all()
    assert np.abs(rec.observation).max() <= 1 + 1e-5
    # 2 m a step, and contacts move by at most 0.2 m for each of two points in each of 3 iterations
    assert np.linalg.norm(rec.velocity, axis=2).max() <= 2 * 60 * 1.00001
    low, high = body.shortest * body.rest_length, body.longest * body.rest_length
    assert (rec.rest_length >= low * 0.99999).all()
    assert (rec.rest_length <= high * 1.00001).all()
    np.testing.assert_array_equal(rec.position[-1], out.position[1])


@quick
@given(body=rings(), seed=st.integers(0, 99), data=st.data())
def test_rings_stay_above_the_ground(body: Body, seed: int, data: st.DataObject) -> None:
    """No mass's centre is ever below the ground line (by more than 0.1 m), nor beyond a terrain's end walls, unless
    it moves by more than half its side in a step: there is no continuous collision. Even those that get 0.5 m below
    a plane are back within 5 steps.
    """
    scene = data.draw(st.sampled_from([flat(), None])) or hills_of(data.draw, 0.2)
    height = 0.1 + ground_under(scene, np.linspace(-14, 14, 400)).max()
    half_extent = np.abs(scene.segments[:, [0, 2]]).max()
    task = task_of(body, scene, height, steps=300)
    if half_extent < np.abs(body.position[:, 0]).max() + 2 * body.side.max():
        return  # it does not fit between the walls
    for theta in thetas(task, 2, seed, 3.0):
        position = Simulator(task, threads=1).record(theta).position
        fastest = np.linalg.norm(np.diff(position, axis=0), axis=-1).max()
        above = position[..., 1] - ground_under(scene, position[..., 0])
        if fastest < body.side.min() / 2:
            assert above.min() > -0.1
            assert np.abs(position[..., 0]).max() < half_extent
        elif scene.segments.shape[0] == 1:
            assert not any((above[k : k + 6] < -0.5).all(axis=0).any() for k in range(295))


@quick
@given(body=st.one_of(rings(), heaps()), scene=scenes(), size=st.integers(1, 40), seed=st.integers(0, 99))
def test_batches_do_not_matter(body: Body, scene: Scene, size: int, seed: int) -> None:
    task = task_of(body, scene, 1.0, steps=80)
    theta = thetas(task, size, seed, 3.0)
    whole = Simulator(task, threads=2).rollout(theta)
    assert finite(whole)
    for agent in {0, size // 2, size - 1}:
        alone = Simulator(task, threads=1).rollout(theta[agent, None])
        np.testing.assert_array_equal(alone.position[0], whole.position[agent])


@quick
@given(body=rings(), data=st.data())
def test_a_turned_world_is_the_same_world(body: Body, data: st.DataObject) -> None:
    """In free space a body does what it does wherever it stands, mirror images included, for a while."""
    shift = np.array([data.draw(st.integers(-16, 16)), data.draw(st.integers(-16, 16))], float)
    lengths = body.rest_length * np.random.default_rng(0).uniform(0.8, 1.2, (40, body.spring_count))
    here = turgor.replay(body, Scene([]), lengths, None, gravity=0.0)
    there = turgor.replay(body, Scene([]), lengths, None, position=body.position + shift, gravity=0.0)
    np.testing.assert_allclose(there.position - shift, here.position, atol=2e-3)


# --- 10,000 random controllers on every task ----------------------------------------------------------------

AGENTS = {"small": 10_000, "medium": 2_000, "large": 1_000}
RECORDED = 24
CASES = [(name, body) for name in ("flat", "hilly", "escape", "escape-authors") for body in AGENTS]


@functools.cache
def population(name: str, body: str) -> tuple[Task, np.ndarray]:
    """Controllers of uniform weights in [-1, 1], a quarter of them five times, and a quarter a fifth as strong."""
    task = make_task(name, body=body)
    theta = np.random.default_rng(1).uniform(-1, 1, (AGENTS[body], task.parameter_count))
    theta[1::4] *= 5
    theta[2::4] *= 0.2
    return task, theta


@functools.cache
def everywhere(name: str, body: str) -> tuple[Rollout, np.ndarray]:
    """Where all of them end, and every position of some [agent * step, mass, 2]."""
    task, theta = population(name, body)
    out = Simulator(task).rollout(theta)
    simulator = Simulator(task)
    # the fastest and some at random
    chosen = np.argsort(-np.abs(out.com[:, 0] - out.start[:, 0]))[: RECORDED // 2].tolist() + list(range(RECORDED // 2))
    return out, np.concatenate([simulator.record(theta[agent]).position for agent in chosen])


def solids(task: Task) -> list[tuple[float, float, float, float]]:
    """What a cage is made of, without the ground: left, right, bottom, top of both walls and the roof [m]."""
    segments = task.scene.segments
    inner, outer, roof, aperture, top = (segments[k, c] for k, c in ((5, 0), (6, 0), (5, 1), (5, 3), (6, 3)))
    assert isinstance(task.end, Leave)
    assert (task.end.half_width, outer - inner) == (outer, 1.0)
    walls = [(inner, outer, aperture, top), (-outer, -inner, aperture, top)]
    return [*walls, (-inner, inner, roof, top)]


@pytest.mark.parametrize(("name", "body"), CASES)
def test_no_mass_of_10000_agents_is_lost(name: str, body: str) -> None:
    out, recorded = everywhere(name, body)
    task, _ = population(name, body)
    assert finite(out)
    assert np.isfinite(recorded).all()
    # a resting centre is half a metre above the ground; the fastest (0.4 m a step) are beneath it for a moment
    for position, least in ((out.position, 0.2), (recorded, -0.25)):
        x, y = position[..., 0], position[..., 1]
        above = y - ground_under(task.scene, x)
        assert above.min() > least, f"{above.min():.3f} m above the ground"
        reach = np.abs(task.scene.segments[:, [0, 2]])
        low, high = (-20.0, reach.max()) if name == "hilly" else (-reach.max(), reach.max())
        assert low < x.min() < x.max() < high


@pytest.mark.parametrize(("name", "body"), [case for case in CASES if case[0].startswith("escape")])
def test_no_mass_of_10000_agents_goes_through_a_wall(name: str, body: str) -> None:
    """No centre is ever inside a wall or the roof, though a square is stopped at half a metre from either, and none
    comes to be above the roof or outside except through the aperture."""
    out, recorded = everywhere(name, body)
    task, _ = population(name, body)
    boxes = solids(task)
    (inner, outer, aperture, top), roof = boxes[0], boxes[2][2]
    for position in (out.position, recorded):
        x, y = position[..., 0], position[..., 1]
        for left, right, bottom, upper in boxes:
            inside = (x > left) & (x < right) & (y > bottom) & (y < upper)
            assert not inside.any(), f"{inside.sum()} masses in the solid {left, right, bottom, upper}"
        assert not (y > top).any()
    # steps from one side of a wall to the other, whose whole way is below the aperture's upper edge
    path = recorded
    here, there = path[:-1], path[1:]
    joined = np.abs(there - here).max(axis=(1, 2)) < 3  # not from one agent's end to the next one's start
    side = np.sign(np.abs(path[..., 0]) - (inner + outer) / 2)
    crossed = (side[:-1] != side[1:]) & joined[:, None]
    assert (np.maximum(here[..., 1], there[..., 1])[crossed] < aperture).all()
    assert (np.abs(out.position[..., 0]) < inner).mean() > 0.5
    assert roof < top
    if body == "small":
        assert crossed.any()
        assert (np.abs(out.position[..., 0]) > outer).any()
