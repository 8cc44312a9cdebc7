"""The arrays of the kernel: what is fixed (Settings, Model) and what moves (State, Work).

A block is `width` agents side by side, one per lane. Its State and Work are rows of lanes in one buffer.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from turgor.physics.memory import Floats, FloatTable, Ints, IntTable

WIDTH = 16  # agents in a block: one AVX-512 vector; see ARCHITECTURE.md


class Block(NamedTuple):
    """How the agents of a block lie: so many `lanes` are one value, so many agents are `abreast` in memory."""

    lanes: int
    abreast: int


ON_CPU = Block(WIDTH, WIDTH)
ON_GPU = Block(1, 32)  # an agent a thread; what the 32 threads of a warp read is one cache line
NOWHERE = -1
UNKNOWN = -2  # a slot that has not been filled yet
LOOK_AGAIN = 64  # [step], after which all pairs are looked at, so that `travel` gathers no rounding errors
# [m], slack of the search for candidates over the exact tests, against rounding. A candidate search that misses a
# contact shows as an agent that depends on its neighbours: shapes are apart when they are `2 skin` apart along the
# normal of any face, so that corners can be sqrt(2) times as far away.
MARGIN = 1e-3

# where commands come from
CONTROLLER, COMMANDS, REPLAY = 0, 1, 2
# which controller
LINEAR, MLP, SINUSOID, DISTRIBUTED = 0, 1, 2, 3
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
    controller: np.int32
    hidden: np.int32  # units of a hidden layer
    messages: np.int32  # each way along a spring
    memory: np.int32  # numbers that the controller keeps
    chains: np.int32
    pairs: np.int32
    columns: np.int32  # room for them in a scene
    slots: np.int32  # room for segments in a column
    own_ground: np.int32  # whether each lane has a scene of its own
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
    first: Annotated[IntTable, "spring"]  # masses that it joins
    second: Annotated[IntTable, "spring"]
    strain_scale: Annotated[FloatTable, "spring"]  # [1/m]
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
    # pairs of masses that can collide
    pair_a: Annotated[IntTable, "pair"]
    pair_b: Annotated[IntTable, "pair"]
    pair_reach: Annotated[FloatTable, "pair"]  # [m], centres further apart in x or y cannot touch
    pair_cosine: Annotated[FloatTable, "pair"]  # of b's angle seen from a
    pair_sine: Annotated[FloatTable, "pair"]
    pair_share_a: Annotated[FloatTable, "pair"]  # of the pair's relative velocity that changes at a: m_b / (m_a + m_b)
    pair_share_b: Annotated[FloatTable, "pair"]


class Ground(NamedTuple):
    """Scenes: segments, and columns ("cells") that list the segments which a mass with its centre there can meet.

    One scene for all lanes, or one for each, side by side with room for `segments` and `columns` each.
    """

    x1: Annotated[FloatTable, "segment"]  # [m]
    y1: Annotated[FloatTable, "segment"]
    x2: Annotated[FloatTable, "segment"]
    y2: Annotated[FloatTable, "segment"]
    nx: Annotated[FloatTable, "segment"]  # outward normal
    ny: Annotated[FloatTable, "segment"]
    depth: Annotated[FloatTable, "segment"]  # [m]
    left: Annotated[FloatTable, "column"]  # [m], ends
    right: Annotated[FloatTable, "column"]
    floor: Annotated[FloatTable, "column"]  # [m]: a square between floor and ceiling touches nothing
    ceiling: Annotated[FloatTable, "column"]  # [m]
    listed: Annotated[IntTable, "column"]  # segments in the column
    candidate: Annotated[IntTable, "candidate"]  # [column, slot], ascending


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
    age: Annotated[Floats, "one"]  # observations since the agent's start
    phase: Annotated[Floats, "one"]  # the last one's place among `window`, counted from the agent's start
    memory: Annotated[Floats, "memory"]  # of the controller: see control.memory_count
    # the column that each mass is in, copied to the lanes: [mass]
    cell: Annotated[Ints, "mass"]  # its index
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
    area: Annotated[Floats, "chamber"]  # [m^2], signed
    # controllers: cosine and sine of the clock, or [mass, local input]; [mass, hidden]; [mass, local output]
    local: Annotated[Floats, "local"]
    hidden: Annotated[Floats, "hidden"]
    answer: Annotated[Floats, "answer"]
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

    weight: Annotated[Floats, "weight"]  # of all layers, [output, input] each: see control.pack
    bias: Annotated[Floats, "bias"]


class Script(NamedTuple):
    """Rest lengths and pressures from outside (REPLAY)."""

    row: Annotated[Floats, "script"]  # [step, spring + chamber]


class Trace(NamedTuple):
    """A recording: after each step the x, y, vx, vy, touch of masses, rest lengths, pressures, observations."""

    row: Annotated[Floats, "trace"]  # [step, trace_row]


class Result(NamedTuple):
    """Where the agents of a block ended, and after how many steps."""

    x: Annotated[Floats, "mass"]  # [m]
    y: Annotated[Floats, "mass"]
    steps: Annotated[Floats, "one"]
    solved: Annotated[Floats, "one"]  # 1 where the end came before the last step


VIEWS = (Model, Ground, State, Work, Brain, Result, Script)
SHARED = (Model, Ground)  # tables without lanes
