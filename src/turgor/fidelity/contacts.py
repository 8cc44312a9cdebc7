"""Contact cases whose answer is known: a square rests, slips, stops, meets a corner, slides over a seam."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np

from turgor.body import Body
from turgor.fidelity.drive import Script
from turgor.fidelity.golden import Case, replay_in
from turgor.scene import Scene

FRICTION = math.sqrt(10.0 * 0.2)  # [1], of a mass on the ground
GAP = 0.015  # [m], between a resting square and a segment: two skins of 0.01 m less the slop
SLOPES = (50.0, 60.0)  # [degrees], between which a square begins to slip
FINEST = 0.01  # [degrees]
CREEP = 0.005  # [m] in 3 s: it slides


class Contact(msgspec.Struct, frozen=True, kw_only=True):
    """What a contact case gives in one engine."""

    case: str
    unit: str
    theory: float | None  # None: there is none
    engine: str
    value: float


class Question(NamedTuple):
    """A contact case."""

    case: str
    unit: str
    theory: float | None


REST = Question("height of a resting square's centre", "m", 0.5 + GAP)
SLIP = Question("slope on which a square begins to slip", "degrees", math.degrees(math.atan(FRICTION)))
# v^2 / (2 mu g), less v h / 2: in the first step it is already slower
STOP = Question("distance in which a square at 8 m/s stops", "m", 8.0**2 / (2 * FRICTION * 10) - 8.0 / 120)
SEAM = Question("change of that distance by a seam on the way", "m", 0.0)
WALL = Question("distance of a square thrown into a corner from the wall", "m", 0.5 + GAP)
CORNER = Question("its height there", "m", 0.5 + GAP)
PEAK = Question("height of a square balanced on a peak", "m", None)
VALLEY = Question("height of a square at rest in a valley", "m", None)


def contact_rows(engine: str) -> list[Contact]:
    """Every contact case in `engine`."""
    x, y = thrown_into_corner(engine)
    found = {
        REST: settled(engine, polyline_scene([(-50, 0), (50, 0)]), (0, 1.2))[1],
        SLIP: slip_angle(engine),
        STOP: stopping_distance(engine),
        SEAM: stopping_distance(engine, seam=True) - stopping_distance(engine),
        WALL: -x,
        CORNER: y,
        PEAK: settled(engine, polyline_scene([(-10, -4), (0, 0), (10, -3)]), (0, 1.3))[1],
        VALLEY: settled(engine, polyline_scene([(-10, 3), (0, 0), (10, 4)]), (0.1, 1.3))[1],
    }
    return [Contact(case=q.case, unit=q.unit, theory=q.theory, engine=engine, value=v) for q, v in found.items()]


def polyline_scene(corners: list[tuple[float, float]]) -> Scene:
    """Ground along `corners` [m], from left to right, without walls."""
    return Scene([(*b, *a) for a, b in pairwise(corners)], 2.0)


def course(
    engine: str,
    scene: Scene,
    position: tuple[float, float],
    velocity: tuple[float, float] = (0.0, 0.0),
    angle: float = 0.0,
    steps: int = 180,
) -> np.ndarray:
    """Positions [m] of one square, shape [step + 1, 2]."""
    body = Body([position], angle)
    case = Case(
        file="",
        name="square",
        says="",
        body=body,
        scene=scene,
        two_sided=False,
        gravity=10.0,
        position=body.position,
        velocity=np.array([velocity], dtype=np.float64),
        script=Script(np.zeros((steps, 0)), None),
        frames=np.arange(steps + 1),
        expected=np.zeros(0),
        floor=None,
    )
    return replay_in(engine, case)[0][:, 0].astype(np.float64)


def settled(engine: str, scene: Scene, position: tuple[float, float]) -> tuple[float, float]:
    """Where a square that is let go at `position` is after 3 s [m]."""
    x, y = course(engine, scene, position)[-1]
    return float(x), float(y)


def slip_angle(engine: str) -> float:
    """The slope [degrees] from which on a square does not come to rest."""
    holds, slips = SLOPES
    while slips - holds > FINEST:
        middle = (holds + slips) / 2
        if slide(engine, middle) > CREEP:
            slips = middle
        else:
            holds = middle
    return (holds + slips) / 2


def slide(engine: str, slope: float) -> float:
    """How far a square slides on a `slope` [degrees] from second 1 to second 4 [m], started at rest and flush."""
    angle = math.radians(slope)
    along = np.array([math.cos(angle), math.sin(angle)])
    normal = np.array([-along[1], along[0]])
    scene = Scene([(*(50 * along), *(-50 * along))], 2.0)
    x, y = (0.5 + GAP) * normal
    path = course(engine, scene, (float(x), float(y)), angle=angle, steps=240)
    return float(np.linalg.norm(path[240] - path[60]))


def stopping_distance(engine: str, *, seam: bool = False) -> float:
    """How far a square slides that starts at 8 m/s on a plane [m]; with a `seam`, over where two segments meet."""
    corners = [(-50.0, 0.0), (0.0, 0.0), (50.0, 0.0)] if seam else [(-50.0, 0.0), (50.0, 0.0)]
    path = course(engine, polyline_scene(corners), (-1.2, 0.5 + GAP), (8.0, 0.0))
    return float(path[-1, 0] - path[0, 0])


def thrown_into_corner(engine: str) -> tuple[float, float]:
    """Where a square rests that is thrown at 6 m/s into the corner of ground and wall at (0, 0) [m]."""
    scene = Scene([(0.0, 0.0, -20.0, 0.0), (0.0, 10.0, 0.0, 0.0)], [2.0, 0.0])
    x, y = course(engine, scene, (-2.0, 1.0), (6.0, 0.0))[-1]
    return float(x), float(y)
