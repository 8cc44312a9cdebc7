"""The contact geometry of the reference: which squares and segments may touch, and where they do.

As in Box2D 2.3: a separating face is sought, the face against it clipped, and what the skins reach kept.
"""

from __future__ import annotations

import functools
from typing import Any

import msgspec
import numpy as np
from numpy.typing import DTypeLike

from turgor.task import Task

RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 0.98, 0.001  # [1], [m]: to prefer a second reference face

Point = tuple[int, Any]  # feature id, separation [m] of the bare shapes
Manifold = tuple[np.ndarray, list[Point]]  # normal from a to b, its points in the solver's order

# A feature id is 8 reference + corner. Reference: 0 the segment, 1 + f face f of the square; between squares
# 1 + f face f of a, 5 + f face f of b. Corner: the vertex 0..3 of the incident square, or the end 0, 1 of the
# incident segment; 4 and 5 for a point cut off at the first and second end of the reference face.


class Geometry(msgspec.Struct, frozen=True):
    """What can touch in a task, as arrays in one floating-point type."""

    face_normal: Any  # [1], shape [mass, 4, 2]: -b, a, b, -a of the square's axes a and b
    vertex: Any  # [m], shape [mass, 4, 2], relative to the centre; face f goes from vertex f to f + 1
    reach: Any  # [m], shape [mass], from the centre to a vertex
    bonded: Any  # bool, shape [mass, mass]: never collide
    ends: Any  # [m], shape [segment, 2, 2]
    normal: Any  # [1], shape [segment, 2], towards the free side


@functools.lru_cache(maxsize=64)
def geometry(task: Task, dtype: DTypeLike) -> Geometry:
    """The shapes of `task`, in `dtype`."""
    body, scene = task.body, task.scene
    a = np.stack([np.cos(body.angle), np.sin(body.angle)], axis=1)
    b = np.stack([-a[:, 1], a[:, 0]], axis=1)
    half = body.side[:, None] / 2
    i, j = body.springs.T
    bonded = np.eye(body.mass_count, dtype=bool)
    bonded[i, j] = bonded[j, i] = True
    return Geometry(
        face_normal=np.stack([-b, a, b, -a], axis=1).astype(dtype),
        vertex=(half[:, None] * np.stack([-a - b, a - b, a + b, b - a], axis=1)).astype(dtype),
        reach=(half[:, 0] * np.sqrt(2)).astype(dtype),
        bonded=bonded,
        ends=scene.segments.reshape(-1, 2, 2).astype(dtype),
        normal=scene.normal.astype(dtype),
    )


# --- candidates ---------------------------------------------------------------------------------------------


def near_segments(x: np.ndarray, task: Task, g: Geometry, skin: float) -> list[tuple[int, int]]:
    """Pairs of mass and segment that may touch, in the solver's order: a cheap test before the exact one."""
    low, high = g.ends.min(axis=1), g.ends.max(axis=1)
    reach = g.reach[:, None] + np.sqrt(2) * skin
    behind = -np.einsum("sk,msk->ms", g.normal, x[:, None] - g.ends[:, 0])
    below = np.where(behind > 0, np.inf, reach)  # the depth limits how far, along the normal
    near = (behind >= -reach) & (behind <= task.scene.depth)
    for k, margin in ((0, reach), (1, below)):
        near &= (x[:, None, k] >= low[:, k] - margin) & (x[:, None, k] <= high[:, k] + margin)
    last = near.shape[1] - 1
    return [(int(m), int(last - s)) for m, s in np.argwhere(near[:, ::-1])]


def near_pairs(x: np.ndarray, g: Geometry, skin: float) -> list[tuple[int, int]]:
    """Pairs of masses a < b that may touch, by b - a, then a: the engine's order. Box2D's hangs on how old contacts
    are; what controllers are worth does not show which one is taken. The two ends of a spring never touch."""
    # closer than the skin along every face's normal: corners can be further apart
    apart = np.linalg.norm(x[:, None] - x, axis=-1) > g.reach[:, None] + g.reach + np.sqrt(2) * skin
    pairs = [(int(a), int(b)) for a, b in np.argwhere(np.triu(~apart & ~g.bonded))]
    return sorted(pairs, key=lambda pair: (pair[1] - pair[0], pair[0]))


# --- manifolds ----------------------------------------------------------------------------------------------


def square_segment(
    x: np.ndarray, g: Geometry, mass: int, ends: np.ndarray, normal: np.ndarray, depth: float, skin: float
) -> Manifold | None:
    """The contact of a square at `x` with a segment, on the segment's free side."""
    vertex, face = x + g.vertex[mass], g.face_normal[mass]
    behind = -(normal @ (x - ends[0]))
    if behind > 0:  # ground pushes out what lies within its depth; everything else ignores what is behind it
        inside = ends[:, 0].min() <= x[0] <= ends[:, 0].max()
        if not (inside and behind <= depth):
            return None
        points = [(k, vertex[k]) for k in incident(face, normal)]
        return keep(normal, normal, ends[0], points, skin)
    # s_E = min over vertices N . (v - p1);  s_i = min over both ends of n_i . (p - v_i)
    edge_separation = (vertex @ normal).min() - normal @ ends[0]
    separation = (face @ ends.T).min(axis=1) - (face * vertex).sum(axis=1)
    best = int(separation.argmax())
    if max(edge_separation, separation[best]) > skin:
        return None
    if separation[best] > RELATIVE_TOLERANCE * edge_separation + ABSOLUTE_TOLERANCE:
        r = 8 * (1 + best)
        points = [(r, ends[0]), (r + 1, ends[1])]
        reference, outward = vertex[[best, (best + 1) % 4]], face[best]
        return keep(-outward, outward, reference[0], clip(points, reference, 0.0, r), skin)
    points = [(k, vertex[k]) for k in incident(face, normal)]
    return keep(normal, normal, ends[0], clip(points, ends, 0.0, 0), skin)


def square_square(x: np.ndarray, g: Geometry, a: int, b: int, skin: float) -> Manifold | None:
    """The contact of two squares; its reference face is a's unless one of b's separates them better."""
    vertex, face = x[[a, b], None] + g.vertex[[a, b]], g.face_normal[[a, b]]
    separation = [face_separation(vertex[s], face[s], vertex[1 - s]) for s in (0, 1)]
    best = [int(s.argmax()) for s in separation]
    most = [s.max() for s in separation]
    if max(most) > skin:
        return None
    own = 1 if most[1] > RELATIVE_TOLERANCE * most[0] + ABSOLUTE_TOLERANCE else 0
    f, other = best[own], 1 - own
    reference, outward = vertex[own][[f, (f + 1) % 4]], face[own][f]
    r = 8 * (1 + 4 * own + f)
    points = [(r + k, vertex[other][k]) for k in incident(face[other], outward)]
    normal = -outward if own else outward
    return keep(normal, outward, reference[0], clip(points, reference, skin, r), skin)


def face_separation(vertex: np.ndarray, face: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Separation [m] of each of a square's faces from the `other` square's deepest vertex, shape [4]."""
    return (face @ other.T).min(axis=1) - (face * vertex).sum(axis=1)


def incident(face: np.ndarray, normal: np.ndarray) -> tuple[int, int]:
    """The two vertices of the face that looks most against `normal`."""
    k = int((face @ normal).argmin())
    return k, (k + 1) % 4


def clip(points: list, reference: np.ndarray, margin: float, r: int) -> list:
    """Two (id, position) `points` cut to what lies between the ends of the face `reference`; none if outside.

    A cut point comes last, as in Box2D: the velocity solver takes the first point.
    """
    along = reference[1] - reference[0]
    along = along / np.sqrt(along @ along)
    for corner, outward, end in ((4, -along, reference[0]), (5, along, reference[1])):
        if len(points) < 2:
            return []
        (_, p), (_, q) = points
        s, t = outward @ (p - end) - margin, outward @ (q - end) - margin
        points = [point for point, beyond in zip(points, (s, t), strict=True) if beyond <= 0]
        if s * t < 0:
            points.append((r + corner, p + s / (s - t) * (q - p)))
    return points if len(points) == 2 else []


def keep(normal: np.ndarray, outward: np.ndarray, origin: np.ndarray, points: list, skin: float) -> Manifold | None:
    """The manifold of those `points` that the skins reach from the plane at `origin` that looks `outward`."""
    kept = [(id, outward @ (p - origin)) for id, p in points]
    kept = [(id, s) for id, s in kept if s <= skin]
    return (normal, kept) if kept else None
