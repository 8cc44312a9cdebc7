"""The arrays of the kernel: what is fixed (Settings, Model) and what moves (State, Work).

A block is `width` agents side by side, one per lane. Its State and Work are rows of lanes in one buffer.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np

from turgor.body import Body
from turgor.control import observation_count, output_count
from turgor.physics.lanes import Floats, FloatTable, Ints, IntTable, aligned, field_of, fields, layout
from turgor.scene import Scene
from turgor.task import Leave, Task

WIDTH = 16  # agents in a block: one AVX-512 vector; see ARCHITECTURE.md
NOWHERE = -1
LOOK_AGAIN = 64  # [step], after which all pairs are looked at, so that `travel` gathers no rounding errors
# [m], slack of the search for candidates over the exact tests, against rounding. A candidate search that misses a
# contact shows as an agent that depends on its neighbours: shapes are apart when they are `2 skin` apart along the
# normal of any face, so that corners can be sqrt(2) times as far away.
MARGIN = 1e-3

# where commands come from
CONTROLLER, COMMANDS, REPLAY = 0, 1, 2
# where the pressure comes from
GAS_LAW, CONTROLLED, GIVEN = 0, 1, 2


class Settings(NamedTuple):
    """Numbers that all agents share; int32 or float32."""

    lanes: np.int32
    masses: np.int32
    springs: np.int32
    chambers: np.int32
    inputs: np.int32
    outputs: np.int32
    chains: np.int32
    pairs: np.int32
    columns: np.int32
    slots: np.int32  # most segments that any column of the scene holds
    window: np.int32
    unit_observation: np.int32  # signed values v are observed as (v + 1) / 2
    pressure_source: np.int32
    commanded_length: np.int32  # pressure pushes on commanded lengths
    leaves: np.int32  # whether an agent is done once it left
    velocity_iterations: np.int32
    position_iterations: np.int32
    dt: np.float32  # [s]
    gravity: np.float32  # [m/s^2]
    slop: np.float32  # [m]
    reach: np.float32  # [m], both skins: a contact exists below this distance
    baumgarte: np.float32
    max_correction: np.float32  # [m]
    max_travel: np.float32  # [m]
    ground_friction: np.float32  # mixed with the masses'
    pair_friction: np.float32
    position_scale: np.float32  # [1/m]
    velocity_scale: np.float32  # [s/m]
    half_width: np.float32  # [m], of what is to be left


class Model(NamedTuple):
    """Tables that all agents share."""

    # masses
    half: Annotated[FloatTable, "mass"]  # [m], half side
    cosine: Annotated[FloatTable, "mass"]  # of the square's angle
    sine: Annotated[FloatTable, "mass"]
    extent: Annotated[FloatTable, "mass"]  # [m], half width of the turned square
    inverse_mass: Annotated[FloatTable, "mass"]  # [1/kg]
    share: Annotated[FloatTable, "mass"]  # mass / all mass
    # springs, in the order in which they are solved: chains in which each spring starts where the last one ended
    tail: Annotated[IntTable, "spring"]
    head: Annotated[IntTable, "spring"]
    spring: Annotated[IntTable, "spring"]  # its index in the body
    chain_start: Annotated[IntTable, "chain"]  # first spring of each chain, and the end of the last
    effective_mass: Annotated[FloatTable, "spring"]  # M = 1 / (1/m_t + 1/m_h + gamma) [kg]
    relaxation: Annotated[FloatTable, "spring"]  # M gamma [1]
    stiffness: Annotated[FloatTable, "spring"]  # M times bias per metre of stretch [kg/s]
    # springs, in the body's order
    rest: Annotated[FloatTable, "spring"]  # [m]
    shortening: Annotated[FloatTable, "spring"]  # [m], from rest to shortest
    lengthening: Annotated[FloatTable, "spring"]  # [m], from rest to longest
    # chambers
    edge_start: Annotated[IntTable, "chamber_end"]  # first edge of each chamber, and the end of the last
    edge_from: Annotated[IntTable, "edge"]
    edge_to: Annotated[IntTable, "edge"]
    edge_spring: Annotated[IntTable, "edge"]  # that joins its ends, or NOWHERE
    gas_energy: Annotated[FloatTable, "chamber"]  # nRT [J]
    area_floor: Annotated[FloatTable, "chamber"]  # [m^2]
    pressure_start: Annotated[FloatTable, "chamber"]  # [Pa]
    pressure_min: Annotated[FloatTable, "chamber"]  # [Pa]
    pressure_max: Annotated[FloatTable, "chamber"]  # [Pa]
    pressure_step: Annotated[FloatTable, "chamber"]  # [Pa] per unit of output
    pressure_scale: Annotated[FloatTable, "chamber"]  # 1 / p_max [1/Pa]
    # scene: segments, and columns ("cells") that list the segments which a mass with its centre there can meet
    x1: Annotated[FloatTable, "segment"]  # [m]
    y1: Annotated[FloatTable, "segment"]
    x2: Annotated[FloatTable, "segment"]
    y2: Annotated[FloatTable, "segment"]
    nx: Annotated[FloatTable, "segment"]  # outward normal
    ny: Annotated[FloatTable, "segment"]
    depth: Annotated[FloatTable, "segment"]  # [m]
    column: Annotated[FloatTable, "column_end"]  # [m], left ends, and the right end of the last
    floor: Annotated[FloatTable, "column"]  # [m]: a square between floor and ceiling touches nothing
    ceiling: Annotated[FloatTable, "column"]  # [m]
    listed: Annotated[IntTable, "column"]  # segments in the column
    candidate: Annotated[IntTable, "candidate"]  # [column, slot], ascending
    # pairs of masses that can collide
    pair_a: Annotated[IntTable, "pair"]
    pair_b: Annotated[IntTable, "pair"]
    pair_reach: Annotated[FloatTable, "pair"]  # [m], centres further apart in x or y cannot touch
    pair_cosine: Annotated[FloatTable, "pair"]  # of b's angle seen from a
    pair_sine: Annotated[FloatTable, "pair"]
    pair_share_a: Annotated[FloatTable, "pair"]  # of the pair's relative velocity that changes at a: m_b / (m_a + m_b)
    pair_share_b: Annotated[FloatTable, "pair"]


class State(NamedTuple):
    """What moves and lasts from step to step."""

    x: Annotated[Floats, "mass"]  # [m]
    y: Annotated[Floats, "mass"]
    vx: Annotated[Floats, "mass"]  # [m/s]
    vy: Annotated[Floats, "mass"]
    touch: Annotated[Floats, "mass"]  # 1 where the last solver had a contact
    rest: Annotated[Floats, "spring"]  # [m], commanded lengths, in the body's order
    impulse: Annotated[Floats, "spring"]  # [N s], in the order of solving
    pressure: Annotated[Floats, "chamber"]  # [Pa]
    window: Annotated[Floats, "window"]  # [window, input], the last observations
    total: Annotated[Floats, "input"]  # their sum
    # the column that each mass is in, copied to the lanes: [mass]
    left: Annotated[Floats, "mass"]  # [m]
    right: Annotated[Floats, "mass"]
    floor: Annotated[Floats, "mass"]
    ceiling: Annotated[Floats, "mass"]
    listed: Annotated[Ints, "mass"]  # segments in it
    used: Annotated[IntTable, "mass"]  # most segments in any lane's column
    # its segments: [mass, slot]
    segment: Annotated[Ints, "slot"]
    px: Annotated[Floats, "slot"]  # [m], first end
    py: Annotated[Floats, "slot"]
    qx: Annotated[Floats, "slot"]  # [m], second end
    qy: Annotated[Floats, "slot"]
    nx: Annotated[Floats, "slot"]
    ny: Annotated[Floats, "slot"]
    depth: Annotated[Floats, "slot"]
    # ... seen by this square, which does not turn: the face that looks most against the normal, the components of
    # that face's normal and tangent along the segment's normal, and the largest extent of the square along it
    facing: Annotated[Floats, "slot"]
    lean: Annotated[Floats, "slot"]
    tilt: Annotated[Floats, "slot"]
    extent: Annotated[Floats, "slot"]  # [m]
    # impulses of the last contact's two points, for the warm start, per unit of mass: [mass, slot]
    ground_live: Annotated[IntTable, "slot"]  # whether any lane has one
    ground_id0: Annotated[Floats, "slot"]
    ground_id1: Annotated[Floats, "slot"]
    ground_normal0: Annotated[Floats, "slot"]  # [m/s]
    ground_tangent0: Annotated[Floats, "slot"]
    ground_normal1: Annotated[Floats, "slot"]
    ground_tangent1: Annotated[Floats, "slot"]
    # pairs too far apart to touch are not looked at until the masses have come far enough
    travel: Annotated[FloatTable, "one"]  # [m], at most this far has any two masses' distance changed in all lanes
    wake: Annotated[FloatTable, "pair"]  # [m], the travel up to which a pair cannot touch
    # the same for each pair, per unit of effective mass
    pair_live: Annotated[IntTable, "pair"]
    pair_id0: Annotated[Floats, "pair"]
    pair_id1: Annotated[Floats, "pair"]
    pair_normal0: Annotated[Floats, "pair"]
    pair_tangent0: Annotated[Floats, "pair"]
    pair_normal1: Annotated[Floats, "pair"]
    pair_tangent1: Annotated[Floats, "pair"]


class Work(NamedTuple):
    """What lives for one step."""

    # springs, in the order of solving
    ux: Annotated[Floats, "spring"]  # unit vector from tail to head
    uy: Annotated[Floats, "spring"]
    link: Annotated[Floats, "spring"]  # how much of the impulse before it in the chain a spring takes on [1]
    bias: Annotated[Floats, "spring"]  # effective mass * bias velocity [N s]
    # commands: one per spring in (-1, 1), then one per chamber
    command: Annotated[Floats, "output"]
    mean: Annotated[Floats, "input"]  # of the window
    # displacement of this step [m]
    dx: Annotated[Floats, "mass"]
    dy: Annotated[Floats, "mass"]
    # contacts with the scene; there is room for every slot of every mass
    ground_mass: Annotated[IntTable, "slot"]
    ground_slot: Annotated[IntTable, "slot"]
    ground_nx: Annotated[Floats, "slot"]  # normal, towards the mass; 0 in lanes without the contact
    ground_ny: Annotated[Floats, "slot"]
    ground_gap0: Annotated[Floats, "slot"]  # [m], separation of a point at the start of the step
    ground_gap1: Annotated[Floats, "slot"]
    ground_normal: Annotated[Floats, "slot"]  # [m/s], impulses of the first point
    ground_tangent: Annotated[Floats, "slot"]
    # the impulses of one mass in one lane, on the way from column to column: [slot]
    carried_segment: Annotated[IntTable, "slot"]
    carried_id0: Annotated[FloatTable, "slot"]
    carried_id1: Annotated[FloatTable, "slot"]
    carried_normal0: Annotated[FloatTable, "slot"]
    carried_tangent0: Annotated[FloatTable, "slot"]
    carried_normal1: Annotated[FloatTable, "slot"]
    carried_tangent1: Annotated[FloatTable, "slot"]
    # contacts of two masses; there is room for every pair
    pair: Annotated[IntTable, "pair"]
    pair_nx: Annotated[Floats, "pair"]  # normal, from a to b
    pair_ny: Annotated[Floats, "pair"]
    pair_gap0: Annotated[Floats, "pair"]
    pair_gap1: Annotated[Floats, "pair"]
    pair_normal: Annotated[Floats, "pair"]  # [m/s]
    pair_tangent: Annotated[Floats, "pair"]


class Brain(NamedTuple):
    """The controllers of a block."""

    weight: Annotated[Floats, "weight"]  # [output, input]
    bias: Annotated[Floats, "output"]


class Script(NamedTuple):
    """Commands from outside: controller outputs (COMMANDS), or rest lengths and pressures (REPLAY)."""

    row: Annotated[Floats, "script"]  # [step, output] or [step, spring + chamber]


class Trace(NamedTuple):
    """A recording: after each step the x, y, vx, vy, touch of masses, rest lengths, pressures, observations."""

    row: Annotated[Floats, "trace"]  # [step, trace_row]


class Result(NamedTuple):
    """Where the agents of a block ended, and after how many steps."""

    x: Annotated[Floats, "mass"]  # [m]
    y: Annotated[Floats, "mass"]
    steps: Annotated[Floats, "one"]
    solved: Annotated[Floats, "one"]  # 1 where the end came before the last step


class Kernel(NamedTuple):
    """A task as the kernel sees it, in Python: settings, tables, and the layout of a block's memory."""

    settings: Settings
    tables: np.ndarray  # float32 [size]
    layouts: np.ndarray  # offsets of the fields of VIEWS and where each ends, [view, field]
    lengths: dict[str, int]

    def field(self, buffer: np.ndarray, view: type, name: str) -> np.ndarray:
        """A field of a `view` in one block's `buffer`, writable: [length, lane], or [length] for tables."""
        width = 1 if view is Model else WIDTH
        return field_of(buffer, view, self.layouts[VIEWS.index(view)], name, self.lengths, width)

    def size(self, view: type) -> int:
        """Numbers in one block's buffer for a `view`; State and Work, behind it, share one."""
        last = Work if view is State else view
        return int(self.layouts[VIEWS.index(last), len(fields(last))])


VIEWS = (Model, State, Work, Brain, Result, Script)


def make_kernel(task: Task) -> Kernel:
    """The `Kernel` of a task."""
    body, physics = task.body, task.physics
    tables: dict[str, np.ndarray] = {}
    tables |= _mass_tables(body)
    tables |= _spring_tables(body, physics.dt)
    tables |= _chamber_tables(task)
    tables |= _scene_tables(task.scene, _margin(body, physics.skin))
    tables |= _pair_tables(body, physics.skin)
    slots = tables.pop("slots").item()
    lengths = {
        "mass": body.mass_count,
        "spring": body.spring_count,
        "chain": len(tables["chain_start"]),
        "chamber": body.chamber_count,
        "chamber_end": body.chamber_count + 1,
        "edge": len(tables["edge_from"]),
        "segment": len(task.scene.segments),
        "column": len(tables["floor"]),
        "column_end": len(tables["floor"]) + 1,
        "candidate": len(tables["candidate"]),
        "pair": len(tables["pair_a"]),
        "slot": body.mass_count * slots,
        "input": observation_count(body),
        "output": output_count(body, task.condition),
        "one": 1,
        "script": 0,  # seen from the start of a buffer of its own
        "trace": 0,
        "window": observation_count(body) * task.sensing.window,
        "weight": observation_count(body) * output_count(body, task.condition),
    }
    layouts = _layouts(lengths)
    buffer = aligned(1, layouts[0, len(fields(Model))])[0]
    settings = Settings(
        lanes=np.int32(WIDTH),
        masses=np.int32(body.mass_count),
        springs=np.int32(body.spring_count),
        chambers=np.int32(body.chamber_count),
        inputs=np.int32(lengths["input"]),
        outputs=np.int32(lengths["output"]),
        chains=np.int32(lengths["chain"] - 1),
        pairs=np.int32(lengths["pair"]),
        columns=np.int32(lengths["column"]),
        slots=np.int32(slots),
        window=np.int32(task.sensing.window),
        unit_observation=np.int32(task.sensing.observation == "unit"),
        pressure_source=np.int32(_pressure_source(task)),
        commanded_length=np.int32(physics.pressure_length == "commanded"),
        leaves=np.int32(isinstance(task.end, Leave)),
        velocity_iterations=np.int32(physics.velocity_iterations),
        position_iterations=np.int32(physics.position_iterations),
        dt=np.float32(physics.dt),
        gravity=np.float32(physics.gravity),
        slop=np.float32(physics.slop),
        reach=np.float32(2 * physics.skin),
        baumgarte=np.float32(physics.baumgarte),
        max_correction=np.float32(physics.max_correction),
        max_travel=np.float32(physics.max_travel),
        ground_friction=np.float32(math.sqrt(body.friction * task.scene.friction)),
        pair_friction=np.float32(body.friction),
        position_scale=np.float32(1 / (task.sensing.position_scale * body.radius)) if body.radius else np.float32(0),
        velocity_scale=np.float32(1 / task.sensing.velocity_scale),
        half_width=np.float32(task.end.half_width if isinstance(task.end, Leave) else math.inf),
    )
    kernel = Kernel(settings, buffer, layouts, lengths)
    for name, values in tables.items():
        kernel.field(buffer, Model, name)[:] = values
    return kernel


def _layouts(lengths: dict[str, int]) -> np.ndarray:
    """Offsets of every view; Work stands behind State in the same buffer."""
    rows = [layout(view, lengths, 1 if view is Model else WIDTH) for view in VIEWS]
    rows[VIEWS.index(Work)] += rows[VIEWS.index(State)][-1]
    table = np.zeros((len(rows), max(len(row) for row in rows)), dtype=np.int64)
    for k, row in enumerate(rows):
        table[k, : len(row)] = row
    return table


def _pressure_source(task: Task) -> int:
    if task.pressure is not None:
        return GIVEN
    return CONTROLLED if task.condition == "pressure" else GAS_LAW


def _margin(body: Body, skin: float) -> float:
    """How far from a mass's centre it can meet a segment [m]."""
    return math.sqrt(2) * (float(body.side.max()) / 2 + 2 * skin) + MARGIN


def _mass_tables(body: Body) -> dict[str, np.ndarray]:
    cosine, sine = np.cos(body.angle), np.sin(body.angle)
    return {
        "half": body.side / 2,
        "cosine": cosine,
        "sine": sine,
        "extent": body.side / 2 * (np.abs(cosine) + np.abs(sine)),
        "inverse_mass": 1 / body.mass,
        "share": body.mass / body.mass.sum(),
    }


def _spring_tables(body: Body, dt: float) -> dict[str, np.ndarray]:
    """Box2D's soft distance constraint:  omega = 2 pi f, k = m omega^2, c = 2 m zeta omega,
    gamma = 1 / (h (c + h k)), bias velocity = C h k gamma, with m the pair's reduced mass."""
    order = np.arange(body.spring_count)[::-1]
    tail, head, chain_start = _chains(body.springs[order])
    inverse = (1 / body.mass)[tail] + (1 / body.mass)[head]
    omega = 2 * np.pi * body.frequency[order]
    k = omega**2 / inverse
    c = 2 * body.damping_ratio[order] * omega / inverse
    softness = 1 / (dt * (c + dt * k))
    effective = 1 / (inverse + softness)
    return {
        "tail": tail,
        "head": head,
        "spring": order,
        "chain_start": chain_start,
        "effective_mass": effective,
        "relaxation": effective * softness,
        "stiffness": effective * dt * k * softness,
        "rest": body.rest_length,
        "shortening": body.rest_length * (1 - body.shortest),
        "lengthening": body.rest_length * (body.longest - 1),
    }


def _chains(springs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The springs [spring, 2] directed (tail, head) so that as many as possible start where the one before
    ended, and the starts of such chains. The solver carries a chain's last velocity in registers."""
    tails, heads, starts = [], [], []
    for k, (a, b) in enumerate(springs.tolist()):
        if k and heads[-1] in (a, b):
            tail, head = (a, b) if heads[-1] == a else (b, a)
        else:
            starts.append(k)
            ahead = springs[k + 1].tolist() if k + 1 < len(springs) else []
            tail, head = (a, b) if b in ahead else (b, a)
        tails.append(tail)
        heads.append(head)
    return np.array(tails, dtype=np.int64), np.array(heads, dtype=np.int64), np.array([*starts, len(springs)])


def _chamber_tables(task: Task) -> dict[str, np.ndarray]:
    body, low_high = task.body, task.pressure_range
    between = {frozenset(pair): k for k, pair in enumerate(body.springs.tolist())}
    edges = [edge for loop in body.chambers for edge in zip(loop, loop[1:] + loop[:1], strict=True)]
    # a chamber without gas has no p_max to be seen relative to
    scale = np.divide(1, low_high[:, 1], out=np.zeros(len(low_high)), where=low_high[:, 1] > 0)
    return {
        "edge_start": np.cumsum([0, *(len(loop) for loop in body.chambers)]),
        "edge_from": np.array([a for a, _ in edges]),
        "edge_to": np.array([b for _, b in edges]),
        "edge_spring": np.array([between.get(frozenset(edge), NOWHERE) for edge in edges]),
        "gas_energy": task.gas_energy,
        "area_floor": task.area_floor,
        "pressure_start": task.pressure_start,
        "pressure_min": low_high[:, 0],
        "pressure_max": low_high[:, 1],
        "pressure_step": task.pressure_step,
        "pressure_scale": scale,
    }


def _scene_tables(scene: Scene, margin: float) -> dict[str, np.ndarray]:
    """Columns are cut wherever the list of segments within `margin` changes, so that each list is exact."""
    segments, normal = scene.segments, scene.normal
    low = np.minimum(segments[:, 0], segments[:, 2]) - margin
    high = np.maximum(segments[:, 0], segments[:, 2]) + margin
    cuts = np.unique(np.float32(np.concatenate([low, high])))
    column = np.concatenate([[-np.inf], cuts, [np.inf]])
    lists = [np.flatnonzero((low < b) & (high > a)) for a, b in pairwise(column)]
    slots = max([1, *(len(found) for found in lists)])
    candidate = np.full((len(lists), slots), NOWHERE)
    floor, ceiling = np.full(len(lists), -np.inf), np.full(len(lists), np.inf)
    for k, found in enumerate(lists):
        candidate[k, : len(found)] = found
        for s in found:
            bottom, top = _span(segments[s], column[k] - margin, column[k + 1] + margin)
            if normal[s, 1] <= 0:
                ceiling[k] = min(ceiling[k], bottom)
            if normal[s, 1] >= 0:
                floor[k] = max(floor[k], top)
    return {
        "x1": segments[:, 0],
        "y1": segments[:, 1],
        "x2": segments[:, 2],
        "y2": segments[:, 3],
        "nx": normal[:, 0],
        "ny": normal[:, 1],
        "depth": scene.depth,
        "column": column,
        "floor": floor,
        "ceiling": ceiling,
        "listed": np.array([len(found) for found in lists]),
        "candidate": candidate.ravel(),
        "slots": np.array(slots),
    }


def _span(segment: np.ndarray, left: float, right: float) -> tuple[float, float]:
    """Lowest and highest y of a segment between two x."""
    x1, y1, x2, y2 = segment
    if x1 == x2:
        return min(y1, y2), max(y1, y2)
    ends = [y1 + (y2 - y1) * (min(max(x, min(x1, x2)), max(x1, x2)) - x1) / (x2 - x1) for x in (left, right)]
    return min(ends), max(ends)


def _pair_tables(body: Body, skin: float) -> dict[str, np.ndarray]:
    joined = {frozenset(pair) for pair in body.springs.tolist()}
    n = body.mass_count
    pairs = [(a, b) for a in range(n) for b in range(a + 1, n) if frozenset((a, b)) not in joined]
    # in this order neighbours in the list rarely share a mass, and so need not wait for each other
    pairs.sort(key=lambda pair: (pair[1] - pair[0], pair[0]))
    a, b = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    turn = body.angle[b] - body.angle[a]
    extent = _mass_tables(body)["extent"]
    return {
        "pair_a": a,
        "pair_b": b,
        "pair_reach": extent[a] + extent[b] + math.sqrt(2) * 2 * skin + MARGIN,
        "pair_cosine": np.cos(turn),
        "pair_sine": np.sin(turn),
        "pair_share_a": body.mass[b] / (body.mass[a] + body.mass[b]),
        "pair_share_b": body.mass[a] / (body.mass[a] + body.mass[b]),
    }
