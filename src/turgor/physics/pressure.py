"""Gas: the ideal gas law, and the pressure that pushes each chamber's edges outwards."""

import math

from turgor.physics.build import inlined, stage
from turgor.physics.model import GAS_LAW, NOWHERE
from turgor.physics.views import fill


@stage
def gas_law(settings, model, state):
    """p = nRT / area, with the signed (shoelace) area, never below the chamber's floor."""
    if settings.pressure_source != GAS_LAW:
        return
    for c in range(settings.chambers):
        area = signed_area(model, state, c)
        state.pressure[c] = model.gas_energy[c] / max(area, fill(state.x, model.area_floor[c]))


@inlined
def signed_area(model, state, c):
    """A chamber's area [m^2] by the shoelace formula; negative where the loop runs clockwise."""
    first = model.edge_from[model.edge_start[c]]
    x0 = state.x[first]
    y0 = state.y[first]
    area = fill(state.x, 0.0)
    for e in range(model.edge_start[c], model.edge_start[c + 1]):
        i = model.edge_from[e]
        k = model.edge_to[e]
        area += (state.x[i] - x0) * (state.y[k] - y0) - (state.x[k] - x0) * (state.y[i] - y0)
    return 0.5 * area


@stage
def apply_forces(settings, model, state):
    """v += h (g + F / m); on both ends of an edge (dx, dy)  F = p/2 (dy, -dx): outwards, because a chamber's
    loop runs counter-clockwise. The forces of a closed loop sum to zero."""
    for i in range(settings.masses):
        state.vy[i] -= settings.dt * settings.gravity
    for c in range(settings.chambers):
        push = state.pressure[c] * (0.5 * settings.dt)
        for e in range(model.edge_start[c], model.edge_start[c + 1]):
            i = model.edge_from[e]
            k = model.edge_to[e]
            dx = state.x[k] - state.x[i]
            dy = state.y[k] - state.y[i]
            force = push
            if settings.commanded_length != 0 and model.edge_spring[e] != NOWHERE:
                # the variant: as long as commanded, not as long as it is
                force = push * state.rest[model.edge_spring[e]] / math.sqrt(max(dx * dx + dy * dy, 1e-12))
            fx = force * dy
            fy = force * dx
            state.vx[i] += fx * model.inverse_mass[i]
            state.vy[i] -= fy * model.inverse_mass[i]
            state.vx[k] += fx * model.inverse_mass[k]
            state.vy[k] -= fy * model.inverse_mass[k]
