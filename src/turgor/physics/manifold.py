"""Manifolds: where two shapes touch, as Box2D 2.3 finds it (b2EPCollider, b2CollidePolygons).

Squares never turn, so a manifold is a normal and the gaps of at most two points. Corner k of a square is
0 (-, -), 1 (+, -), 2 (+, +), 3 (-, +) in its own axes a and b; face f runs from corner f to f + 1, with the outward
normal -b, a, b, -a. Seen from a face (or a segment), xi is the way out and eta the way along it, counter-clockwise.

A point's id says what made it, so that its impulse can be found again in the next step:
8 * reference + corner, with the reference 0 for a segment, 1 + f for a face (of a pair: 1 + f of a, 5 + f of b),
and the corner 4 or 5 where the face's own first or second end cuts the other's edge.
"""

from turgor.physics.build import inlined
from turgor.physics.lanes import any_lane, select

NO_POINT = 1e9  # [m], gap of a point that is not there
NO_ID = -1.0


@inlined
def pick(face, at0, at1, at2, at3):
    """The one of four values that belongs to `face`."""
    return select(face == 0.0, at0, select(face == 1.0, at1, select(face == 2.0, at2, at3)))


@inlined
def largest(v0, v1, v2, v3):
    """The largest of four values and which it is; the first of equal ones."""
    one = v1 > v0
    best = select(one, v1, v0)
    face = select(one, 1.0, 0.0)
    two = v2 > best
    best = select(two, v2, best)
    face = select(two, 2.0, face)
    three = v3 > best
    return select(three, v3, best), select(three, 3.0, face)


@inlined
def clip(gap0, eta0, id0, gap1, eta1, id1, low, high):
    """The edge from point 0 to point 1 cut to low <= eta <= high: both points in Box2D's order, and whether any is
    left. Point 0 stays first unless it is cut off; a cut point comes second."""
    in0 = eta0 >= low
    in1 = eta1 >= low
    both = in0 & in1
    share = (low - eta0) / (eta1 - eta0)
    gap_cut = gap0 + share * (gap1 - gap0)
    gap_a = select(in0, gap0, gap1)
    eta_a = select(in0, eta0, eta1)
    id_a = select(in0, id0, id1)
    gap_b = select(both, gap1, gap_cut)
    eta_b = select(both, eta1, low)
    id_b = select(both, id1, 4.0)
    left = in0 | in1

    in_a = eta_a <= high
    in_b = eta_b <= high
    both = in_a & in_b
    share = (high - eta_a) / (eta_b - eta_a)
    gap_cut = gap_a + share * (gap_b - gap_a)
    left = left & (in_a | in_b)
    return (
        select(in_a, gap_a, gap_b),
        select(in_a, id_a, id_b),
        select(both, gap_b, gap_cut),
        select(both, id_b, 5.0),
        left,
    )


@inlined
def nearest_face(half, cosine, sine, px, py, qx, qy):
    """The face of a square from which a segment is furthest, and how far [m]; the segment's ends, p and q from the
    square's centre, in the square's own axes."""
    u1 = px * cosine + py * sine
    w1 = py * cosine - px * sine
    u2 = qx * cosine + qy * sine
    w2 = qy * cosine - qx * sine
    gap, face = largest(-max(w1, w2), min(u1, u2), min(w1, w2), -max(u1, u2))
    return gap - half, face, u1, w1, u2, w2


@inlined
def face_on_segment(half, nx, ny, px, py, qx, qy, above, behind, face, lean, tilt):
    """The square's face that looks most against a segment's normal, cut to the segment's ends:
    (gap0, id0, gap1, id1, any left). What is behind the segment is not cut.

    `lean` and `tilt` are the components along the segment's normal of the face's normal and tangent.
    """
    gap0 = above + half * (lean - tilt)
    gap1 = above + half * (lean + tilt)
    id0 = face
    id1 = select(face == 3.0, 0.0, face + 1.0)
    centre = ny * px - nx * py
    eta0 = centre - half * (tilt + lean)
    eta1 = centre - half * (tilt - lean)
    length = nx * (qy - py) - ny * (qx - px)
    left = above == above
    # eta1 < eta0, because the face looks against the segment
    if any_lane((eta1 < 0.0) | (eta0 > length)):
        gap_a, id_a, gap_b, id_b, left = clip(gap0, eta0, id0, gap1, eta1, id1, 0.0, length)
        gap0 = select(behind, gap0, gap_a)
        gap1 = select(behind, gap1, gap_b)
        id0 = select(behind, id0, id_a)
        id1 = select(behind, id1, id_b)
        left = left | behind
    return gap0, id0, gap1, id1, left


@inlined
def segment_on_face(half, face, u1, w1, u2, w2):
    """The segment cut to a face of the square: (gap0, id0, gap1, id1, any left)."""
    gap0 = pick(face, -w1, u1, w1, -u1) - half
    gap1 = pick(face, -w2, u2, w2, -u2) - half
    eta0 = pick(face, u1, w1, -u1, -w1)
    eta1 = pick(face, u2, w2, -u2, -w2)
    gap_a, id_a, gap_b, id_b, left = clip(gap0, eta0, 0.0, gap1, eta1, 1.0, -half, half)
    base = 8.0 * (face + 1.0)
    return gap_a, id_a + base, gap_b, id_b + base, left


@inlined
def kept(reach, touches, gap_a, id_a, gap_b, id_b):
    """The points closer than `reach`, the first kept one first: (touches, gap0, id0, gap1, id1)."""
    a = touches & (gap_a <= reach)
    b = touches & (gap_b <= reach)
    gap0 = select(a, gap_a, select(b, gap_b, NO_POINT))
    id0 = select(a, id_a, select(b, id_b, NO_ID))
    gap1 = select(a & b, gap_b, NO_POINT)
    id1 = select(a & b, id_b, NO_ID)
    return a | b, gap0, id0, gap1, id1


@inlined
def separation_of_squares(half_a, half_b, cos_a, sin_a, cos_b, sin_b, turn_cos, turn_sin, dx, dy):
    """For square b, whose centre stands at (dx, dy) from that of a: (gap [m], face) of the face of a that is furthest
    from b, and b's centre in a's axes; then the same of b."""
    lean = abs(turn_cos) + abs(turn_sin)
    au = dx * cos_a + dy * sin_a
    aw = dy * cos_a - dx * sin_a
    bu = -(dx * cos_b + dy * sin_b)
    bw = -(dy * cos_b - dx * sin_b)
    gap_a, face_a = largest(-aw, au, aw, -au)
    gap_b, face_b = largest(-bw, bu, bw, -bu)
    return gap_a - (half_a + half_b * lean), face_a, au, aw, gap_b - (half_b + half_a * lean), face_b, bu, bw


@inlined
def square_on_square(
    reach, half_a, half_b, cos_a, sin_a, cos_b, sin_b, turn_cos, turn_sin, gap_a, face_a, au, aw, gap_b, face_b, bu, bw
):
    """Contact of two squares of a known separation: (nx, ny, gap0, id0, gap1, id1, any left), the normal from a to
    b."""
    # from here on in the axes of the reference square, with the other one relative to it
    flip = gap_b > 0.98 * gap_a + 0.001
    face = select(flip, face_b, face_a)
    u = select(flip, bu, au)
    w = select(flip, bw, aw)
    half = select(flip, half_b, half_a)
    half_other = select(flip, half_a, half_b)
    c = turn_cos
    s = select(flip, -turn_sin, turn_sin)
    # ... and of its reference face
    xi = pick(face, -w, u, w, -u)
    eta = pick(face, u, w, -u, -w)
    turned_c = pick(face, -s, c, s, -c)
    turned_s = pick(face, c, s, -c, -s)
    # the other's face that looks most against the reference normal: its normal is (m, e)
    m, other = largest(-turned_s, -turned_c, turned_s, turned_c)
    m = -m
    e = pick(other, -turned_c, turned_s, turned_c, -turned_s)
    high = half + reach
    gap0, id0, gap1, id1, left = clip(
        xi + half_other * (m + e) - half,
        eta + half_other * (e - m),
        other,
        xi + half_other * (m - e) - half,
        eta + half_other * (e + m),
        select(other == 3.0, 0.0, other + 1.0),
        -high,
        high,
    )
    cr = select(flip, cos_b, cos_a)
    sr = select(flip, sin_b, sin_a)
    sign = select(flip, -1.0, 1.0)
    nx = sign * pick(face, sr, cr, -sr, -cr)
    ny = sign * pick(face, -cr, sr, cr, -sr)
    base = 8.0 * (face + select(flip, 5.0, 1.0))
    return nx, ny, gap0, id0 + base, gap1, id1 + base, left
