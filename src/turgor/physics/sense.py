"""Sensing: the present observation is pushed into the window, whose mean the controller sees."""

from turgor.physics.lanes import inlined, rare, stage
from turgor.physics.memory import fill


@inlined
def clamp(value, low, high):
    return max(min(value, high), low)


@stage
def sense(settings, model, state, work, t):
    """Pushes  o = (touch, relative positions, velocity, pressures)  after t steps into the window; renews the mean."""
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
    if slot == settings.window - 1:
        renew_total(settings, state)
    share = 1.0 / min(t + 1, settings.window)
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
def renew_total(settings, state):
    """Sums the window anew, once per window, so that the running sums gather no rounding errors."""
    for k in range(settings.inputs):
        total = state.window[k]
        for w in range(1, settings.window):
            total += state.window[w * settings.inputs + k]
        state.total[k] = total
