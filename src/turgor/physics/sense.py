"""Sensing: the present observation is pushed into the window, whose mean the controller sees."""

from turgor.physics.build import inlined, rare, stage
from turgor.physics.lanes import any_lane, select
from turgor.physics.views import fill


@inlined
def clamp(value, low, high):
    return max(min(value, high), low)


@stage
def grow_older(settings, state):
    """Every agent has one observation more; its window may be younger than that of others in its block."""
    state.age[0] = state.age[0] + 1.0
    state.phase[0] = select(state.phase[0] == settings.window - 1, 0.0, state.phase[0] + 1.0)


@stage
def sense(settings, model, state, work, t):
    """Puts  o = (touch, relative positions, velocity, pressures)  after t steps of the block into the window; renews
    the mean. Doing it twice changes nothing."""
    n = settings.masses
    slot = t % settings.window
    at = slot * settings.inputs
    cx = fill(state.x, 0.0)
    cy = cx
    cvx = cx
    cvy = cx
    for i in range(n):
        cx += model.share[i] * state.x[i]
        cy += model.share[i] * state.y[i]
        cvx += model.share[i] * state.vx[i]
        cvy += model.share[i] * state.vy[i]
    for i in range(n):
        push(state, at, i, state.touch[i])
        push(state, at, n + 2 * i, signed(settings, (state.x[i] - cx) * settings.position_scale))
        push(state, at, n + 2 * i + 1, signed(settings, (state.y[i] - cy) * settings.position_scale))
    push(state, at, 3 * n, signed(settings, cvx * settings.velocity_scale))
    push(state, at, 3 * n + 1, signed(settings, cvy * settings.velocity_scale))
    for c in range(settings.chambers):
        push(state, at, 3 * n + 2 + c, clamp(state.pressure[c] * model.pressure_scale[c], 0.0, 1.0))
    renew = state.phase[0] == settings.window - 1
    if any_lane(renew):
        renew_total(settings, state, slot, renew)
    share = 1.0 / min(state.age[0], settings.window)
    for k in range(settings.inputs):
        work.mean[k] = state.total[k] * share


@inlined
def signed(settings, value):
    value = clamp(value, -1.0, 1.0)
    if settings.unit_observation != 0:
        value = (value + 1.0) * 0.5
    return value


@inlined
def push(state, at, k, value):
    state.total[k] += value - state.window[at + k]
    state.window[at + k] = value


@rare
def renew_total(settings, state, slot, renew):
    """Sums the window anew, from the oldest observation to the one in `slot`, once per window of an agent's own, so
    that the running sums gather no rounding errors."""
    oldest = (slot + 1) % settings.window
    for k in range(settings.inputs):
        total = state.window[oldest * settings.inputs + k]
        for w in range(oldest + 1, settings.window):
            total += state.window[w * settings.inputs + k]
        for w in range(oldest):
            total += state.window[w * settings.inputs + k]
        state.total[k] = select(renew, total, state.total[k])
