"""The whole step, and the kernel that runs it for blocks of agents."""

import numpy as np
from numba import types

from turgor.physics.actuate import actuate, agent_of, take_commands, take_lengths
from turgor.physics.build import THREAD, rare, stage
from turgor.physics.contacts import column_at, find_ground_contacts, find_pair_contacts, note_travel
from turgor.physics.control import control
from turgor.physics.engine import COUNTS, LASTING, PASSING
from turgor.physics.lanes import any_lane, select
from turgor.physics.manifold import NO_ID
from turgor.physics.model import (
    COMMANDS,
    CONTROLLER,
    ON_CPU,
    ON_GPU,
    UNKNOWN,
    VIEWS,
    Brain,
    Ground,
    Model,
    Result,
    Script,
    Settings,
    State,
    Trace,
    Work,
)
from turgor.physics.pressure import apply_forces, gas_law, signed_area
from turgor.physics.sense import grow_older, sense
from turgor.physics.solver import correct_positions, integrate, solve_velocities, warm_start_contacts
from turgor.physics.springs import prepare_springs
from turgor.physics.views import WidthType, agents_abreast, lane_count, lane_views, numbers, views


@stage
def step(settings, model, ground, state, work, brain, script, commands, drive, first, t, row):
    """Step t (from 0) of the block of agents `first` ... It starts from an observation and ends with the one that the
    next step needs."""
    if drive == CONTROLLER:
        control(settings, model, state, work, brain)
        actuate(settings, model, state, work)
    elif drive == COMMANDS:
        take_commands(settings, work, commands, first)
        actuate(settings, model, state, work)
    else:
        take_lengths(settings, state, script, row)

    gas_law(settings, model, state)
    apply_forces(settings, model, state)

    grounds = find_ground_contacts(settings, model, ground, state, work)
    pairs = find_pair_contacts(settings, model, state, work)
    warm_start_contacts(model, state, work, grounds, pairs)
    prepare_springs(settings, model, state, work)
    solve_velocities(settings, model, state, work, grounds, pairs)
    integrate(settings, state, work)
    correct_positions(settings, model, state, work, grounds, pairs)
    note_travel(settings, state, work, t)

    grow_older(settings, state)
    sense(settings, model, state, work, t + 1)


@rare
def begin(settings, model, ground, state, work, result, fresh, position, velocity, first, t):
    """Puts those of the agents `first` ... that are `fresh` [agent] at `position` [agent, mass, 2], at rest lengths and
    without a past, and makes their first observation, after t steps of the block. The others stay as they are."""
    agents = len(fresh)
    begun = False
    for lane in range(settings.lanes):
        agent = agent_of(first, lane, agents)
        if fresh[agent]:
            put_at_start(settings, model, ground, state, result, position, velocity, agent, lane)
            begun = True
    if begun:
        state.travel[0] = 0.0  # all pairs are looked at again
        for p in range(settings.pairs):
            state.wake[p] = 0.0
        sense(settings, model, state, work, t)


@rare
def put_at_start(settings, model, ground, state, result, position, velocity, agent, lane):
    """One agent into one lane."""
    for i in range(settings.masses):
        state.x[i, lane] = position[agent, i, 0]
        state.y[i, lane] = position[agent, i, 1]
        state.vx[i, lane] = velocity[agent, i, 0]
        state.vy[i, lane] = velocity[agent, i, 1]
        state.touch[i, lane] = 0.0
        # not in it yet, so that the first step enters it
        state.left[i, lane] = np.inf
        state.right[i, lane] = -np.inf
        state.cell[i, lane] = column_at(settings, ground, lane, position[agent, i, 0])
        state.listed[i, lane] = 0
    for j in range(settings.springs):
        state.rest[j, lane] = model.rest[j]
        state.impulse[j, lane] = 0.0
    for c in range(settings.chambers):
        state.pressure[c, lane] = model.pressure_start[c]
    for k in range(settings.window * settings.inputs):
        state.window[k, lane] = 0.0
    for k in range(settings.inputs):
        state.total[k, lane] = 0.0
    for k in range(settings.memory):
        state.memory[k, lane] = 0.0
    state.age[0, lane] = 1.0
    state.phase[0, lane] = 0.0
    for slot in range(settings.masses * settings.slots):
        state.segment[slot, lane] = UNKNOWN
    for p in range(settings.pairs):
        state.pair_id0[p, lane] = NO_ID
        state.pair_id1[p, lane] = NO_ID
    result.steps[0, lane] = 0.0
    result.solved[0, lane] = 0.0


@stage
def note_end(settings, model, state, result, t, last):
    """Notes the agents that have left by the end of step t, and at the last step all others; returns whether all
    are done. `steps` is 0 while an agent is under way."""
    if settings.leaves == 0 and not last:
        return False
    under_way = result.steps[0] == 0.0
    left = under_way
    for i in range(settings.masses):
        left = left & (abs(state.x[i]) - model.extent[i] > settings.half_width)
    ended = left
    if last:
        ended = under_way
    if any_lane(ended):
        for i in range(settings.masses):
            result.x[i] = select(ended, state.x[i], result.x[i])
            result.y[i] = select(ended, state.y[i], result.y[i])
        result.steps[0] = select(ended, t + 1.0, result.steps[0])
        result.solved[0] = select(left, 1.0, result.solved[0])
    return not any_lane(result.steps[0] == 0.0)


@stage
def record(settings, state, work, trace, row):
    """Writes one row of a recording."""
    n = settings.masses
    at = row * (5 * n + settings.springs + settings.chambers + settings.inputs)
    for i in range(n):
        trace.row[at + i] = state.x[i]
        trace.row[at + n + i] = state.y[i]
        trace.row[at + 2 * n + i] = state.vx[i]
        trace.row[at + 3 * n + i] = state.vy[i]
        trace.row[at + 4 * n + i] = state.touch[i]
    at += 5 * n
    for j in range(settings.springs):
        trace.row[at + j] = state.rest[j]
    at += settings.springs
    for c in range(settings.chambers):
        trace.row[at + c] = state.pressure[c]
    at += settings.chambers
    for k in range(settings.inputs):
        trace.row[at + k] = work.mean[k]


@rare
def hand_out(settings, model, state, work, result, observations, stands, first):
    """Writes what is seen of the agents `first` ... from outside: rows of `observations` [agent, input] and `stands`
    [agent, stand] (see `tables.Kernel.stand`)."""
    n = settings.masses
    for c in range(settings.chambers):
        work.area[c] = signed_area(model, state, c)
    for lane in range(min(settings.lanes, len(observations) - first)):
        agent = first + lane
        for k in range(settings.inputs):
            observations[agent, k] = work.mean[k, lane]
        for i in range(n):
            stands[agent, 2 * i] = state.x[i, lane]
            stands[agent, 2 * i + 1] = state.y[i, lane]
            stands[agent, 2 * n + 2 * i] = state.vx[i, lane]
            stands[agent, 2 * n + 2 * i + 1] = state.vy[i, lane]
            stands[agent, 4 * n + i] = state.touch[i, lane]
        for c in range(settings.chambers):
            stands[agent, 5 * n + c] = state.pressure[c, lane]
            stands[agent, 5 * n + settings.chambers + c] = work.area[c, lane]
        stands[agent, 5 * n + 2 * settings.chambers] = result.solved[0, lane]


@stage
def run_block(
    settings, model, ground, state, work, brain, result, script, trace, recording, fresh, position, velocity, commands,
    observations, stands, drive, first, first_step, steps, last_step,
):  # fmt: skip
    """Runs the block of agents `first` ...: see `run_blocks`."""
    row = 0
    if len(fresh) > 0:
        begin(settings, model, ground, state, work, result, fresh, position, velocity, first, first_step)
        if recording:
            record(settings, state, work, trace, row)
            row += 1
    for k in range(steps):
        t = first_step + k
        step(settings, model, ground, state, work, brain, script, commands, drive, first, t, k)
        if recording:
            record(settings, state, work, trace, row)
            row += 1
        if note_end(settings, model, state, result, t, t == last_step):
            break
    if len(observations) > 0:
        hand_out(settings, model, state, work, result, observations, stands, first)


@rare
def run_blocks(
    width, constants, layouts, tables, grounds, memory, brains, results, position, velocity, scripts, traces, fresh,
    commands, observations, stands, drive, first_step, steps, last_step,
):  # fmt: skip
    """Runs every block of `memory` [block, size] for `steps` steps from `first_step`, after the agents that are `fresh`
    [agent] have been put at `position`, `velocity` [agent, mass, 2].

    The other buffers go with it block by block (scripts, traces and a ground for all lanes: one for all), seen through
    `layouts` [view, field]. `commands` [agent, output] are those of the drive COMMANDS. Writes `results`, and `traces`,
    `observations`, `stands` if there is room for them.
    """
    settings = numbers(Settings, constants)
    model = views(Model, tables, layouts[0], width)
    script = views(Script, scripts[0], layouts[6], width)
    trace = views(Trace, traces[0], layouts[6], width)
    for block in range(len(memory)):
        ground = views(Ground, grounds[block if settings.own_ground != 0 else 0], layouts[1], width)
        state = views(State, memory[block], layouts[2], width)
        work = views(Work, memory[block], layouts[3], width)
        brain = views(Brain, brains[block], layouts[4], width)
        result = views(Result, results[block], layouts[5], width)
        run_block(
            settings, model, ground, state, work, brain, result, script, trace, traces.shape[1] > 0, fresh, position,
            velocity, commands, observations, stands, drive, block * lane_count(width), first_step, steps, last_step,
        )  # fmt: skip


@rare
def run_agent(
    width, constants, layouts, tables, grounds, memory, brains, results, position, velocity, scripts, traces, fresh,
    commands, observations, stands, drive, first_step, steps, last_step, agent,
):  # fmt: skip
    """The same for one `agent` alone, with a `width` of one lane: what a thread of a GPU does, if there is such an
    agent."""
    if agent >= len(position):
        return
    block = agent // agents_abreast(width)
    lane = agent % agents_abreast(width)
    settings = numbers(Settings, constants)
    model = views(Model, tables, layouts[0], width)
    ground = views(Ground, grounds[0], layouts[1], width)
    state = lane_views(State, memory[block], layouts[2], width, lane)
    work = lane_views(Work, memory[block], layouts[3], width, lane)
    brain = lane_views(Brain, brains[block], layouts[4], width, lane)
    result = lane_views(Result, results[block], layouts[5], width, lane)
    script = lane_views(Script, scripts[0], layouts[6], width, lane)
    trace = lane_views(Trace, traces[0], layouts[6], width, lane)
    run_block(
        settings, model, ground, state, work, brain, result, script, trace, traces.shape[1] > 0, fresh, position,
        velocity, commands, observations, stands, drive, agent, first_step, steps, last_step,
    )  # fmt: skip


COUNTED = (*PASSING.values(), *(types.int64 for _ in COUNTS))
ARGUMENTS = (WidthType(*ON_CPU), *LASTING.values(), *COUNTED)
# a GPU's threads read settings and offsets again and again: there these arrays lie among the arguments themselves
NEAR = {
    "constants": (np.float32, (len(Settings._fields),)),
    "layouts": (np.int64, (len(VIEWS), 1 + max(len(view._fields) for view in VIEWS))),
}
THREAD_ARGUMENTS = (WidthType(*ON_GPU), *(LASTING | NEAR).values(), *COUNTED, THREAD)
