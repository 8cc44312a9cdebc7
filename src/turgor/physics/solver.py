"""The solver: sequential impulses on springs and contacts (Box2D 2.3; Catto, GDC 2006 and 2009).

Contact of a body with normal n and tangent t = (n_y, -n_x); friction before the normal, as Box2D has it:

    lambda_t = -m_eff (dv t),   |J_t| <= mu J_n            lambda_n = -m_eff (dv n),   J_n >= 0

with the impulses J accumulated over iterations and steps. They are kept per unit of effective mass, as velocities:
m_eff = 1, and a mass m of a pair takes the share m_eff / m of the change. A square's two points are redundant, since it
cannot turn: velocities use the first, positions both.
"""

import math

from turgor.physics.build import inlined, stage
from turgor.physics.lanes import any_lane, select
from turgor.physics.sense import clamp
from turgor.physics.springs import solve_springs
from turgor.physics.views import fill


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
        share_a = model.pair_share_a[work.pair[c]]
        share_b = model.pair_share_b[work.pair[c]]
        state.vx[a] -= px * share_a
        state.vy[a] -= py * share_a
        state.vx[b] += px * share_b
        state.vy[b] += py * share_b


@stage
def solve_velocities(settings, model, state, work, grounds, pairs):
    """The velocity iterations; the impulses are kept for the next step's warm start."""
    for _ in range(settings.velocity_iterations):
        solve_springs(settings, model, state, work)
        solve_pairs(model, state, work, settings.pair_friction, pairs)
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
def solve_pairs(model, state, work, friction, pairs):
    for c in range(pairs):
        p = work.pair[c]
        a = model.pair_a[p]
        b = model.pair_b[p]
        share_a = model.pair_share_a[p]
        share_b = model.pair_share_b[p]
        nx = work.pair_nx[c]
        ny = work.pair_ny[c]
        ax = state.vx[a]
        ay = state.vy[a]
        bx = state.vx[b]
        by = state.vy[b]
        vx = bx - ax
        vy = by - ay
        normal = work.pair_normal[c]
        tangent = work.pair_tangent[c]
        limit = friction * normal
        slide = clamp(tangent - (vx * ny - vy * nx), -limit, limit)
        press = max(normal - (vx * nx + vy * ny), 0.0)
        work.pair_tangent[c] = slide
        work.pair_normal[c] = press
        px = (slide - tangent) * ny + (press - normal) * nx
        py = (press - normal) * ny - (slide - tangent) * nx
        state.vx[a] = ax - px * share_a
        state.vy[a] = ay - py * share_a
        state.vx[b] = bx + px * share_b
        state.vy[b] = by + py * share_b


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
            a = model.pair_a[p]
            b = model.pair_b[p]
            share_a = model.pair_share_a[p]
            share_b = model.pair_share_b[p]
            nx = work.pair_nx[c]
            ny = work.pair_ny[c]
            ax = work.dx[a]
            ay = work.dy[a]
            bx = work.dx[b]
            by = work.dy[b]
            closer = nx * (bx - ax) + ny * (by - ay)
            gap = work.pair_gap0[c] + closer
            deepest = min(deepest, gap)
            first = correction(settings, gap, busy)
            # the first point's correction, along the same normal, has moved the second
            gap = work.pair_gap1[c] + (closer - first)
            deepest = min(deepest, gap)
            push = first + correction(settings, gap, busy)
            work.dx[a] = ax + push * share_a * nx
            work.dy[a] = ay + push * share_a * ny
            work.dx[b] = bx - push * share_b * nx
            work.dy[b] = by - push * share_b * ny
        for c in range(grounds):
            i = work.ground_mass[c]
            nx = work.ground_nx[c]
            ny = work.ground_ny[c]
            dx = work.dx[i]
            dy = work.dy[i]
            closer = nx * dx + ny * dy
            gap = work.ground_gap0[c] + closer
            deepest = min(deepest, gap)
            first = correction(settings, gap, busy)
            gap = work.ground_gap1[c] + (closer - first)
            deepest = min(deepest, gap)
            push = first + correction(settings, gap, busy)
            work.dx[i] = dx - push * nx
            work.dy[i] = dy - push * ny
        busy = busy & (deepest < -3.0 * settings.slop)
        if not any_lane(busy):
            break
    for i in range(settings.masses):
        state.x[i] += work.dx[i]
        state.y[i] += work.dy[i]


@inlined
def correction(settings, gap, busy):
    """C of one point, 0 for an agent that is done."""
    return select(busy, clamp(settings.baumgarte * (gap + settings.slop), -settings.max_correction, 0.0), 0.0)
