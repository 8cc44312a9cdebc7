"""Actuation: rest lengths and pressures from commands."""

from turgor.physics.build import inlined, stage
from turgor.physics.lanes import select
from turgor.physics.model import CONTROLLED
from turgor.physics.sense import clamp
from turgor.physics.views import fill


@stage
def actuate(settings, model, state, work):
    """rest = L0 - s (L0 - l_min) for s > 0, L0 - s (l_max - L0) for s < 0;  p = clip(p + p_unit dp)."""
    if settings.outputs > 0:
        for j in range(settings.springs):
            s = work.command[j]
            state.rest[j] = model.rest[j] - s * select(
                s > 0.0, fill(state.rest, model.shortening[j]), model.lengthening[j]
            )
    if settings.pressure_source == CONTROLLED:
        for c in range(settings.chambers):
            change = model.pressure_step[c] * work.command[settings.springs + c]
            state.pressure[c] = clamp(state.pressure[c] + change, model.pressure_min[c], model.pressure_max[c])


@stage
def take_commands(settings, work, commands, first):
    """Commands [agent, output] from outside instead of the controller's, of agents `first` ...; springs within
    [-1, 1]."""
    for lane in range(settings.lanes):
        agent = agent_of(first, lane, len(commands))
        for j in range(settings.outputs):
            work.command[j, lane] = commands[agent, j]
    for j in range(min(settings.springs, settings.outputs)):
        work.command[j] = clamp(work.command[j], -1.0, 1.0)


@inlined
def agent_of(first, lane, agents):
    """The agent in a lane; the last one also in the lanes that are left over."""
    return min(first + lane, agents - 1)


@stage
def take_lengths(settings, state, script, row):
    """Rest lengths and pressures from outside."""
    at = row * (settings.springs + settings.chambers)
    for j in range(settings.springs):
        state.rest[j] = script.row[at + j]
    for c in range(settings.chambers):
        state.pressure[c] = script.row[at + settings.springs + c]
