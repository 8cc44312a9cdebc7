"""Control and actuation: commands from the controller, rest lengths and pressures from commands."""

from turgor.physics.lanes import inlined, select, stage
from turgor.physics.memory import fill
from turgor.physics.model import CONTROLLED
from turgor.physics.sense import clamp


@inlined
def tanh(x):
    """tanh x within 3e-7 as x P(x^2) / Q(x^2), own minimax fit on |x| <= 8: the same bits on every processor."""
    x = clamp(x, -8.0, 8.0)
    q = x * x
    p = (((1.523027253483476e-08 * q + 2.189456319918891e-05) * q + 3.5715922168691695e-03) * q
         + 1.344449314300786e-01) * q + 0.9999999935761286  # fmt: skip
    d = (((8.522389122752359e-07 * q + 3.4112823940001094e-04) * q + 2.6164421009586915e-02) * q
         + 4.677782046366341e-01) * q + 1.0  # fmt: skip
    return x * p / d


@stage
def control(settings, brain, work):
    """command = tanh(W_s o + b_s) for springs, W_p o + b_p for chambers.

    Two outputs at a time share the loads of o, one of each half, so that the weights are read as two unbroken streams;
    two sums each hide the latency of the additions. Their order is fixed.
    """
    inputs = settings.inputs
    even = inputs - inputs % 2
    half = (settings.outputs + 1) // 2
    for j in range(half):
        last = min(j + half, settings.outputs - 1)  # an odd number of outputs: the last one twice
        at = j * inputs
        twin = last * inputs
        a = brain.bias[j]
        b = brain.bias[last]
        a_odd = fill(work.mean, 0.0)
        b_odd = a_odd
        for k in range(0, even, 2):
            o = work.mean[k]
            a += brain.weight[at + k] * o
            b += brain.weight[twin + k] * o
            o = work.mean[k + 1]
            a_odd += brain.weight[at + k + 1] * o
            b_odd += brain.weight[twin + k + 1] * o
        if even < inputs:
            a += brain.weight[at + even] * work.mean[even]
            b += brain.weight[twin + even] * work.mean[even]
        work.command[j] = activation(settings, j, a + a_odd)
        work.command[last] = activation(settings, last, b + b_odd)


@inlined
def activation(settings, j, output):
    """What row j of the controller gives out."""
    if j < settings.springs:
        output = tanh(output)
    return output


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
