"""The whole step, and the kernel that runs it for blocks of agents."""

from functools import partial

from numba import njit

from turgor.physics.actuate import actuate, take_commands, take_lengths
from turgor.physics.contacts import find_ground_contacts, find_pair_contacts, note_travel
from turgor.physics.control import control
from turgor.physics.lanes import any_lane, rare, select, stage
from turgor.physics.memory import lane_count, views
from turgor.physics.model import (
    COMMANDS,
    CONTROLLER,
    UNKNOWN,
    Brain,
    Model,
    Result,
    Script,
    State,
    Trace,
    Work,
)
from turgor.physics.pressure import apply_forces, gas_law
from turgor.physics.sense import sense
from turgor.physics.solver import correct_positions, integrate, solve_velocities, warm_start_contacts
from turgor.physics.springs import prepare_springs


@stage
def step(settings, model, state, work, brain, script, drive, t, row):
    """Step t (from 0) of a block. It starts from an observation and ends with the one that the next step needs."""
    if drive == CONTROLLER:
        control(settings, model, state, work, brain)
        actuate(settings, model, state, work)
    elif drive == COMMANDS:
        take_commands(settings, work, script, row)
        actuate(settings, model, state, work)
    else:
        take_lengths(settings, state, script, row)

    gas_law(settings, model, state)
    apply_forces(settings, model, state)

    grounds = find_ground_contacts(settings, model, state, work)
    pairs = find_pair_contacts(settings, model, state, work)
    warm_start_contacts(model, state, work, grounds, pairs)
    prepare_springs(settings, model, state, work)
    solve_velocities(settings, model, state, work, grounds, pairs)
    integrate(settings, state, work)
    correct_positions(settings, model, state, work, grounds, pairs)
    note_travel(settings, state, work, t)

    sense(settings, model, state, work, t + 1)


@rare
def begin(settings, model, state, work, result, position, velocity, first, width, t):
    """Puts agents `first` ... of `position` [agent, mass, 2] into the lanes, at rest lengths and without a past, and
    makes their first observation, at t = 0."""
    for i in range(settings.masses):
        for lane in range(lane_count(width)):
            state.x[i, lane] = position[first + lane, i, 0]
            state.y[i, lane] = position[first + lane, i, 1]
            state.vx[i, lane] = velocity[first + lane, i, 0]
            state.vy[i, lane] = velocity[first + lane, i, 1]
            state.listed[i, lane] = 0
            state.cell[i, lane] = 0
        state.touch[i] = 0.0
        # outside any column, so that the first step looks its column up
        state.left[i] = 1e30
        state.right[i] = -1e30
        state.used[i] = 0
    for j in range(settings.springs):
        state.rest[j] = model.rest[j]
        state.impulse[j] = 0.0
    for c in range(settings.chambers):
        state.pressure[c] = model.pressure_start[c]
    for k in range(settings.window * settings.inputs):
        state.window[k] = 0.0
    for k in range(settings.inputs):
        state.total[k] = 0.0
    for k in range(settings.memory):
        state.memory[k] = 0.0
    for slot in range(settings.masses * settings.slots):
        state.ground_live[slot] = 0
        for lane in range(lane_count(width)):
            state.segment[slot, lane] = UNKNOWN
    for p in range(settings.pairs):
        state.pair_live[p] = 0
        state.wake[p] = 0.0
    state.travel[0] = 0.0
    result.steps[0] = 0.0
    result.solved[0] = 0.0
    sense(settings, model, state, work, t)


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


def _run_blocks(
    width, settings, tables, memory, brains, scripts, traces, results, layouts, position, velocity,
    drive, first_step, steps, last_step,
):  # fmt: skip
    """Runs every block of `memory` [block, size] for `steps` steps from `first_step`; 0 begins anew.

    The other arrays go with it block by block (scripts and traces: one for all), seen through `layouts` [view, field].
    `position`, `velocity` [agent, mass, 2] are the start. Writes `results`, and `traces` if there is room for them.
    """
    model = views(Model, tables, layouts[0], width)
    recording = traces.shape[1] > 0
    for block in range(len(memory)):
        state = views(State, memory[block], layouts[1], width)
        work = views(Work, memory[block], layouts[2], width)
        brain = views(Brain, brains[block], layouts[3], width)
        result = views(Result, results[block], layouts[4], width)
        script = views(Script, scripts[0], layouts[5], width)
        trace = views(Trace, traces[0], layouts[5], width)
        if first_step == 0:
            begin(
                settings, model, state, work, result, position, velocity, block * lane_count(width), width, first_step
            )
            if recording:
                record(settings, state, work, trace, first_step)
        for k in range(steps):
            t = first_step + k
            step(settings, model, state, work, brain, script, drive, t, k)
            if recording:
                record(settings, state, work, trace, k + 1)
            if note_end(settings, model, state, result, t, t == last_step):
                break


# The cache knows `width`, and through it the sources of all that is called here: see memory.Width. Where no folder can
# be written to, there is no cache.
_compile = partial(njit, nogil=True, error_model="numpy", boundscheck=False)
try:
    run_blocks = _compile(cache=True)(_run_blocks)
except RuntimeError:
    run_blocks = _compile()(_run_blocks)
