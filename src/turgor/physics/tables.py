"""A task as the kernel sees it: settings, tables, and the layout of its memory."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from turgor.body import Body
from turgor.control import (
    MLP,
    Distributed,
    Linear,
    Sinusoid,
    local_input_count,
    local_output_count,
    memory_count,
    observation_count,
    output_count,
    pack,
)
from turgor.errors import InvalidInput
from turgor.physics import model
from turgor.physics.ground import Columns, Room
from turgor.physics.memory import BYTES, aligned, check_memory, field_of, fields, layout
from turgor.physics.model import (
    CONTROLLED,
    DISTRIBUTED,
    GAS_LAW,
    GIVEN,
    LINEAR,
    MARGIN,
    NOWHERE,
    ON_CPU,
    SHARED,
    SINUSOID,
    VIEWS,
    WIDTH,
    Block,
    Brain,
    Ground,
    Model,
    Result,
    Settings,
    State,
    Work,
)
from turgor.task import Leave, Task

LARGEST = float(np.finfo(np.float32).max)
LEAST_PRESSURE = 1e-30  # [Pa]
KINDS: dict[type, int] = {Linear: LINEAR, MLP: model.MLP, Sinusoid: SINUSOID, Distributed: DISTRIBUTED}


class Kernel(NamedTuple):
    """A task as the kernel sees it, in Python: settings, tables, and the layout of a block's memory."""

    settings: Settings
    constants: np.ndarray  # the settings as the kernel reads them, float32 and int32 in one array [setting]
    tables: np.ndarray  # float32 [size]
    layouts: np.ndarray  # offsets of the fields of VIEWS and where each ends, [view, field]
    lengths: dict[str, int]
    block: Block

    def field(self, buffer: np.ndarray, view: type, name: str) -> np.ndarray:
        """A field of a `view` in one block's `buffer`, writable: [length, lane], or [length] for tables."""
        width = 1 if view in SHARED else self.block.abreast
        return field_of(buffer, view, self.layouts[VIEWS.index(view)], name, self.lengths, width)

    def size(self, view: type) -> int:
        """Numbers in one block's buffer for a `view`; State and Work, behind it, share one."""
        last = Work if view is State else view
        return int(self.layouts[VIEWS.index(last), len(fields(last))])

    def rows_for(self, agents: int) -> tuple[np.ndarray, np.ndarray]:
        """Room for what `hand_out` writes: observations [agent, input] and stands [agent, stand], not filled."""
        width = 5 * self.lengths["mass"] + 2 * self.lengths["chamber"] + 1
        return np.empty((agents, self.lengths["input"]), np.float32), np.empty((agents, width), np.float32)

    @property
    def block_bytes(self) -> int:
        """Memory of a block of agents [byte]."""
        return BYTES * sum(self.size(view) for view in (State, Brain, Result))

    @property
    def stand(self) -> dict[str, tuple[slice, tuple[int, ...]]]:
        """{name: (columns, shape)} of what `hand_out` writes in an agent's row."""
        masses, chambers = self.lengths["mass"], self.lengths["chamber"]
        shapes: dict[str, tuple[int, ...]] = {
            "position": (masses, 2),
            "velocity": (masses, 2),
            "touch": (masses,),
            "pressure": (chambers,),
            "area": (chambers,),
            "solved": (),
        }
        ends = np.cumsum([math.prod(shape) for shape in shapes.values()]).tolist()
        return {
            name: (slice(end - math.prod(shape), end), shape)
            for (name, shape), end in zip(shapes.items(), ends, strict=True)
        }


def make_kernel(task: Task, room: Room, own_ground: bool = False, block: Block = ON_CPU) -> Kernel:
    """The `Kernel` of a task for agents that lie as in a `block`, with `room` for a scene that all agents share, or for
    one of each agent's own."""
    body, physics = task.body, task.physics
    tables: dict[str, np.ndarray] = {}
    tables |= _mass_tables(body)
    tables |= _spring_tables(body, physics.dt)
    tables |= _chamber_tables(task)
    tables |= _pair_tables(body, physics.skin)
    scenes = WIDTH if own_ground else 1
    lengths = {
        "mass": body.mass_count,
        "spring": body.spring_count,
        "chain": len(tables["chain_start"]),
        "chamber": body.chamber_count,
        "chamber_end": body.chamber_count + 1,
        "edge": len(tables["edge_from"]),
        "segment": room.segments * scenes,
        "column": room.columns * scenes,
        "candidate": room.columns * room.slots * scenes,
        "pair": len(tables["pair_a"]),
        "slot": body.mass_count * room.slots,
        "input": observation_count(body),
        "output": output_count(body, task.condition),
        "one": 1,
        "script": 0,  # seen from the start of a buffer of its own
        "trace": 0,
        "window": observation_count(body) * task.sensing.window,
    }
    lengths |= _controller_lengths(task)
    layouts = _layouts(lengths, block)
    for k, view in enumerate(VIEWS):
        expected = "task: expected fewer masses, springs, segments, hidden units, messages or a shorter window"
        check_memory(f"{expected} ({block.abreast} agents' {view.__name__.lower()})", BYTES * int(layouts[k].max()))
    buffer = aligned(1, layouts[0, len(fields(Model))])[0]
    settings = Settings(
        lanes=np.int32(block.lanes),
        masses=np.int32(body.mass_count),
        springs=np.int32(body.spring_count),
        chambers=np.int32(body.chamber_count),
        inputs=np.int32(lengths["input"]),
        outputs=np.int32(lengths["output"]),
        controller=np.int32(KINDS[type(task.controller)] if lengths["output"] else LINEAR),
        hidden=np.int32(getattr(task.controller, "hidden", 0)),
        messages=np.int32(getattr(task.controller, "messages", 0)),
        memory=np.int32(lengths["memory"]),
        chains=np.int32(lengths["chain"] - 1),
        pairs=np.int32(lengths["pair"]),
        columns=np.int32(room.columns),
        slots=np.int32(room.slots),
        own_ground=np.int32(own_ground),
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
    kernel = Kernel(settings, _constants(settings), buffer, layouts, lengths, block)
    for name, values in tables.items():
        if (np.isfinite(values) & (np.abs(values) > LARGEST)).any():
            raise InvalidInput(f"{name}: expected numbers within {LARGEST:.0e}", f"{np.abs(values).max():.3g}")
        kernel.field(buffer, Model, name)[:] = values
    return kernel


def ground_tables(kernel: Kernel, buffer: np.ndarray) -> dict[str, np.ndarray]:
    """The tables of a block's ground `buffer`, writable: {field: [scene, length]}."""
    scenes = WIDTH if kernel.settings.own_ground else 1
    tables = {name: kernel.field(buffer, Ground, name).reshape(scenes, -1) for name in fields(Ground)}
    return tables | {"candidate": tables["candidate"].reshape(scenes, -1, kernel.settings.slots)}


def write_ground(tables: dict[str, np.ndarray], scene: Columns, place: int = 0) -> None:
    """Writes a scene into `ground_tables`; `place` is the lane, where each has one of its own."""
    for name, values in scene._asdict().items():
        table = tables[name][place]
        table[len(values) :] = _BEYOND.get(name, 0)
        if name == "candidate":
            table[:] = NOWHERE
            # the lanes' segments stand side by side
            values = np.where(values == NOWHERE, NOWHERE, values + place * tables["x1"].shape[1])
            table[: len(values), : values.shape[1]] = values
        else:
            table[: len(values)] = values


# Columns that a scene leaves over are entered by nothing but a mass that has flown to infinity.
_BEYOND = {"left": math.inf, "right": math.inf, "floor": -math.inf, "ceiling": math.inf}


def _layouts(lengths: dict[str, int], block: Block) -> np.ndarray:
    """Offsets of every view; Work stands behind State in the same buffer."""
    shape = (block.abreast, block.abreast // block.lanes)
    rows = [layout(view, lengths, *((1, 1) if view in SHARED else shape)) for view in VIEWS]
    rows[VIEWS.index(Work)] += rows[VIEWS.index(State)][-1]
    table = np.zeros((len(rows), max(len(row) for row in rows)), dtype=np.int64)
    for k, row in enumerate(rows):
        table[k, : len(row)] = row
    return table


def _constants(settings: Settings) -> np.ndarray:
    """The settings, one behind the other."""
    return np.frombuffer(b"".join(number.tobytes() for number in settings), dtype=np.float32)


def _pressure_source(task: Task) -> int:
    if task.pressure is not None:
        return GIVEN
    return CONTROLLED if task.condition == "pressure" else GAS_LAW


def _controller_lengths(task: Task) -> dict[str, int]:
    """Rows of the controller: its weights and biases, what it keeps, and room for what it works on."""
    body, condition, controller = task.body, task.condition, task.controller
    weights, biases = pack(np.zeros((1, task.parameter_count)), body, condition, controller, task.physics.dt)
    masses = body.mass_count if isinstance(controller, Distributed) else 1
    local = isinstance(controller, Distributed)
    return {
        "weight": weights.shape[1],
        "bias": biases.shape[1],
        "memory": memory_count(body, condition, controller),
        "local": masses * local_input_count(controller) if local else 2,
        "hidden": masses * getattr(controller, "hidden", 0),
        "answer": masses * local_output_count(controller, condition) if local else 0,
    }


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
    span = body.rest_length * np.maximum(1 - body.shortest, body.longest - 1)
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
        "first": body.springs[:, 0],
        "second": body.springs[:, 1],
        "strain_scale": np.divide(1, span, out=np.zeros(len(span)), where=span > 0),
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
    # a chamber without gas, or nearly so, has no p_max to be seen relative to
    scale = np.divide(1, low_high[:, 1], out=np.zeros(len(low_high)), where=low_high[:, 1] > LEAST_PRESSURE)
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
