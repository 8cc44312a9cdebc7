"""Springs: soft distance constraints (Box2D 2.3, b2DistanceJoint; Catto, "Soft Constraints", GDC 2011).

    C = |x_h - x_t| - rest,   u = (x_h - x_t) / |x_h - x_t|,   Cdot = u (v_h - v_t)
    lambda = -M (Cdot + bias + gamma J),   M = 1 / (1/m_t + 1/m_h + gamma),   bias = C h k gamma

from the tail t to the head h of each spring. J is the accumulated impulse. In a chain each spring's tail is the
head of the one before it, so that its velocity stays in registers.
"""

import math

from turgor.physics.lanes import select, stage

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
        work.ux[k] = ux
        work.uy[k] = uy
        work.wx[k] = model.effective_mass[k] * ux
        work.wy[k] = model.effective_mass[k] * uy
        work.bias[k] = model.stiffness[k] * (length - state.rest[model.spring[k]])
        state.vx[t] -= state.impulse[k] * (ux * model.inverse_mass[t])
        state.vy[t] -= state.impulse[k] * (uy * model.inverse_mass[t])
        state.vx[h] += state.impulse[k] * (ux * model.inverse_mass[h])
        state.vy[h] += state.impulse[k] * (uy * model.inverse_mass[h])


@stage
def solve_springs(settings, model, state, work):
    """One sweep over all springs. What waits for the spring before it is kept short: two multiplications and
    three additions from its velocity to the next."""
    for chain in range(settings.chains):
        first = model.chain_start[chain]
        t = model.tail[first]
        vx = state.vx[t]
        vy = state.vy[t]
        for k in range(first, model.chain_start[chain + 1]):
            t = model.tail[k]
            h = model.head[k]
            ux = work.ux[k]
            uy = work.uy[k]
            wx = work.wx[k]
            wy = work.wy[k]
            hx = state.vx[h]
            hy = state.vy[h]
            j = state.impulse[k]
            # -lambda = M (u v_h + bias + gamma J) - M u v_t
            rest = work.bias[k] + model.relaxation[k] * j + (wx * hx + wy * hy)
            change = (wx * vx - rest) + wy * vy
            state.impulse[k] = j + change
            state.vx[t] = vx - change * (ux * model.inverse_mass[t])
            state.vy[t] = vy - change * (uy * model.inverse_mass[t])
            vx = hx + change * (ux * model.inverse_mass[h])
            vy = hy + change * (uy * model.inverse_mass[h])
        h = model.head[model.chain_start[chain + 1] - 1]
        state.vx[h] = vx
        state.vy[h] = vy
