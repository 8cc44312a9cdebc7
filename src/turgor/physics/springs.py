"""Springs: soft distance constraints (Box2D 2.3, b2DistanceJoint; Catto, "Soft Constraints", GDC 2011).

    C = |x_h - x_t| - rest,   u = (x_h - x_t) / |x_h - x_t|,   Cdot = u (v_h - v_t)
    lambda = -M (Cdot + bias + gamma J),   M = 1 / (1/m_t + 1/m_h + gamma),   bias = C h k gamma

from the tail t to the head h of each spring. J is the accumulated impulse. In a chain each spring's tail is the head
of the one before it, so that lambda depends on the lambda before. With z = u / m_h that is one multiplication and one
addition, and the rest need not wait:

    v_t = v_t(before) + z' lambda',   lambda = -(M (u v_h - u v_t(before) + bias) + M gamma J) + (M u z') lambda'
"""

import math

from numba import intp

from turgor.physics.build import stage
from turgor.physics.lanes import select
from turgor.physics.views import fill

SLOP = 0.005  # [m], a shorter spring has no direction


@stage
def prepare_springs(settings, model, state, work):
    """Directions and biases of this step, and the warm start:  v += J u / m."""
    for k in range(settings.springs):
        t = model.tail[k]
        h = model.head[k]
        dx = state.x[h] - state.x[t]
        dy = state.y[h] - state.y[t]
        length = math.sqrt(dx * dx + dy * dy)
        inverse = select(length > SLOP, 1.0 / max(length, 1e-12), length * 0.0)
        ux = dx * inverse
        uy = dy * inverse
        # the first spring of a chain has none before it: lambda' is 0 there, whatever the link
        before = max(k - 1, 0)
        work.link[k] = model.effective_mass[k] * model.inverse_mass[t] * (ux * work.ux[before] + uy * work.uy[before])
        work.ux[k] = ux
        work.uy[k] = uy
        work.bias[k] = model.stiffness[k] * (length - state.rest[model.spring[k]])
        state.vx[t] -= state.impulse[k] * (ux * model.inverse_mass[t])
        state.vy[t] -= state.impulse[k] * (uy * model.inverse_mass[t])
        state.vx[h] += state.impulse[k] * (ux * model.inverse_mass[h])
        state.vy[h] += state.impulse[k] * (uy * model.inverse_mass[h])


@stage
def solve_springs(settings, model, state, work):
    """One sweep over all springs."""
    for chain in range(settings.chains):
        first = intp(model.chain_start[chain])
        t = intp(model.tail[first])
        tx = state.vx[t]  # the tail's velocity without the spring before
        ty = state.vy[t]
        zx = fill(state.vx, 0.0)
        zy = zx
        before = zx
        for k in range(first, intp(model.chain_start[chain + 1])):
            h = intp(model.head[k])
            ux = work.ux[k]
            uy = work.uy[k]
            hx = state.vx[h]
            hy = state.vy[h]
            j = state.impulse[k]
            pull = model.effective_mass[k] * (ux * (tx - hx) + uy * (ty - hy))
            change = (pull - (work.bias[k] + model.relaxation[k] * j)) + work.link[k] * before
            state.impulse[k] = j + change
            state.vx[t] = (tx + zx * before) - change * (ux * model.inverse_mass[t])
            state.vy[t] = (ty + zy * before) - change * (uy * model.inverse_mass[t])
            zx = ux * model.inverse_mass[h]
            zy = uy * model.inverse_mass[h]
            tx = hx
            ty = hy
            before = change
            t = h
        state.vx[t] = tx + zx * before
        state.vy[t] = ty + zy * before
