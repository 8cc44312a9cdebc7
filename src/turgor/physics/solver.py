"""The solver: sequential impulses on springs and contacts (Box2D 2.3; Catto, GDC 2006 and 2009).

Contact of a body with normal n and tangent t = (n_y, -n_x); friction before the normal, as Box2D has it:

    lambda_t = -m_eff (dv t),   |J_t| <= mu J_n            lambda_n = -m_eff (dv n),   J_n >= 0

with the impulses J accumulated over iterations and steps. On the ground impulses are per unit of mass, so that
m_eff = 1. A square's two points are redundant, since it cannot turn: velocities use the first, positions both.
"""

import math

from turgor.physics.lanes import any_lane, fill, inlined, select, stage
from turgor.physics.sense import clamp
from turgor.physics.springs import solve_springs


@stage
def warm_start_contacts(model, state, work, grounds, pairs):
    """v += J / m  with the impulses of the last step."""
    for c in range(grounds):
        i = work.ground_mass[c]
        nx = work.ground_nx[c]
        ny = work.ground_ny[c]
        state.vx[i] += work.ground_normal[c] * nx + work.ground_tangent[c] * ny
        state.vy[i] += work.ground_normal[c] * ny - work.ground_tangent[c] * nx
    for c in range(pairs):
        a = model.pair_a[work.pair[c]]
        b = model.pair_b[work.pair[c]]
        nx = work.pair_nx[c]
        ny = work.pair_ny[c]
        px = work.pair_normal[c] * nx + work.pair_tangent[c] * ny
        py = work.pair_normal[c] * ny - work.pair_tangent[c] * nx
        state.vx[a] -= px * model.inverse_mass[a]
        state.vy[a] -= py * model.inverse_mass[a]
        state.vx[b] += px * model.inverse_mass[b]
        state.vy[b] += py * model.inverse_mass[b]


@stage
def solve_velocities(settings, model, state, work, grounds, pairs):
    """The velocity iterations; the impulses are kept for the next step's warm start."""
    for _ in range(settings.velocity_iterations):
        solve_springs(settings, model, state, work)
        solve_pairs(settings, model, state, work, pairs)
        solve_grounds(settings, state, work, grounds)
    for c in range(grounds):
        state.ground_normal0[work.ground_slot[c]] = work.ground_normal[c]
        state.ground_tangent0[work.ground_slot[c]] = work.ground_tangent[c]
    for c in range(pairs):
        state.pair_normal0[work.pair[c]] = work.pair_normal[c]
        state.pair_tangent0[work.pair[c]] = work.pair_tangent[c]


@inlined
def solve_grounds(settings, state, work, grounds):
    for c in range(grounds):
        i = work.ground_mass[c]
        nx = work.ground_nx[c]
        ny = work.ground_ny[c]
        vx = state.vx[i]
        vy = state.vy[i]
        normal = work.ground_normal[c]
        tangent = work.ground_tangent[c]
        limit = settings.ground_friction * normal
        slide = clamp(tangent - (vx * ny - vy * nx), -limit, limit)
        # friction does not change the velocity along n
        press = max(normal - (vx * nx + vy * ny), 0.0)
        work.ground_tangent[c] = slide
        work.ground_normal[c] = press
        state.vx[i] = vx + ((slide - tangent) * ny + (press - normal) * nx)
        state.vy[i] = vy + ((press - normal) * ny - (slide - tangent) * nx)


@inlined
def solve_pairs(settings, model, state, work, pairs):
    for c in range(pairs):
        a = model.pair_a[work.pair[c]]
        b = model.pair_b[work.pair[c]]
        mass = 1.0 / (model.inverse_mass[a] + model.inverse_mass[b])
        nx = work.pair_nx[c]
        ny = work.pair_ny[c]
        vx = state.vx[b] - state.vx[a]
        vy = state.vy[b] - state.vy[a]
        normal = work.pair_normal[c]
        tangent = work.pair_tangent[c]
        limit = settings.pair_friction * normal
        slide = clamp(tangent - mass * (vx * ny - vy * nx), -limit, limit)
        press = max(normal - mass * (vx * nx + vy * ny), 0.0)
        work.pair_tangent[c] = slide
        work.pair_normal[c] = press
        px = (slide - tangent) * ny + (press - normal) * nx
        py = (press - normal) * ny - (slide - tangent) * nx
        state.vx[a] -= px * model.inverse_mass[a]
        state.vy[a] -= py * model.inverse_mass[a]
        state.vx[b] += px * model.inverse_mass[b]
        state.vy[b] += py * model.inverse_mass[b]


@stage
def integrate(settings, state, work):
    """d = h v, at most `max_travel` a step."""
    most = settings.max_travel
    for i in range(settings.masses):
        dx = settings.dt * state.vx[i]
        dy = settings.dt * state.vy[i]
        square = dx * dx + dy * dy
        if any_lane(square > most * most):
            share = select(square > most * most, most / math.sqrt(max(square, 1e-12)), 1.0)
            state.vx[i] *= share
            state.vy[i] *= share
            dx *= share
            dy *= share
        work.dx[i] = dx
        work.dy[i] = dy


@stage
def correct_positions(settings, model, state, work, grounds, pairs):
    """Pushes out what is too deep:  C = clamp(beta (gap + slop), -C_max, 0),  one point after the other, until no
    contact of the agent was deeper than 3 slops; then x += d."""
    busy = fill(state.x, 0.0) == 0.0
    for _ in range(settings.position_iterations):
        deepest = fill(state.x, 0.0)
        for c in range(pairs):
            p = work.pair[c]
            deepest = min(deepest, correct_pair(settings, model, work, c, p, work.pair_gap0[c], busy))
            deepest = min(deepest, correct_pair(settings, model, work, c, p, work.pair_gap1[c], busy))
        for c in range(grounds):
            i = work.ground_mass[c]
            nx = work.ground_nx[c]
            ny = work.ground_ny[c]
            dx = work.dx[i]
            dy = work.dy[i]
            gap = work.ground_gap0[c] + (nx * dx + ny * dy)
            deepest = min(deepest, gap)
            push = correction(settings, gap, busy)
            dx -= push * nx
            dy -= push * ny
            gap = work.ground_gap1[c] + (nx * dx + ny * dy)
            deepest = min(deepest, gap)
            push = correction(settings, gap, busy)
            work.dx[i] = dx - push * nx
            work.dy[i] = dy - push * ny
        busy = busy & (deepest < -3.0 * settings.slop)
        if not any_lane(busy):
            break
    for i in range(settings.masses):
        state.x[i] += work.dx[i]
        state.y[i] += work.dy[i]


@inlined
def correct_pair(settings, model, work, c, p, gap, busy):
    """Moves both masses of pair p apart by their share; returns the gap [m] that it met."""
    a = model.pair_a[p]
    b = model.pair_b[p]
    nx = work.pair_nx[c]
    ny = work.pair_ny[c]
    gap = gap + (nx * (work.dx[b] - work.dx[a]) + ny * (work.dy[b] - work.dy[a]))
    push = correction(settings, gap, busy) / (model.inverse_mass[a] + model.inverse_mass[b])
    work.dx[a] += push * model.inverse_mass[a] * nx
    work.dy[a] += push * model.inverse_mass[a] * ny
    work.dx[b] -= push * model.inverse_mass[b] * nx
    work.dy[b] -= push * model.inverse_mass[b] * ny
    return gap


@inlined
def correction(settings, gap, busy):
    """C of one point, 0 for an agent that is done."""
    return select(busy, clamp(settings.baumgarte * (gap + settings.slop), -settings.max_correction, 0.0), 0.0)
