"""The physics of one agent in plain NumPy: slow, obvious, and the oracle of the fast engine's tests.

It is the algorithm of Box2D 2.3 (soft springs, sequential impulses, warm starting, Gauss-Seidel position
correction) for squares that never turn. One step: sense, control, actuate, pressure force, contacts, solve.

    state = start(task)
    for _ in range(task.steps):
        step(state, task, theta)
"""

from __future__ import annotations

import functools
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from turgor.body import Body
from turgor.physics.reference_contacts import (
    Manifold,
    geometry,
    near_pairs,
    near_segments,
    square_segment,
    square_square,
)
from turgor.physics.reference_control import control, sense
from turgor.recording import Recording
from turgor.scene import Scene
from turgor.task import Leave, Physics, Task, start_position

WORLD = -1  # index of the static world: the row after the last mass, with infinite mass

Key = tuple[str, int, int]  # ("ground", mass, segment) or ("pair", a, b) with a < b
Stored = tuple[int, float, float]  # feature id, normal and tangential impulse [N s]


@dataclass
class State:
    """What moves. Everything else is in the task."""

    position: np.ndarray  # [m], shape [mass, 2]
    velocity: np.ndarray  # [m/s], shape [mass, 2]
    pressure: np.ndarray  # [Pa], shape [chamber], that acted last
    rest_length: np.ndarray  # [m], shape [spring], that acted last
    touch: np.ndarray  # bool, shape [mass], of the last solver's contacts
    spring_impulse: np.ndarray  # [N s], shape [spring], for warm starting
    contacts: dict[Key, list[Stored]] = field(default_factory=dict)  # for warm starting
    window: deque[np.ndarray] = field(default_factory=deque)  # the last observations
    phase: Any = 0.0  # [turn], in [0, 1), of a sinusoid
    messages: Any = None  # of a distributed controller, on their way: [spring, forth and back, message]


@dataclass
class Contact:
    """Two bodies that touch, seen from a to b; rotation is fixed, so a point is an id and a distance."""

    key: Key
    a: int  # mass, or WORLD
    b: int
    normal: np.ndarray  # [1], from a to b
    friction: float
    ids: list[int]  # of 1 or 2 points
    distance: list[Any]  # [m], d of each point: separation = normal . (x_b - x_a) - d
    normal_impulse: list[Any]  # [N s], of each point; the velocity solver uses the first alone
    tangent_impulse: list[Any]


class Constants(msgspec.Struct, frozen=True):
    """Arrays of a task in one floating-point type. A row more than masses where the world takes part."""

    inverse_mass: Any  # [1/kg], shape [mass + 1]
    stiffness: Any  # k [N/m], shape [spring]
    damping: Any  # c [N s/m], shape [spring]


@functools.lru_cache(maxsize=64)
def constants(task: Task, dtype: DTypeLike) -> Constants:
    """The arrays of `task`, in `dtype`."""
    body = task.body
    i, j = body.springs.T
    # m = 1 / (1/m_i + 1/m_j), ω = 2 π f:  k = m ω²,  c = 2 m ζ ω
    reduced, omega = 1 / (1 / body.mass[i] + 1 / body.mass[j]), 2 * np.pi * body.frequency
    return Constants(
        inverse_mass=np.append(1 / body.mass, 0).astype(dtype),
        stiffness=(reduced * omega**2).astype(dtype),
        damping=(2 * reduced * body.damping_ratio * omega).astype(dtype),
    )


def start(
    task: Task,
    position: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    dtype: DTypeLike = np.float64,
) -> State:
    """The state before step 1. `position` [m] and `velocity` [m/s], shape [mass, 2], replace the task's; with an index
    of agents before that, sensing, control, actuation and the gas's force are those of many at once."""
    body = task.body
    position = np.array(task.position if position is None else position, dtype=dtype)
    agents = position.shape[:-2]
    return State(
        position=position,
        velocity=np.zeros_like(position) if velocity is None else np.array(velocity, dtype=dtype),
        pressure=np.tile(task.pressure_start.astype(dtype), (*agents, 1)),
        rest_length=np.tile(body.rest_length.astype(dtype), (*agents, 1)),
        touch=np.zeros(position.shape[:-1], dtype=bool),
        spring_impulse=np.zeros(body.spring_count, dtype),
        window=deque(maxlen=task.sensing.window),
        phase=np.zeros(agents),
        messages=np.zeros((*agents, body.spring_count, 2, getattr(task.controller, "messages", 0))),
    )


# --- the step -----------------------------------------------------------------------------------------------


def step(state: State, task: Task, theta: ArrayLike | None = None) -> np.ndarray:
    """The observation that the controller `theta` saw; `state` is one step later."""
    observation = sense(state, task)
    commands, pressure_change = control(state, observation, theta, task)
    actuate(state, task, commands, pressure_change)
    move(state, task)
    return observation


def step_given(state: State, task: Task, rest_length: ArrayLike, pressure: ArrayLike | None) -> None:
    """`state` one step later, with rest lengths [m] and pressure [Pa] given (None: the gas law's)."""
    state.rest_length[:] = rest_length
    state.pressure[:] = gas_pressure(state, task) if pressure is None else pressure
    move(state, task)


def move(state: State, task: Task) -> None:
    """The mechanics of a step, under the state's own pressure and rest lengths."""
    force = pressure_force(state, task)
    contacts = find_contacts(state, task)
    solve(state, task, force, contacts)
    remember(state, contacts)


# --- actuation, pressure ------------------------------------------------------------------------------------


def actuate(state: State, task: Task, commands: np.ndarray, pressure_change: np.ndarray) -> None:
    """Rest lengths and pressure take effect at once."""
    # L = L0 - s (L0 - l_min) for s > 0, L0 - s (l_max - L0) otherwise
    body = task.body
    span = np.where(commands > 0, 1 - body.shortest, body.longest - 1) * body.rest_length
    state.rest_length[:] = body.rest_length - commands * span
    # p = clip(p + dp, p_min, p_max), or the gas law
    if task.condition == "pressure":
        state.pressure[:] = np.clip(state.pressure + pressure_change, *task.pressure_range.T)
    else:
        state.pressure[:] = gas_pressure(state, task)


def gas_pressure(state: State, task: Task) -> np.ndarray:
    """Pressure [Pa], shape [chamber], of an ideal gas in the present (signed) area."""
    # p = n R T / max(A, A_min)
    return task.gas_energy / np.maximum(task.body.area(state.position), task.area_floor)


def pressure_force(state: State, task: Task) -> np.ndarray:
    """Force of the gas on each mass [N], shape [mass, 2]; with true lengths the forces sum to zero."""
    # each edge d of a counter-clockwise loop gives both of its ends p/2 (d_y, -d_x): p l/2 outwards
    force = np.zeros_like(state.position)
    for c, loop in enumerate(task.body.chambers):
        i, j = np.array(loop), np.roll(loop, -1)
        d = state.position[..., j, :] - state.position[..., i, :]
        if task.physics.pressure_length == "commanded":
            l = np.maximum(np.linalg.norm(d, axis=-1), 1e-9)
            d = d * (commanded_length(state, task, i, j) / l)[..., None]
        push = state.pressure[..., c, None, None] / 2 * np.stack([d[..., 1], -d[..., 0]], axis=-1)
        force[..., i, :] += push
        force[..., j, :] += push
    return force


def commanded_length(state: State, task: Task, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Rest length [m] of the spring that joins masses i and j; their true distance where none does."""
    length = np.linalg.norm(state.position[..., j, :] - state.position[..., i, :], axis=-1)
    for spring, pair in enumerate(task.body.springs):
        joined = np.isin(i, pair) & np.isin(j, pair)
        length[..., joined] = state.rest_length[..., spring, None]
    return length


# --- contacts -----------------------------------------------------------------------------------------------


def find_contacts(state: State, task: Task) -> list[Contact]:
    """Every contact at the present positions, in the solver's order.

    Pairs come first, then ground by mass, last segment first: where Box2D's order by age mostly leads, as its
    islands start at a mass's newest contacts.
    """
    g, x, skin = geometry(task, state.position.dtype), state.position, 2 * task.physics.skin
    contacts = []

    def add(key: Key, a: int, b: int, friction: float, manifold: Manifold | None) -> None:
        if manifold is None:
            return
        normal, points = manifold
        at = normal @ (x[b] - x[a] if a != WORLD else x[b])
        old = {id: (n, t) for id, n, t in state.contacts.get(key, [])}
        stored = [old.get(id, (0.0, 0.0)) for id, _ in points]
        ids, distance = [id for id, _ in points], [at - (s - skin) for _, s in points]
        impulses = map(list, zip(*stored, strict=True))
        contacts.append(Contact(key, a, b, normal, friction, ids, distance, *impulses))

    for a, b in near_pairs(x, g, skin):
        add(("pair", a, b), a, b, task.body.friction, square_square(x, g, a, b, skin))
    friction = float(np.sqrt(task.body.friction * task.scene.friction))
    for mass, segment in near_segments(x, task, g, skin):
        depth = task.scene.depth[segment]
        manifold = square_segment(x[mass], g, mass, g.ends[segment], g.normal[segment], depth, skin)
        add(("ground", mass, segment), WORLD, mass, friction, manifold)
    return contacts


# --- solver -------------------------------------------------------------------------------------------------


@dataclass
class Springs:
    """Soft constraints, prepared for one step."""

    pair: np.ndarray  # [spring, 2]
    u: np.ndarray  # [1], shape [spring, 2], direction
    gamma: np.ndarray  # [1/kg], softness
    bias: np.ndarray  # [m/s]
    mass: np.ndarray  # [kg], effective
    impulse: np.ndarray  # [N s], accumulated


def solve(state: State, task: Task, force: np.ndarray, contacts: list[Contact]) -> None:
    """Velocities, then positions, after one time step under `force` [N] and gravity."""
    physics, c = task.physics, constants(task, state.position.dtype)
    w = c.inverse_mass
    v = np.vstack([state.velocity, np.zeros(2, state.velocity.dtype)])  # the last row is the world's
    x = np.vstack([state.position, np.zeros(2, state.position.dtype)])
    # v += h (F/m + g)
    v[:-1] += physics.dt * (w[:-1, None] * force + np.array([0, -physics.gravity], dtype=v.dtype))
    springs = prepare_springs(state, task, c)
    for contact in contacts:  # warm start
        push(v, w, contact, contact.normal_impulse[0], contact.tangent_impulse[0])
    for s in reversed(range(len(springs.pair))):
        pull(v, w, springs, s, springs.impulse[s])
    for _ in range(physics.velocity_iterations):
        for s in reversed(range(len(springs.pair))):
            solve_spring(v, w, springs, s)
        for contact in contacts:
            solve_contact(v, w, contact)
    integrate(x, v, physics)
    for _ in range(physics.position_iterations):
        if correct_positions(x, w, contacts, physics) >= -3 * physics.slop:
            break
    state.position, state.velocity = x[:-1], v[:-1]


def prepare_springs(state: State, task: Task, c: Constants) -> Springs:
    """The springs as soft distance constraints, at the positions of the start of the step."""
    # C = |d| - L, u = d / |d|; implicit Euler of a spring k with a damper c, over a step h:
    # γ = 1 / (h (c + h k)),  bias = C h k γ,  m = 1 / (1/m_i + 1/m_j + γ)
    h, w, pair = task.physics.dt, c.inverse_mass, task.body.springs
    d = state.position[pair[:, 1]] - state.position[pair[:, 0]]
    length = np.sqrt((d * d).sum(axis=1))
    u = d / np.maximum(length, 1e-9)[:, None]
    u[length <= task.physics.slop] = 0  # no direction to speak of
    gamma = 1 / (h * (c.damping + h * c.stiffness))
    bias = (length - state.rest_length) * h * c.stiffness * gamma
    mass = 1 / ((u * u).sum(axis=1) * w[pair].sum(axis=1) + gamma)
    return Springs(pair, u, gamma, bias, mass, state.spring_impulse)


def pull(v: np.ndarray, w: np.ndarray, springs: Springs, s: int, impulse: Any) -> None:
    """Apply an impulse [N s] along spring `s`; positive drives its ends apart."""
    i, j = springs.pair[s]
    p = impulse * springs.u[s]
    v[i] -= w[i] * p
    v[j] += w[j] * p


def solve_spring(v: np.ndarray, w: np.ndarray, springs: Springs, s: int) -> None:
    """Bring one spring's velocity to where its softness wants it."""
    # Cdot = u . (v_j - v_i),  λ = -m (Cdot + bias + γ Λ)
    i, j = springs.pair[s]
    speed = springs.u[s] @ (v[j] - v[i])
    impulse = -springs.mass[s] * (speed + springs.bias[s] + springs.gamma[s] * springs.impulse[s])
    springs.impulse[s] += impulse
    pull(v, w, springs, s, impulse)


def push(v: np.ndarray, w: np.ndarray, contact: Contact, normal_impulse: Any, tangent_impulse: Any) -> None:
    """Apply impulses [N s] along the normal n and the tangent (n_y, -n_x) of a contact."""
    n = contact.normal
    p = normal_impulse * n + tangent_impulse * np.array([n[1], -n[0]])
    v[contact.a] -= w[contact.a] * p
    v[contact.b] += w[contact.b] * p


def solve_contact(v: np.ndarray, w: np.ndarray, contact: Contact) -> None:
    """Friction, then non-penetration; accumulated impulses are clamped, not their changes."""
    # t: λ = -m t . (v_b - v_a), |Λ_t| <= μ Λ_n;   n: λ = -m n . (v_b - v_a), Λ_n >= 0
    a, b, n = contact.a, contact.b, contact.normal
    mass = 1 / (w[a] + w[b])
    d = v[b] - v[a]
    limit = contact.friction * contact.normal_impulse[0]
    old = contact.tangent_impulse[0]
    new = min(max(old - mass * (n[1] * d[0] - n[0] * d[1]), -limit), limit)
    contact.tangent_impulse[0] = new
    push(v, w, contact, 0.0, new - old)
    old = contact.normal_impulse[0]
    new = max(old - mass * (n @ (v[b] - v[a])), 0.0)
    contact.normal_impulse[0] = new
    push(v, w, contact, new - old, 0.0)


def integrate(x: np.ndarray, v: np.ndarray, physics: Physics) -> None:
    """x += h v, at most `max_travel`; velocities are cut with it."""
    travel = physics.dt * np.sqrt((v * v).sum(axis=1, keepdims=True))
    v *= np.where(travel > physics.max_travel, physics.max_travel / np.maximum(travel, physics.max_travel), 1)
    x += physics.dt * v


def correct_positions(x: np.ndarray, w: np.ndarray, contacts: list[Contact], physics: Physics) -> Any:
    """The smallest separation [m] met while pushing every point of every contact out, one after the other."""
    # C = clamp(β (s + slop), -max_correction, 0),  P = -m C n: of every point, though the second is redundant
    smallest = 0.0
    for contact in contacts:
        a, b = contact.a, contact.b
        mass = 1 / (w[a] + w[b])
        for d in contact.distance:
            separation = contact.normal @ (x[b] - x[a]) - d
            smallest = min(smallest, separation)
            c = min(max(physics.baumgarte * (separation + physics.slop), -physics.max_correction), 0.0)
            p = -mass * c * contact.normal
            x[a] -= w[a] * p
            x[b] += w[b] * p
    return smallest


def remember(state: State, contacts: list[Contact]) -> None:
    """Keep the impulses for the next step's warm start, and what touched for the next observation."""
    state.contacts, state.touch[:] = {}, False
    for c in contacts:
        state.contacts[c.key] = list(zip(c.ids, c.normal_impulse, c.tangent_impulse, strict=True))
        state.touch[[i for i in (c.a, c.b) if i != WORLD]] = True


# --- whole trajectories -------------------------------------------------------------------------------------


def rollout(
    task: Task,
    theta: ArrayLike | None = None,
    steps: int | None = None,
    position: ArrayLike | None = None,
    dtype: DTypeLike = np.float64,
) -> Recording:
    """The trajectory of controller `theta` [parameter] over `steps` (None: the task's), or until its end."""
    state = start(task, position, dtype=dtype)
    record, observations, solved = [snapshot(state)], [], False
    for t in range(task.steps if steps is None else steps):
        if task.pressure is None:
            observations.append(step(state, task, theta))
        else:
            step_given(state, task, task.body.rest_length, task.pressure[t])
        record.append(snapshot(state))
        solved = bool(has_ended(state, task))
        if solved:
            break
    rec = recording(task, record, observation=np.array(observations) if observations else None, solved=solved)
    return msgspec.structs.replace(rec, fitness=fitness(rec, task))


def replay(
    body: Body,
    scene: Scene,
    rest_length: ArrayLike,
    pressure: ArrayLike | None,
    position: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    gravity: float = 10.0,
    physics: Physics | None = None,
    dtype: DTypeLike = np.float64,
) -> Recording:
    """The trajectory under `rest_length` [m], shape [step, spring], and `pressure` [Pa], shape [step] or
    [step, chamber] (None: gas law). `physics`, if given, holds the gravity as well."""
    where = start_position(body.position if position is None else position, body)
    physics = Physics(gravity=gravity) if physics is None else physics
    task = Task(name="replay", body=body, scene=scene, position=where, condition="passive", physics=physics)
    state = start(task, velocity=velocity, dtype=dtype)
    record = [snapshot(state)]
    for t, rest in enumerate(np.asarray(rest_length)):
        step_given(state, task, rest, None if pressure is None else np.asarray(pressure)[t])
        record.append(snapshot(state))
    return recording(task, record)


def snapshot(state: State) -> tuple[np.ndarray, ...]:
    fields = (state.position, state.velocity, state.pressure, state.rest_length, state.touch)
    return tuple(array.copy() for array in fields)


def recording(task: Task, record: list[tuple[np.ndarray, ...]], **rest: Any) -> Recording:
    names = ("position", "velocity", "pressure", "rest_length", "touch")
    arrays = dict(zip(names, map(np.array, zip(*record, strict=True)), strict=True))
    return Recording(body=task.body, scene=task.scene, dt=task.physics.dt, **arrays, **rest)


def has_ended(state: State, task: Task) -> np.ndarray:
    """Whether the task's end is reached: for `Leave`, every square wholly outside |x| <= half_width."""
    agents = state.position.shape[:-2]
    if task.end is None:
        return np.zeros(agents, dtype=bool)
    if not isinstance(task.end, Leave):
        ended = task.end(state.position.reshape(-1, *state.position.shape[-2:]))
        return np.asarray(ended, dtype=bool).reshape(agents)
    width = np.abs(geometry(task, state.position.dtype).vertex[..., 0]).max(axis=1)
    return (np.abs(state.position[..., 0]) - width > task.end.half_width).all(axis=-1)


def fitness(rec: Recording, task: Task) -> float | None:
    """The task's fitness of a recording; None for a function of the user's own, which takes whole batches."""
    if task.fitness == "area":
        return float(rec.area_ratio[-1, 0])
    distance = float(rec.com[-1, 0] - rec.com[0, 0])
    duration = task.physics.dt * rec.steps if task.fitness == "elapsed" else task.duration
    values = {"progress": distance, "distance": abs(distance), "elapsed": abs(distance)}
    return values[task.fitness] / duration if isinstance(task.fitness, str) else None
