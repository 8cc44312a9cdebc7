"""RQ0: the body, validated by inflating it: as the author did, and so slowly that it stays near balance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from turgor.body import Body
from turgor.errors import InvalidInput
from turgor.experiments.rows import Inflated, QuasiStatic
from turgor.simulate import Simulator, replay
from turgor.task import Task, make_task

BODIES = ("small", "medium", "large")


# --- the author's protocol ----------------------------------------------------------------------------------------

GASES: dict[str, dict[str, Any]] = {
    "author": {},  # the amount of the published program, which is that of the preset
    "text": {"gas_amount": 0.1 / 0.0280134},  # [mol] in 0.1 kg of nitrogen, the most that the text prints
}
EVERY = 5  # [step] from row to row; the ramp's ends, 360 and 460, are among them


def author_protocol(bodies: Sequence[str] = BODIES) -> list[Inflated]:
    """Rows of the author's protocol on flat ground: no gas for 360 steps, then a ramp of 100 steps to p_max, held
    until step 1800; each body with either amount of gas, from which p_max = 1.25 nRT / (pi r^2) follows."""
    return [row for body in bodies for gas in GASES for row in _protocol(body, gas)]


def _protocol(body: str, gas: str) -> Iterator[Inflated]:
    task = make_task("inflation", body=body, **GASES[gas])
    rec = Simulator(task, threads=1).record(np.zeros(0))
    pressure = rec.pressure[:, 0].astype(np.float64) / task.pressure_range[0, 1]
    rho, height = rec.area_ratio[:, 0], np.ptp(rec.position[:, :, 1].astype(np.float64), axis=1)
    # not from step 0: before it no pressure has acted
    for t in range(EVERY, rec.steps + 1, EVERY):
        yield Inflated(
            body=body,
            gas=gas,
            time=float(rec.time[t]),
            pressure_ratio=float(pressure[t]),
            area_ratio=float(rho[t]),
            height=float(height[t]),
        )


# --- slowly -------------------------------------------------------------------------------------------------------

WINDOWS = 64  # rows of a body, from 0 to 3.2 lift-off pressures: 1.5 p_max of small, 3 p_max of large
WINDOWS_PER_LIFT_OFF = 20
# 15 s a row, 16 minutes in all. Twice as slow moves rho by at most 0.01 (median 0.002) above 1.2 lift-off pressures,
# 0.015 above 0.8, and 0.064 (median 0.004 to 0.015) while the body stands up, between 0.4 and 0.8.
WINDOW = 900  # [step]
SETTLING = 360  # [step] before the rise, as in the author's protocol


def quasi_static(bodies: Sequence[str] = BODIES) -> list[QuasiStatic]:
    """Rows of rho(p) on flat ground under gravity: means over windows of 15 s in which p rises by 1/20 of the
    lift-off pressure, 3.2 of them in 16 minutes.

    A mean, because bending is undamped and a body never comes quite to rest. When it stands up depends on how it had
    folded, because folds jam by friction: from 8 starts moved by about a centimetre, bodies passed rho = 0.5 at 0.48 to
    1.03 lift-off pressures (small), 0.48 to 0.68 (medium) and 0.48 (large); with a friction of 0.5 instead of 10, small
    and medium always at 0.48 and 0.53. From 1.5 on the curves of these starts differ by at most 0.007.
    """
    return [row for body in bodies for row in _slow_rise(body)]


def _slow_rise(name: str) -> Iterator[QuasiStatic]:
    task = make_task("flat", body=name, condition="passive")
    lift_off = lift_off_pressure(task.body, task.physics.gravity)
    edges = np.arange(WINDOWS + 1) * lift_off / WINDOWS_PER_LIFT_OFF
    for pressure, rho in slow_course(task, edges):
        yield QuasiStatic(
            body=name,
            pressure=pressure,
            lift_off=lift_off,
            pressure_max=float(task.pressure_range[0, 1]),
            area_ratio=rho,
            analytic=analytic_area_ratio(task.body, pressure),
        )


def slow_course(task: Task, edges: np.ndarray, window: int = WINDOW) -> Iterator[tuple[float, float]]:
    """Mean pressure [Pa] and mean area ratio [1] of each window in which the pressure goes steadily from one of
    `edges` [Pa] to the next, rising or falling, in `window` steps.

    Before the first, the task's body settles from its start under the first of `edges`.
    """
    position, velocity, _ = _piece(task, np.full(SETTLING, edges[0]), task.position, np.zeros_like(task.position))
    part = (np.arange(window) + 0.5) / window
    for start, end in pairwise(edges):
        # window by window: one recording of the whole course would take 0.8 GB
        course = start + (end - start) * part
        position, velocity, rho = _piece(task, course, position, velocity)
        yield float(course.mean()), rho


def _piece(
    task: Task, course: np.ndarray, position: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Position, velocity at the end, and the mean area ratio, of a body under the pressures `course` [Pa]."""
    rest = np.tile(task.body.rest_length, (len(course), 1))
    rec = replay(task.body, task.scene, rest, course, position, velocity, task.physics.gravity)
    return rec.position[-1], rec.velocity[-1], float(rec.area_ratio[1:, 0].mean())


# --- by hand ------------------------------------------------------------------------------------------------------


def lift_off_pressure(body: Body, gravity: float = 10.0) -> float:
    """n m g / (2 r) [Pa]: the pressure that, acting on the body's diameter, carries its weight; `gravity` in m/s^2.

    A collapsed body is wider than that, up to pi r, and only its upper half has to be raised: it can begin to stand
    up from 1/pi of this pressure on.
    """
    return float(body.mass.sum()) * gravity / (2 * body.radius)


def analytic_area_ratio(body: Body, pressure: float) -> float | None:
    """rho = area / (pi r^2) [1] of a ring in balance under `pressure` [Pa] without gravity; None where the gas
    outgrows the springs. Raises `InvalidInput` for a body that is not a ring of equal masses and springs."""
    n, r = body.mass_count, body.radius
    if body.spring_count != n or np.ptp(body.mass) or np.ptp(body.frequency):
        raise InvalidInput(
            "body: expected a ring of equal masses and springs", f"{n} masses, {body.spring_count} springs"
        )
    k = body.mass[0] / 2 * (2 * math.pi * body.frequency[0]) ** 2  # of a spring [N/m], on its pair's reduced mass
    # a mass is in balance where  p l cos(pi/n) = 2 k (l - L0) sin(pi/n),  with l = 2 r_in sin(pi/n), L0 = 2 r sin(pi/n)
    shrinking = 1 - pressure / math.tan(math.pi / n) / (2 * k)
    if shrinking <= 0:
        return None
    r_in = r / shrinking
    return float((r_in / r) ** 2 * math.sin(2 * math.pi / n) * n / (2 * math.pi))
