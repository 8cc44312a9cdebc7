"""Tasks: body + scene + start + condition + fitness + end; everything that one evaluation needs.

A `Task` is frozen and serialisable and has an identity. `make_task` builds the paper's tasks and every variant
of them; a task of your own is a `Task(...)` with a body, a scene, a start, a fitness and an end of your choice.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from turgor import body as bodies
from turgor import scene as scenes
from turgor.arrays import as_numbers
from turgor.body import GAS_CONSTANT, Body
from turgor.control import Condition, Controller, Linear, Sensing, check_body, make_controller, parameter_count
from turgor.errors import InvalidInput, describe, one_of
from turgor.scene import Scene
from turgor.variants import (
    VARIANT_GROUPS,
    Cage,
    Elements,
    Fitness,
    General,
    Hills,
    Inflation,
    Physics,
    variant_names,
)

LARGEST_PRESSURE_UNIT = 1e15  # [Pa]
REST_GAP = 0.015  # [m] between the lowest corner and the ground at a resting start


class Leave(msgspec.Struct, frozen=True, tag="leave"):
    """End: solved once every square is wholly outside |x| <= `half_width` [m]."""

    half_width: float

    def __post_init__(self) -> None:
        if not 0 <= self.half_width <= scenes.LARGEST_COORDINATE:
            expected = f"half_width: expected 0 m or more, up to {scenes.LARGEST_COORDINATE:g} m"
            raise InvalidInput(expected, describe(self.half_width))


class Task(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One evaluation, exactly. Start velocities are zero.

    `fitness`: "progress" ((x_com(end) - x_com(0)) / duration [m/s]), "distance" (its absolute value),
    "elapsed" (distance / time until the end [m/s]), "area" (final area / (pi r^2) of the first chamber), or a function
    of a `Rollout` that returns [agent]. `end`: None, `Leave(...)`, or a function of the positions
    [agent, mass, 2] that returns [agent] of bool, asked after every step.
    """

    name: str
    body: Body
    scene: Scene
    position: Any  # [m], shape [mass, 2], the start
    condition: Condition = "pressure"
    controller: Controller = Linear()
    physics: Physics = Physics()
    sensing: Sensing = Sensing()
    pressure_unit: float | None = None  # [Pa] of pressure change per unit of output; None: p_max / 1000
    steps: int = 1800
    fitness: Fitness | Callable[..., Any] = "progress"
    end: Leave | Callable[..., Any] | None = None
    pressure: Any = None  # [Pa], shape [step, chamber]: given, with springs at rest, instead of a controller

    def __post_init__(self) -> None:
        put = msgspec.structs.force_setattr
        put(self, "position", start_position(self.position, self.body))
        if self.condition not in get_args(Condition):
            raise one_of("condition", get_args(Condition), self.condition)
        if not isinstance(self.controller, Controller):
            raise InvalidInput("controller: expected a Linear, MLP, Sinusoid or Distributed", describe(self.controller))
        check_body(self.body, self.condition, self.controller)
        if not isinstance(self.steps, int) or not 1 <= self.steps <= 10_000_000:
            raise InvalidInput("steps: expected a whole number, 1 to 10000000", describe(self.steps))
        if isinstance(self.fitness, str) and self.fitness not in get_args(Fitness):
            raise one_of("fitness", get_args(Fitness), self.fitness)
        if self.pressure_unit is not None and not abs(self.pressure_unit) <= LARGEST_PRESSURE_UNIT:
            expected = f"pressure_unit: expected a number of Pa within {LARGEST_PRESSURE_UNIT:g}"
            raise InvalidInput(expected, describe(self.pressure_unit))
        if self.pressure is not None:
            put(self, "pressure", given_rows("pressure", self.pressure, self.steps, self.body.chamber_count))
        if (self.condition == "pressure" or self.fitness == "area") and not self.body.chamber_count:
            raise InvalidInput('condition "pressure" and fitness "area": expected a body with a chamber', "none")

    def __repr__(self) -> str:
        return (
            f"Task({self.name!r}, body of {self.body.mass_count} masses, condition {self.condition!r}, "
            f"{self.parameter_count} parameters, {self.duration:.1f} s)"
        )

    @property
    def parameter_count(self) -> int:
        """Length of a controller's theta."""
        return parameter_count(self.body, self.condition, self.controller)

    @property
    def duration(self) -> float:
        """Length of a whole rollout [s]."""
        return self.steps * self.physics.dt

    @property
    def pressure_range(self) -> np.ndarray:
        """p_min and p_max of each chamber [Pa], shape [chamber, 2]."""
        return np.array([[self.physics.pressure_min * p, p] for p in self._pressure_max()]).reshape(-1, 2)

    @property
    def pressure_start(self) -> np.ndarray:
        """Pressure before the first step [Pa], shape [chamber]: nRT / area of the body at rest, within
        [p_min, p_max] where pressure is controlled."""
        area = np.maximum(self.body.area(self.body.position), self.area_floor)
        pressure = self.gas_energy / area
        if self.condition == "pressure":
            pressure = np.clip(pressure, *self.pressure_range.T)
        return pressure

    @property
    def gas_energy(self) -> np.ndarray:
        """nRT of each chamber [J], shape [chamber]."""
        return self.body.gas_amount * GAS_CONSTANT * self.physics.temperature

    @property
    def area_reference(self) -> np.ndarray:
        """pi r^2 of each chamber [m^2], shape [chamber]."""
        radii = [self.body.chamber_radius(c) for c in range(self.body.chamber_count)]
        return math.pi * np.array(radii) ** 2

    @property
    def area_floor(self) -> np.ndarray:
        """Smallest area that the gas law takes [m^2], shape [chamber]."""
        return self.physics.area_min * self.area_reference

    @property
    def pressure_step(self) -> np.ndarray:
        """Pressure change per step of a controller's output of 1 [Pa], shape [chamber]."""
        if self.pressure_unit is None:
            return self._pressure_max() / 1000
        return np.full(self.body.chamber_count, self.pressure_unit)

    @property
    def identity(self) -> str:
        """Hash of everything that an evaluation depends on, 16 hexadecimal digits."""
        return hashlib.sha256(task_to_json(self)).hexdigest()[:16]

    def _pressure_max(self) -> np.ndarray:
        return self.physics.pressure_max * self.gas_energy / self.area_reference


def start_position(position: Any, body: Body) -> np.ndarray:
    """`position` as read-only float64 [mass, 2]; raises `InvalidInput` for another shape or NaN."""
    array = as_numbers("position", position) + 0.0  # + 0.0: a copy, and no negative zeros
    if array.shape != (body.mass_count, 2) or not (np.abs(array) <= scenes.LARGEST_COORDINATE).all():
        raise InvalidInput(
            f"position: expected finite numbers of shape [{body.mass_count}, 2]",
            f"shape {list(array.shape)} or too large",
        )
    array.flags.writeable = False
    return array


def given_rows(name: str, values: Any, steps: int, count: int) -> np.ndarray:
    """`values` [step] or [step, count] as read-only float64 [step, count]; raises `InvalidInput` otherwise."""
    array = np.array(as_numbers(name, values))
    array = np.repeat(array[:, None], count, axis=1) if array.ndim == 1 else array
    if array.shape != (steps, count) or not np.isfinite(array).all():
        raise InvalidInput(f"{name}: expected finite numbers of shape [{steps}, {count}]", f"shape {list(array.shape)}")
    array.flags.writeable = False
    return array


# --- the paper's tasks -------------------------------------------------------------------------------------------

HILL_HEIGHT = {"small": 1.0, "medium": 2.0, "large": 3.0}  # [m], standard deviation


def make_task(
    name: str = "hilly",
    *,
    body: str | Body = "small",
    condition: Condition | None = None,
    controller: str | Controller = "linear",
    seed: int = 0,
    **variants: Any,
) -> Task:
    """A `Task` of the paper: "hilly", "flat", "escape", "escape-authors" or "inflation".

    `body` is "small", "medium", "large" or a `Body`; `condition` is "pressure" (springs and pressure are
    controlled, the default), "springs" or "passive"; `controller` is "linear" (the paper's), "mlp", "sinusoid",
    "distributed" or one of `turgor.control`, as in `Distributed(hidden=4)`; `seed` draws the terrain. `variants`
    override any number of the `paper` preset by its name (`gravity=9.81`, `window=15`, `observation="unit"`, ...;
    `variant_names()` lists them). Raises `InvalidInput` for an unknown name or an impossible number.
    """
    if name not in TASKS:
        raise one_of("task", TASKS, name)
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise InvalidInput("seed: expected a whole number, 0 or more", describe(seed))
    groups = _grouped(variants)
    if condition is None:
        condition = "passive" if name == "inflation" else "pressure"
    size = body if isinstance(body, str) else "custom"
    body = _make_body(body, groups[Elements])
    task = TASKS[name](name, size, body, condition, seed, groups)
    return msgspec.structs.replace(task, controller=_given_controller(controller))


def _given_controller(value: Any) -> Controller:
    """`value` as a controller: its name, itself, or what its JSON says."""
    if isinstance(value, str):
        return make_controller(value)
    try:
        return msgspec.convert(value, Controller)
    except msgspec.ValidationError as error:
        raise InvalidInput(f"controller: {error}") from None


def _grouped(variants: Mapping[str, Any]) -> dict[type, Any]:
    known = variant_names()
    for name in variants:
        if name not in known:
            raise one_of("variant", sorted(known), name)
    groups = {}
    for group in VARIANT_GROUPS:
        hints = _hints(group)
        chosen = {name: _checked(name, value, hints[name]) for name, value in variants.items() if known[name] is group}
        groups[group] = group(**chosen)
    return groups


_hints = cache(get_type_hints)


def _checked(name: str, value: Any, hint: Any) -> Any:
    """`value` as the type that a variant has; raises `InvalidInput` for one that is not."""
    try:
        return msgspec.convert(value, hint)
    except msgspec.ValidationError:
        literal = next((h for h in (hint, *get_args(hint)) if get_origin(h) is Literal), None)
        if literal is not None:
            raise one_of(name, get_args(literal), value) from None
        raise InvalidInput(
            f"{name}: expected a {'whole ' if int in (hint, *get_args(hint)) else ''}number", repr(value)
        ) from None


def _make_body(body: str | Body, elements: Elements) -> Body:
    changed = {k: v for k, v in msgspec.structs.asdict(elements).items() if v != getattr(Elements(), k)}
    if isinstance(body, Body):
        if changed:
            raise InvalidInput(f"{', '.join(changed)}: expected a named body to change; set them in your own Body")
        return body
    if body not in bodies.SIZES:
        raise one_of("body", bodies.SIZES, body)
    return bodies.ring(**{**bodies.SIZES[body], **changed}) if changed else getattr(bodies, body.upper())


def resting(body: Body, x: float = 0.0) -> np.ndarray:
    """Start [m], shape [mass, 2]: the body at rest on y = 0, its lowest square 0.015 m above touching."""
    return body.position + np.array([x, REST_GAP - body.lowest_corner()])


def _common(name: str, body: Body, condition: Condition, groups: dict[type, Any], fitness: Fitness) -> dict[str, Any]:
    general = groups[General]
    return {
        "name": name,
        "body": body,
        "condition": condition,
        "physics": groups[Physics],
        "sensing": groups[Sensing],
        "pressure_unit": general.pressure_unit,
        "steps": general.steps,
        "fitness": general.fitness or fitness,
    }


def _hilly(name: str, size: str, body: Body, condition: Condition, seed: int, groups: dict[type, Any]) -> Task:
    numbers, r = groups[Hills], body.radius
    height = numbers.hill_height
    scene = scenes.hills(
        seed,
        height=HILL_HEIGHT.get(size, r / 5) if height is None else height,
        step=numbers.hill_step,
        step_spread=numbers.hill_step_spread,
        extent=numbers.hill_extent,
        friction=groups[General].ground_friction,
    )
    start = body.position + np.array([0.0, r + 1 + scenes.highest_ground(scene, -r - 1, r + 1)])
    return Task(scene=scene, position=start, **_common(name, body, condition, groups, "progress"))


def _flat(name: str, size: str, body: Body, condition: Condition, seed: int, groups: dict[type, Any]) -> Task:
    scene = scenes.flat(friction=groups[General].ground_friction)
    return Task(scene=scene, position=resting(body), **_common(name, body, condition, groups, "progress"))


def _escape(name: str, size: str, body: Body, condition: Condition, seed: int, groups: dict[type, Any]) -> Task:
    numbers, r = groups[Cage], body.radius
    authors = name == "escape-authors"

    def given(value: float | None, default: float) -> float:
        return default if value is None else value

    width = given(numbers.cage_width, 3 * r)
    roof = given(numbers.cage_roof, 3 * r if authors else 2 * r + 1)
    scene = scenes.cage(
        width=width,
        roof=roof,
        aperture=given(numbers.cage_aperture, r if authors else roof / 3),
        wall=numbers.cage_wall,
        friction=groups[General].ground_friction,
    )
    end = Leave(half_width=width / 2 + numbers.cage_wall)
    return Task(scene=scene, position=resting(body), end=end, **_common(name, body, condition, groups, "distance"))


def _inflation(name: str, size: str, body: Body, condition: Condition, seed: int, groups: dict[type, Any]) -> Task:
    if condition != "passive":
        raise InvalidInput('inflation: expected condition "passive" (its pressure is given, not controlled)', condition)
    scene = scenes.flat(friction=groups[General].ground_friction)
    task = Task(scene=scene, position=resting(body), **_common(name, body, condition, groups, "area"))
    numbers, step = groups[Inflation], np.arange(1, task.steps + 1)
    share = np.clip((step - numbers.rest_steps) / max(numbers.ramp_steps, 1), 0, 1)
    return msgspec.structs.replace(task, pressure=share * task.pressure_range[0, 1])


TASKS: dict[str, Callable[..., Task]] = {
    "hilly": _hilly,
    "flat": _flat,
    "escape": _escape,
    "escape-authors": _escape,
    "inflation": _inflation,
}


# --- writing and reading ------------------------------------------------------------------------------------------


def task_to_json(task: Task) -> bytes:
    """`task` as JSON. Functions (own fitness, own end) are written by name alone, a linear controller not at all: so
    a task has the identity that it had before there were others."""
    fields = msgspec.structs.asdict(task)
    if task.controller == Linear():
        del fields["controller"]
    return msgspec.json.encode(fields, enc_hook=_encode)


def task_from_json(data: bytes | Mapping[str, Any]) -> Task:
    """The `Task` of `task_to_json`. A fitness or end that is a function of the user's own cannot be read back:
    raises `InvalidInput` and asks for the task itself."""
    try:
        raw = msgspec.json.decode(data) if isinstance(data, bytes) else dict(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidInput("task: expected JSON", describe(error)) from None
    if not isinstance(raw, dict):
        raise InvalidInput("task: expected a JSON object", describe(raw))
    for name in ("fitness", "end"):
        if isinstance(raw.get(name), str) and raw[name].startswith("function "):
            raise InvalidInput(f"{name}: expected the task to be passed, because its own {raw[name]} is not stored")
    try:
        return msgspec.convert(raw, TaskFields).task()
    except msgspec.ValidationError as error:
        raise InvalidInput(f"task: {error}") from None


class TaskFields(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """A stored `Task`: its fields with functions left out, so that reading never runs anything."""

    name: str
    body: dict[str, Any]
    scene: dict[str, Any]
    position: list[list[float]]
    condition: Condition
    physics: Physics
    sensing: Sensing
    pressure_unit: float | None
    steps: int
    fitness: Fitness
    end: Leave | None
    pressure: list[list[float]] | None
    controller: Controller = Linear()

    def task(self) -> Task:
        fields = msgspec.structs.asdict(self)
        try:
            fields["body"], fields["scene"] = Body(**self.body), Scene(**self.scene)
        except TypeError as error:
            raise InvalidInput(f"task: {error}") from None
        return Task(**fields)


def _encode(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.number):
        return value.item()
    if inspect.isroutine(value) or callable(value):
        return f"function {getattr(value, '__module__', '?')}.{getattr(value, '__qualname__', type(value).__name__)}"
    raise NotImplementedError(type(value))
