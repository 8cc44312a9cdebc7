"""Contacts: which masses touch the scene or each other, in one fixed order.

Pairs (a, b) in the order of the model; then masses in turn, each with the segments of its column from the last of the
scene to the first: Box2D's order, newest first, while contacts are made in the order of the scene. A contact that any
lane of the block has is in the list; in the other lanes its normal is 0, so that it does nothing there. Thus an agent's
contacts are solved in the same order, whatever its neighbours do.
"""

import numpy as np

from turgor.physics.build import inlined, rare, stage
from turgor.physics.lanes import any_lane, highest, lane_bits, lowest_bit, select, select_mask
from turgor.physics.manifold import (
    NO_ID,
    face_on_segment,
    kept,
    nearest_face,
    pick,
    segment_on_face,
    separation_of_squares,
    square_on_square,
)
from turgor.physics.model import LOOK_AGAIN, MARGIN, NOWHERE
from turgor.physics.views import fill

FAR_BELOW = -1e9  # [m], where the segment of an empty slot lies


@stage
def find_ground_contacts(settings, model, ground, state, work):
    """Lists the contacts with the scene and returns their number; renews `touch`."""
    count = np.int64(0)  # not a literal, for which Numba would compile what takes it twice
    for i in range(settings.masses):
        state.touch[i] = fill(state.x, 0.0)
        x = state.x[i]
        moved = (x < state.left[i]) | (x >= state.right[i])
        if any_lane(moved):
            enter_columns(settings, model, ground, state, work, i, lane_bits(moved))
        y = state.y[i]
        first = i * settings.slots
        if any_lane((y < state.floor[i]) | (y > state.ceiling[i])):
            for slot in range(first + state.used[i] - 1, first - 1, -1):
                count = add_ground_contact(settings, model, state, work, i, slot, count)
        else:
            for slot in range(first, first + state.used[i]):
                state.ground_live[slot] = 0
    return count


@inlined
def add_ground_contact(settings, model, state, work, i, slot, count):
    """Lists the contact of mass i with the segment in `slot`, if any lane has it; returns the new count."""
    x = state.x[i]
    y = state.y[i]
    nx = state.nx[slot]
    ny = state.ny[slot]
    depth = state.depth[slot]
    px = state.px[slot] - x
    py = state.py[slot] - y
    above = -(nx * px + ny * py)
    gap_segment = above - state.extent[slot]
    near = (gap_segment <= settings.reach) & (above >= -depth)
    if not any_lane(near):
        state.ground_live[slot] = 0
        return count

    half = model.half[i]
    qx = state.qx[slot] - x
    qy = state.qy[slot] - y
    gap_face, face, u1, w1, u2, w2 = nearest_face(half, model.cosine[i], model.sine[i], px, py, qx, qy)
    behind = above < 0.0
    over = (min(px, qx) <= 0.0) & (max(px, qx) >= 0.0)
    touches = near & ((~behind & (gap_face <= settings.reach)) | (behind & over & (depth > 0.0)))
    if not any_lane(touches):
        state.ground_live[slot] = 0
        return count

    on_face = touches & ~behind & (gap_face > 0.98 * gap_segment + 0.001)
    gap_a, id_a, gap_b, id_b, left = face_on_segment(
        half, nx, ny, px, py, qx, qy, above, behind, state.facing[slot], state.lean[slot], state.tilt[slot]
    )
    if any_lane(on_face):
        face_a, face_id_a, face_b, face_id_b, face_left = segment_on_face(half, face, u1, w1, u2, w2)
        left = select_mask(on_face, face_left, left)
        gap_a = select(on_face, face_a, gap_a)
        id_a = select(on_face, face_id_a, id_a)
        gap_b = select(on_face, face_b, gap_b)
        id_b = select(on_face, face_id_b, id_b)
        # the normal is that of the square's face, towards the square
        c = fill(state.x, model.cosine[i])
        s = fill(state.x, model.sine[i])
        nx = select(on_face, pick(face, -s, -c, s, c), nx)
        ny = select(on_face, pick(face, c, -s, -c, s), ny)
    touches = touches & left
    touches, gap0, id0, gap1, id1 = kept(settings.reach, touches, gap_a, id_a, gap_b, id_b)
    if not any_lane(touches):
        state.ground_live[slot] = 0
        return count

    state.touch[i] = select(touches, 1.0, state.touch[i])
    work.ground_mass[count] = i
    work.ground_slot[count] = slot
    work.ground_nx[count] = select(touches, nx, 0.0)
    work.ground_ny[count] = select(touches, ny, 0.0)
    work.ground_gap0[count] = gap0 - settings.reach
    work.ground_gap1[count] = gap1 - settings.reach
    if state.ground_live[slot] == 0:
        state.ground_live[slot] = 1
        forget(state.ground_id0, state.ground_id1, slot)
    old0 = state.ground_id0[slot]
    old1 = state.ground_id1[slot]
    n0 = state.ground_normal0[slot]
    t0 = state.ground_tangent0[slot]
    n1 = state.ground_normal1[slot]
    t1 = state.ground_tangent1[slot]
    work.ground_normal[count] = recall(id0, old0, n0, old1, n1)
    work.ground_tangent[count] = recall(id0, old0, t0, old1, t1)
    state.ground_normal1[slot] = recall(id1, old0, n0, old1, n1)
    state.ground_tangent1[slot] = recall(id1, old0, t0, old1, t1)
    state.ground_id0[slot] = id0
    state.ground_id1[slot] = id1
    return count + 1


@inlined
def forget(id0, id1, at):
    """No lane has an impulse to recall."""
    id0[at] = fill(id0, NO_ID)
    id1[at] = fill(id1, NO_ID)


@inlined
def recall(new, old0, impulse0, old1, impulse1):
    """The impulse that the point `new` had in the step before, 0 if it was not there."""
    known = new != NO_ID
    return select(known & (new == old0), impulse0, select(known & (new == old1), impulse1, 0.0))


@rare
def enter_columns(settings, model, ground, state, work, i, lanes):
    """Copies the column that mass i is in to each of `lanes` (bits), and takes along the impulses of the segments
    that the old column had too. A slot whose segment stays is left as it is."""
    reach = model.extent[i] + 1.4143 * settings.reach + MARGIN
    slots = settings.slots
    first = i * slots
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes = lanes & (lanes - 1)
        cell = find_column(settings, ground, lane, state.x[i, lane], state.cell[i, lane])
        state.cell[i, lane] = cell
        state.left[i, lane] = ground.left[cell]
        state.right[i, lane] = ground.right[cell]
        state.floor[i, lane] = ground.floor[cell] + reach
        state.ceiling[i, lane] = ground.ceiling[cell] - reach
        state.listed[i, lane] = ground.listed[cell]
        carry_impulses(settings, state, work, first, lane)
        for k in range(slots):
            segment = ground.candidate[cell * slots + k]
            if segment != state.segment[first + k, lane]:
                fill_slot(settings, model, ground, state, work, i, k, lane, segment)
    used = 0
    for lane in range(settings.lanes):
        used = max(used, state.listed[i, lane])
    for slot in range(first + used, first + slots):
        state.ground_live[slot] = 0
    state.used[i] = used


@inlined
def first_column(settings, lane):
    """Where the columns of a lane's scene begin."""
    return lane * settings.columns if settings.own_ground != 0 else 0


@inlined
def column_at(settings, ground, lane, x):
    """The column of a lane's scene that holds x, looked for by halves: long scenes cost hardly more than short ones."""
    low = first_column(settings, lane)
    high = low + settings.columns - 1
    while low < high:
        middle = (low + high) // 2
        if x < ground.right[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@inlined
def find_column(settings, ground, lane, x, cell):
    """The column of a lane's scene that holds x, looked for from `cell` on: mostly its neighbour."""
    first = first_column(settings, lane)
    while cell + 1 < first + settings.columns and x >= ground.right[cell]:
        cell += 1
    while cell > first and x < ground.left[cell]:
        cell -= 1
    return cell


@inlined
def carry_impulses(settings, state, work, first, lane):
    """Sets the impulses of a lane's old column aside."""
    for k in range(settings.slots):
        slot = first + k
        work.carried_segment[k] = state.segment[slot, lane]
        work.carried_id0[k] = NO_ID
        work.carried_id1[k] = NO_ID
        if state.ground_live[slot] != 0:
            work.carried_id0[k] = state.ground_id0[slot, lane]
            work.carried_id1[k] = state.ground_id1[slot, lane]
            work.carried_normal0[k] = state.ground_normal0[slot, lane]
            work.carried_tangent0[k] = state.ground_tangent0[slot, lane]
            work.carried_normal1[k] = state.ground_normal1[slot, lane]
            work.carried_tangent1[k] = state.ground_tangent1[slot, lane]


@inlined
def fill_slot(settings, model, ground, state, work, i, k, lane, segment):
    """Puts a segment into slot k of a lane, with the impulses that were set aside for it."""
    slot = i * settings.slots + k
    state.segment[slot, lane] = segment
    if segment == NOWHERE:
        state.px[slot, lane] = 0.0
        state.py[slot, lane] = FAR_BELOW
        state.nx[slot, lane] = 0.0
        state.ny[slot, lane] = 1.0
        state.depth[slot, lane] = 0.0
        state.extent[slot, lane] = 0.0
    else:
        state.px[slot, lane] = ground.x1[segment]
        state.py[slot, lane] = ground.y1[segment]
        state.qx[slot, lane] = ground.x2[segment]
        state.qy[slot, lane] = ground.y2[segment]
        state.nx[slot, lane] = ground.nx[segment]
        state.ny[slot, lane] = ground.ny[segment]
        state.depth[slot, lane] = ground.depth[segment]
        along_a = ground.nx[segment] * model.cosine[i] + ground.ny[segment] * model.sine[i]
        along_b = ground.ny[segment] * model.cosine[i] - ground.nx[segment] * model.sine[i]
        against, face = largest_of(along_b, -along_a, -along_b, along_a)
        state.facing[slot, lane] = face
        state.lean[slot, lane] = -against
        state.tilt[slot, lane] = along_a if face == 0 else along_b if face == 1 else -along_a if face == 2 else -along_b
        state.extent[slot, lane] = model.half[i] * (abs(along_a) + abs(along_b))
    if state.ground_live[slot] != 0:
        state.ground_id0[slot, lane] = NO_ID
        state.ground_id1[slot, lane] = NO_ID
    for old in range(settings.slots):
        if segment != NOWHERE and work.carried_segment[old] == segment and work.carried_id0[old] != NO_ID:
            if state.ground_live[slot] == 0:
                state.ground_live[slot] = 1
                for other in range(settings.lanes):
                    state.ground_id0[slot, other] = NO_ID
                    state.ground_id1[slot, other] = NO_ID
            state.ground_id0[slot, lane] = work.carried_id0[old]
            state.ground_id1[slot, lane] = work.carried_id1[old]
            state.ground_normal0[slot, lane] = work.carried_normal0[old]
            state.ground_tangent0[slot, lane] = work.carried_tangent0[old]
            state.ground_normal1[slot, lane] = work.carried_normal1[old]
            state.ground_tangent1[slot, lane] = work.carried_tangent1[old]


@inlined
def largest_of(v0, v1, v2, v3):
    """The largest of four numbers and which it is; the first of equal ones."""
    best = v0
    face = 0
    if v1 > best:
        best = v1
        face = 1
    if v2 > best:
        best = v2
        face = 2
    if v3 > best:
        best = v3
        face = 3
    return best, face


@stage
def find_pair_contacts(settings, model, state, work):
    """Lists the contacts of two masses and returns their number; renews `touch`."""
    count = np.int64(0)
    travel = state.travel[0]
    for p in range(settings.pairs):
        if travel < state.wake[p]:
            continue
        a = model.pair_a[p]
        b = model.pair_b[p]
        dx = state.x[b] - state.x[a]
        dy = state.y[b] - state.y[a]
        nearer = model.pair_reach[p] - max(abs(dx), abs(dy))
        if any_lane(nearer > 0.0):
            count = add_pair_contact(settings, model, state, work, p, a, b, dx, dy, count)
        else:
            state.pair_live[p] = 0
            state.wake[p] = travel - highest(nearer)
    return count


@stage
def note_travel(settings, state, work, t):
    """How much the distance of any two masses can have changed in step t, in x or in y, is added to `travel`: what
    they have moved together does not count."""
    left = work.dx[0]
    right = left
    down = work.dy[0]
    up = down
    for i in range(1, settings.masses):
        left = min(work.dx[i], left)
        right = max(work.dx[i], right)
        down = min(work.dy[i], down)
        up = max(work.dy[i], up)
    state.travel[0] += highest(max(right - left, up - down))
    if t % LOOK_AGAIN == 0:
        state.travel[0] = 0.0
        for p in range(settings.pairs):
            state.wake[p] = 0.0


@inlined
def add_pair_contact(settings, model, state, work, p, a, b, dx, dy, count):
    """Lists the contact of pair p, if any lane has it; returns the new count."""
    half_a = model.half[a]
    half_b = model.half[b]
    cos_a = model.cosine[a]
    sin_a = model.sine[a]
    cos_b = model.cosine[b]
    sin_b = model.sine[b]
    c = model.pair_cosine[p]
    s = model.pair_sine[p]
    gap_a, face_a, au, aw, gap_b, face_b, bu, bw = separation_of_squares(
        half_a, half_b, cos_a, sin_a, cos_b, sin_b, c, s, dx, dy
    )
    near = max(gap_a, gap_b) <= settings.reach
    if not any_lane(near):
        state.pair_live[p] = 0
        return count
    nx, ny, gap0, id0, gap1, id1, left = square_on_square(
        settings.reach, half_a, half_b, cos_a, sin_a, cos_b, sin_b, c, s, gap_a, face_a, au, aw, gap_b, face_b, bu, bw
    )
    touches, gap0, id0, gap1, id1 = kept(settings.reach, near & left, gap0, id0, gap1, id1)
    if not any_lane(touches):
        state.pair_live[p] = 0
        return count
    state.touch[a] = select(touches, 1.0, state.touch[a])
    state.touch[b] = select(touches, 1.0, state.touch[b])
    work.pair[count] = p
    work.pair_nx[count] = select(touches, nx, 0.0)
    work.pair_ny[count] = select(touches, ny, 0.0)
    work.pair_gap0[count] = gap0 - settings.reach
    work.pair_gap1[count] = gap1 - settings.reach
    if state.pair_live[p] == 0:
        state.pair_live[p] = 1
        forget(state.pair_id0, state.pair_id1, p)
    old0 = state.pair_id0[p]
    old1 = state.pair_id1[p]
    n0 = state.pair_normal0[p]
    t0 = state.pair_tangent0[p]
    n1 = state.pair_normal1[p]
    t1 = state.pair_tangent1[p]
    work.pair_normal[count] = recall(id0, old0, n0, old1, n1)
    work.pair_tangent[count] = recall(id0, old0, t0, old1, t1)
    state.pair_normal1[p] = recall(id1, old0, n0, old1, n1)
    state.pair_tangent1[p] = recall(id1, old0, t0, old1, t1)
    state.pair_id0[p] = id0
    state.pair_id1[p] = id1
    return count + 1
