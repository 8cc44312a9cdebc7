"""Control: commands from what an agent observes. A controller is dense layers, and what stands between them."""

import math

from numba import intp

from turgor.physics.build import inlined, shared, stage
from turgor.physics.lanes import select
from turgor.physics.model import DISTRIBUTED, LINEAR, MLP, SINUSOID
from turgor.physics.sense import clamp, signed
from turgor.physics.views import fill


@stage
def control(settings, model, state, work, brain):
    """command = (-1, 1) for springs, what `Task.pressure_step` is multiplied with for chambers."""
    if settings.controller == LINEAR:
        linear(settings, work, brain)
    elif settings.controller == MLP:
        mlp(settings, work, brain)
    elif settings.controller == SINUSOID:
        sinusoid(settings, state, work, brain)
    elif settings.controller == DISTRIBUTED:
        distributed(settings, model, state, work, brain)


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


@shared
def dense(brain, at, first, source, inputs, target, outputs, squashed, count):
    """target = W source + b for `count` rows of inputs and outputs, W from weight `at` and b from bias `first` on; the
    first `squashed` outputs of each row go through tanh.

    Two outputs at a time share the loads of the inputs, one of each half, so that the weights are read as two unbroken
    streams; two sums each hide the latency of the additions. Their order is fixed.
    """
    even = inputs - inputs % 2
    half = (outputs + 1) // 2
    for row in range(count):
        here = row * inputs
        there = row * outputs
        for j in range(half):
            last = min(j + half, outputs - 1)  # an odd number of outputs: the last one twice
            one = at + j * inputs
            twin = at + last * inputs
            a = brain.bias[first + j]
            b = brain.bias[first + last]
            a_odd = fill(source, 0.0)
            b_odd = a_odd
            for k in range(0, even, 2):
                o = source[here + k]
                a += brain.weight[one + k] * o
                b += brain.weight[twin + k] * o
                o = source[here + k + 1]
                a_odd += brain.weight[one + k + 1] * o
                b_odd += brain.weight[twin + k + 1] * o
            if even < inputs:
                a += brain.weight[one + even] * source[here + even]
                b += brain.weight[twin + even] * source[here + even]
            a += a_odd
            b += b_odd
            if j < squashed:
                a = tanh(a)
            if last < squashed:
                b = tanh(b)
            target[there + j] = a
            target[there + last] = b


@stage
def linear(settings, work, brain):
    """s = tanh(W_s o + b_s),  dp = W_p o + b_p."""
    inputs, outputs, springs = intp(settings.inputs), intp(settings.outputs), intp(settings.springs)
    dense(brain, intp(0), intp(0), work.mean, inputs, work.command, outputs, springs, intp(1))


@stage
def mlp(settings, work, brain):
    """h = tanh(W_1 o + b_1);  s = tanh(W_s h + b_s),  dp = W_p h + b_p."""
    inputs, hidden = intp(settings.inputs), intp(settings.hidden)
    outputs, springs = intp(settings.outputs), intp(settings.springs)
    dense(brain, intp(0), intp(0), work.mean, inputs, work.hidden, hidden, hidden, intp(1))
    dense(brain, hidden * inputs, hidden, work.hidden, hidden, work.command, outputs, springs, intp(1))


# --- sinusoid -----------------------------------------------------------------------------------------------------


@stage
def sinusoid(settings, state, work, brain):
    """s = tanh(a cos 2 pi p + b sin 2 pi p + c),  dp without tanh;  p is the phase, a part of a turn in [0, 1)."""
    phase = state.memory[0]
    # exact in float32, as all of these are whole parts 2^-23 of a turn below 1 (control.CLOCK)
    work.local[0] = sine(abs(phase - 0.5) - 0.25)
    work.local[1] = sine(max(0.25 - abs(phase - 0.25), phase - 1.0))
    outputs, springs = intp(settings.outputs), intp(settings.springs)
    dense(brain, intp(1), intp(0), work.local, intp(2), work.command, outputs, springs, intp(1))
    phase += brain.weight[0]
    state.memory[0] = select(phase < 1.0, phase, phase - 1.0)


@inlined
def sine(x):
    """sin 2 pi x within 3e-7, own minimax fit on |x| <= 1/4: the same bits on every processor."""
    q = x * x
    return x * ((((39.536705478603835 * q - 76.54978222031514) * q + 81.60100407026101) * q
                 - 41.341655031371744) * q + 6.283185160089304)  # fmt: skip


# --- distributed --------------------------------------------------------------------------------------------------


@stage
def distributed(settings, model, state, work, brain):
    """h_i = tanh(W_1 o_i + b_1),  W_2 h_i + b_2  of every mass i, and what becomes of it."""
    inputs, said = 5 + 2 * intp(settings.messages), 1 + 2 * intp(settings.messages)
    outputs = said + intp(settings.outputs > settings.springs)
    hidden, masses = intp(settings.hidden), intp(settings.masses)
    look(settings, model, state, work, inputs)
    dense(brain, intp(0), intp(0), work.local, inputs, work.hidden, hidden, hidden, masses)
    dense(brain, hidden * inputs, hidden, work.hidden, hidden, work.answer, outputs, said, masses)
    speak(settings, model, state, work, outputs)


@stage
def look(settings, model, state, work, inputs):
    """o_i = (touch, x, y, strain of the spring before, of the one after, messages from before, from after)."""
    n = settings.masses
    messages = settings.messages
    for i in range(n):
        work.local[i * inputs] = work.mean[i]
        work.local[i * inputs + 1] = work.mean[n + 2 * i]
        work.local[i * inputs + 2] = work.mean[n + 2 * i + 1]
    for j in range(settings.springs):
        a = model.first[j]
        b = model.second[j]
        dx = state.x[b] - state.x[a]
        dy = state.y[b] - state.y[a]
        # (l - L0) / the larger of the ways to l_min and l_max: the springs are soft, and leave [-1, 1]
        strain = signed(settings, (math.sqrt(dx * dx + dy * dy) - model.rest[j]) * model.strain_scale[j])
        work.local[b * inputs + 3] = strain
        work.local[a * inputs + 4] = strain
        forth = 2 * j * messages
        back = forth + messages
        for m in range(messages):
            work.local[b * inputs + 5 + m] = state.memory[forth + m]
            work.local[a * inputs + 5 + messages + m] = state.memory[back + m]


@stage
def speak(settings, model, state, work, outputs):
    """answer_i = (command of the spring after, messages to before, to after, vote);  dp = mean vote of a chamber."""
    messages = settings.messages
    for j in range(settings.springs):
        a = model.first[j] * outputs
        b = model.second[j] * outputs
        work.command[j] = work.answer[a]
        forth = 2 * j * messages
        back = forth + messages
        for m in range(messages):
            state.memory[forth + m] = work.answer[a + 1 + messages + m]
            state.memory[back + m] = work.answer[b + 1 + m]
    for c in range(settings.outputs - settings.springs):
        total = fill(work.answer, 0.0)
        for e in range(model.edge_start[c], model.edge_start[c + 1]):
            total += work.answer[model.edge_from[e] * outputs + outputs - 1]
        work.command[settings.springs + c] = total * (1.0 / (model.edge_start[c + 1] - model.edge_start[c]))
