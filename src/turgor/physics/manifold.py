"""Manifolds: where two shapes touch, as Box2D 2.3 finds it (b2EPCollider, b2CollidePolygons).

Squares never turn, so a manifold is a normal and the gaps of at most two points. Corner k of a square is
0 (-, -), 1 (+, -), 2 (+, +), 3 (-, +) in its own axes a and b; face f runs from corner f to f + 1, with the outward
normal -b, a, b, -a. Seen from a face (or a segment), xi is the way out and eta the way along it, counter-clockwise.

A point's id says what made it, so that its impulse can be found again in the next step:
8 * reference + corner, with the reference 0 for a segment, 1 + f for a face (of a pair: 1 + f of a, 5 + f of b),
and the corner 4 or 5 where the face's own first or second end cuts the other's edge.
"""

from turgor.physics.lanes import inlined, select

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
def square_on_segment(settings, half, cosine, sine, nx, ny, depth, q1x, q1y, q2x, q2y):
    """Contact of a square with a segment whose ends are seen from the square's centre at q1 and q2 [m]: whether it
    touches, and whether its nearest `face` is the reference, not the segment; the face and the segment's ends in the
    square's axes, for `segment_on_face`; the two points with the segment as the reference."""
    reach = settings.reach
    above = -(nx * q1x + ny * q1y)  # the centre's height over the segment's line
    na = nx * cosine + ny * sine
    nb = ny * cosine - nx * sine
    gap_segment = above - half * (abs(na) + abs(nb))

    # the segment in the square's own axes, and its distance from each face
    u1 = q1x * cosine + q1y * sine
    w1 = q1y * cosine - q1x * sine
    u2 = q2x * cosine + q2y * sine
    w2 = q2y * cosine - q2x * sine
    gap_face, face = largest(-max(w1, w2) - half, min(u1, u2) - half, min(w1, w2) - half, -max(u1, u2) - half)

    behind = above < 0.0
    over = (min(q1x, q2x) <= 0.0) & (max(q1x, q2x) >= 0.0)
    touches = (
        (gap_segment <= reach) & (above >= -depth) & ((~behind & (gap_face <= reach)) | (behind & over & (depth > 0.0)))
    )

    # the segment as the reference: the square's most antiparallel face, its corners over the segment's ends
    xi, other = largest(nb, -na, -nb, na)
    xi = -xi
    along = pick(other, na, nb, -na, -nb)
    centre = ny * q1x - nx * q1y
    length = nx * (q2y - q1y) - ny * (q2x - q1x)
    gap0 = above + half * (xi - along)
    gap1 = above + half * (xi + along)
    id0 = other
    id1 = select(other == 3.0, 0.0, other + 1.0)
    gap_a, id_a, gap_b, id_b, left = clip(
        gap0, centre - half * (along + xi), id0, gap1, centre - half * (along - xi), id1, 0.0, length
    )
    # what is behind is pushed out over all its width
    gap_a = select(behind, gap0, gap_a)
    gap_b = select(behind, gap1, gap_b)
    id_a = select(behind, id0, id_a)
    id_b = select(behind, id1, id_b)
    on_face = touches & ~behind & (gap_face > 0.98 * gap_segment + 0.001)
    touches = touches & (left | behind | on_face)
    return touches, on_face, face, u1, w1, u2, w2, gap_a, id_a, gap_b, id_b


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
def square_on_square(reach, half_a, half_b, cos_a, sin_a, cos_b, sin_b, turn_cos, turn_sin, dx, dy):
    """Contact of square b, whose centre stands at (dx, dy) from that of a:
    (touches, nx, ny, gap0, id0, gap1, id1), the normal from a to b."""
    lean = abs(turn_cos) + abs(turn_sin)
    au = dx * cos_a + dy * sin_a  # b's centre in a's axes
    aw = dy * cos_a - dx * sin_a
    bu = -(dx * cos_b + dy * sin_b)  # a's centre in b's axes
    bw = -(dy * cos_b - dx * sin_b)
    gap_a, face_a = largest(-aw, au, aw, -au)
    gap_b, face_b = largest(-bw, bu, bw, -bu)
    gap_a = gap_a - (half_a + half_b * lean)
    gap_b = gap_b - (half_b + half_a * lean)
    touches = (gap_a <= reach) & (gap_b <= reach)

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
    touches, gap0, id0, gap1, id1 = kept(reach, touches & left, gap0, id0 + base, gap1, id1 + base)
    return touches, nx, ny, gap0, id0, gap1, id1
