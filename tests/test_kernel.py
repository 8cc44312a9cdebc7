"""The engine against the plain reference: stage by stage, step by step from copied states, and over whole stretches.

The reference runs in float64 from the engine's own float32 state, so that what differs is the engine's rounding.
"""

from __future__ import annotations

import functools
from collections import deque
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import pytest
from numba import njit

from turgor.body import Body, ring
from turgor.control import rows
from turgor.physics import reference
from turgor.physics.actuate import tanh
from turgor.physics.lanes import Floats, Width, aligned, field_of, layout, views
from turgor.physics.model import COMMANDS, CONTROLLER, WIDTH, Model, State, make_kernel
from turgor.scene import GROUND_DEPTH, Scene, flat
from turgor.simulate import Simulator, _Batch, replay
from turgor.task import Physics, Task, make_task

BODIES = ("small", "medium", "large")
NAMES = ("flat", "hilly", "escape", "escape-authors")
CONDITIONS = ("pressure", "springs", "passive")
NEVER = 10**9  # a last step that does not come

Impulses = dict[reference.Key, list[reference.Stored]]


class Engine:
    """Agents of a task in the engine, which can be stopped and read between two steps."""

    def __init__(self, task: Task, theta: np.ndarray, position: np.ndarray | None = None) -> None:
        self.task, self.theta, self.steps = task, theta, 0
        starts = np.repeat(task.position[None], len(theta), axis=0) if position is None else position
        self.kernel = make_kernel(msgspec.structs.replace(task, end=None))
        self.batch = _Batch(self.kernel, starts.astype(np.float32))
        self.batch.think(*rows(theta, task.body, task.condition))
        self.batch.run(CONTROLLER, first=0, steps=0, last=NEVER)

    def run(self, steps: int) -> None:
        self.batch.run(CONTROLLER, first=self.steps, steps=steps, last=NEVER)
        self.steps += steps

    def state(self, name: str, agent: int) -> np.ndarray:
        """A field of the engine's State for one agent (a table as it is)."""
        array = self.kernel.field(self.batch.memory[agent // WIDTH], State, name)
        return array if array.ndim == 1 else array[:, agent % WIDTH]

    def model(self, name: str) -> np.ndarray:
        return self.kernel.field(self.kernel.tables, Model, name)

    def impulses(self, agent: int) -> Impulses:
        """What the last contacts keep for the next step [N s]; the engine keeps it per unit of effective mass."""
        found, mass, slots = {}, self.task.body.mass, int(self.kernel.settings.slots)

        def points(kind: str, at: int, effective: float) -> list[reference.Stored]:
            fields = [[self.state(f"{kind}_{name}{k}", agent)[at] for name in ("id", "normal", "tangent")] for k in (0, 1)]
            return [(int(id), effective * float(n), effective * float(t)) for id, n, t in fields if id >= 0]

        for slot in np.flatnonzero(self.state("ground_live", agent)):
            key = ("ground", int(slot) // slots, int(self.state("segment", agent)[slot]))
            found[key] = points("ground", slot, mass[key[1]])
        for p in np.flatnonzero(self.state("pair_live", agent)):
            a, b = int(self.model("pair_a")[p]), int(self.model("pair_b")[p])
            found["pair", a, b] = points("pair", p, 1 / (1 / mass[a] + 1 / mass[b]))
        return {key: stored for key, stored in found.items() if stored}

    def spring_impulse(self, agent: int) -> np.ndarray:
        """[N s], in the body's order."""
        impulse = np.zeros(self.task.body.spring_count)
        impulse[self.model("spring")] = self.state("impulse", agent)
        return impulse

    def copied(self, agent: int) -> reference.State:
        """The agent as the reference has it: all that the next step depends on."""
        task, window = self.task, self.task.sensing.window
        past = self.state("window", agent).reshape(window, -1)
        # the engine has made the present observation already, in slot `steps`; the reference is about to make it
        kept = range(max(self.steps - window + 1, 0), self.steps)
        return reference.State(
            position=np.stack([self.state(k, agent) for k in "xy"], axis=1).astype(np.float64),
            velocity=np.stack([self.state(k, agent) for k in ("vx", "vy")], axis=1).astype(np.float64),
            pressure=self.state("pressure", agent).astype(np.float64),
            rest_length=self.state("rest", agent).astype(np.float64),
            touch=self.state("touch", agent) > 0,
            spring_impulse=self.spring_impulse(agent),
            contacts=self.impulses(agent),
            window=deque([past[k % window].astype(np.float64) for k in kept], maxlen=window),
        )


def controllers(task: Task, agents: int, seed: int, scale: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-scale, scale, (agents, task.parameter_count))


@pytest.fixture
def engine_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the reference solve pairs in the engine's order, by the distance of their indices: any order is as good
    as any other (Box2D's is by age), but two contacts of one mass solved the other way round differ by far more than
    rounding."""
    plain = reference.near_pairs
    monkeypatch.setattr(reference, "near_pairs", lambda *args: sorted(plain(*args), key=lambda p: (p[1] - p[0], p[0])))


@pytest.mark.parametrize("body", BODIES)
def test_the_engines_pairs_are_in_the_order_that_these_tests_assume(body: str) -> None:
    kernel = make_kernel(make_task("flat", body=body))
    a, b = (kernel.field(kernel.tables, Model, name) for name in ("pair_a", "pair_b"))
    pairs = list(zip(a.tolist(), b.tolist(), strict=True))
    assert pairs == sorted(pairs, key=lambda p: (p[1] - p[0], p[0]))
    n = kernel.settings.masses
    assert set(pairs) == {(a, b) for a in range(n) for b in range(a + 2, n) if (a, b) != (0, n - 1)}


# --- whole steps from the start -----------------------------------------------------------------------------


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("name", NAMES)
def test_the_first_30_steps(name: str, body: str, condition: str, engine_order: None) -> None:
    task = msgspec.structs.replace(make_task(name, body=body, condition=condition), steps=30)
    theta = controllers(task, 1, seed=BODIES.index(body))[0]
    mine, plain = Simulator(task).record(theta), reference.rollout(task, theta)
    assert mine.steps == plain.steps == 30
    # An ulp at 10 m is 1e-6 m. What one step rounds away grows by a factor of 1.1 a step at the worst (1e-6 m become
    # 1e-4 m in 37 to 61 steps), to which contacts add a few units.
    assert np.abs(mine.position - plain.position).max() <= 2e-5
    assert np.abs(mine.velocity - plain.velocity).max() <= 1e-3
    assert np.abs(mine.observation - plain.observation).max() <= 2e-5
    np.testing.assert_array_equal(mine.touch, plain.touch)
    np.testing.assert_allclose(mine.rest_length, plain.rest_length, rtol=1e-5)
    np.testing.assert_allclose(mine.pressure, plain.pressure, rtol=2e-5)


# --- single steps from copied states ------------------------------------------------------------------------

# name, body, condition, scale of theta, steps before each comparison
STATES = {
    "hilly-small": ("hilly", "small", "pressure", 1, (1, 30, 31, 250, 900)),
    "hilly-medium": ("hilly", "medium", "pressure", 1, (10, 300, 700)),
    "hilly-large": ("hilly", "large", "pressure", 1, (200, 600, 1500)),
    "hilly-squeezed": ("hilly", "small", "pressure", 20, (100, 400, 1000)),
    "hilly-springs": ("hilly", "small", "springs", 3, (60, 500)),
    "hilly-passive": ("hilly", "large", "passive", 1, (350,)),
    "flat-small": ("flat", "small", "pressure", 1, (2, 120, 800)),
    "flat-springs": ("flat", "medium", "springs", 1, (24, 25, 26)),
    "cage-small": ("escape", "small", "pressure", 3, (50, 400, 1200)),
    "cage-large": ("escape", "large", "pressure", 1, (1, 150, 700)),
    "cage-squeezed": ("escape-authors", "small", "pressure", 20, (200, 900)),
    "cage-springs": ("escape-authors", "medium", "springs", 3, (300,)),
}
AGENTS = 8

# How far a step of the engine may be from one of the reference: float32 rounding of sums of a few terms, each of which
# is an ulp or so of the largest number that goes into it.
POSITION = 4e-6  # [m]
VELOCITY = 2e-4  # [m/s]
IMPULSE = 2.0  # [N s], of masses of 2500 kg
OBSERVATION = 2e-6
RELATIVE = 2e-6  # pressures, rest lengths


class Difference(NamedTuple):
    position: float
    velocity: float
    impulse: float
    observation: float
    relative: float
    same_contacts: bool

    def small(self) -> bool:
        limits = (POSITION, VELOCITY, IMPULSE, OBSERVATION, RELATIVE)
        return self.same_contacts and all(value <= limit for value, limit in zip(self, limits, strict=False))


def difference(plain: reference.State, observation: np.ndarray, seen: np.ndarray, mine: reference.State) -> Difference:
    """Between a step of the reference and the same step of the engine."""
    contacts = {key: [id for id, _, _ in stored] for key, stored in plain.contacts.items()}
    same = contacts == {key: [id for id, _, _ in stored] for key, stored in mine.contacts.items()}
    same &= np.array_equal(plain.touch, mine.touch)
    impulse = np.abs(plain.spring_impulse - mine.spring_impulse).max(initial=0)
    if same:
        both = [(np.array(plain.contacts[key]), np.array(mine.contacts[key])) for key in contacts]
        impulse = max([impulse, *(np.abs(a - b).max() for a, b in both)])
    return Difference(
        position=np.abs(plain.position - mine.position).max(),
        velocity=np.abs(plain.velocity - mine.velocity).max(),
        impulse=impulse,
        observation=np.abs(observation - seen).max(),
        relative=max(
            np.abs(mine.pressure / plain.pressure - 1).max(), np.abs(mine.rest_length / plain.rest_length - 1).max()
        ),
        same_contacts=same,
    )


def moved(state: reference.State, rng: np.random.Generator) -> reference.State:
    """`state` with its masses moved by a float32 ulp or so."""
    shape = state.position.shape
    return reference.State(
        position=state.position * (1 + rng.uniform(-1e-7, 1e-7, shape)) + rng.uniform(-1e-7, 1e-7, shape),
        velocity=state.velocity.copy(),
        pressure=state.pressure.copy(),
        rest_length=state.rest_length.copy(),
        touch=state.touch.copy(),
        spring_impulse=state.spring_impulse.copy(),
        contacts=dict(state.contacts),
        window=deque(state.window, maxlen=state.window.maxlen),
    )


class Compared(NamedTuple):
    """One state from which both made a step."""

    difference: Difference
    undecided: bool  # the reference itself goes elsewhere if its masses are moved by an ulp
    grounds: int
    pairs: int
    segments: int  # most segments that one mass touches
    squeezed: bool  # area below half of that at rest


@functools.cache
def compared(case: str) -> list[Compared]:
    """Every agent of a case at all of its times."""
    name, body, condition, scale, times = STATES[case]
    task = make_task(name, body=body, condition=condition, seed=len(case) % 5)
    engine, results = Engine(task, controllers(task, AGENTS, seed=len(case), scale=scale)), []
    rng = np.random.default_rng(0)
    for t in times:
        engine.run(t - engine.steps)
        before = [engine.copied(agent) for agent in range(AGENTS)]
        seen = engine.batch.stand()["observation"]
        engine.run(1)
        for agent, state in enumerate(before):
            origin, mine = moved(state, rng), engine.copied(agent)
            area, at_rest = task.body.area(state.position)[0], task.body.area(task.body.position)[0]
            observation = reference.step(state, task, engine.theta[agent])
            found = difference(state, observation, seen[agent], mine)
            undecided = False
            if not found.small():
                for _ in range(20):
                    other = moved(origin, rng)
                    reference.step(other, task, engine.theta[agent])
                    undecided |= not difference(other, observation, observation, state).small()
            touched = [key[1] for key in state.contacts if key[0] == "ground"]
            results.append(
                Compared(
                    difference=found,
                    undecided=undecided,
                    grounds=len(touched),
                    pairs=len(state.contacts) - len(touched),
                    segments=max(map(touched.count, touched), default=0),
                    squeezed=area < 0.5 * at_rest,
                )
            )
    return results


@pytest.mark.parametrize("case", STATES)
def test_single_steps_from_copied_states(case: str, engine_order: None) -> None:
    results = compared(case)
    wrong = [r for r in results if not r.difference.small()]
    assert all(r.undecided for r in wrong), "\n".join(map(str, wrong))
    # a contact that begins or ends within rounding is not held against the engine, but it is rare
    assert len(wrong) <= 1


def test_the_copied_states_are_of_all_kinds(engine_order: None) -> None:
    results = [r for case in STATES for r in compared(case)]
    assert len(results) >= 200
    assert sum(r.grounds > 0 for r in results) >= 150
    assert sum(r.pairs > 0 for r in results) >= 50
    assert sum(r.pairs > 1 for r in results) >= 20
    assert sum(r.segments > 1 for r in results) >= 20
    assert sum(r.squeezed for r in results) >= 20
    assert sum(r.grounds == 0 for r in results) >= 5
