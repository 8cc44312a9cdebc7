"""The agent in Box2D v3, through the package `pyb2d3`: a second opinion, by another solver than the paper's.

Box2D v3 cuts a step into substeps. In each it looks anew at lengths and penetrations, solves joints and contacts once
as soft constraints, moves, and solves once more without pushing out (Catto, "Solver2D", 2024). Contacts are found once
a step.

The task's own are gravity, dt, the largest travel of a step, squares (side, angle, density, friction; they do not
turn), springs (rest length, frequency, damping ratio) and segments. Box2D v3's own is whatever has another counterpart
there, or none: substeps for `velocity_iterations` and `position_iterations`; contacts as springs of 30 Hz that push out
with at most 3 m/s for `slop`, `baumgarte` and `max_correction`; no `skin`, so that a square rests 1.5 cm lower than in
Box2D 2.3. Both take squares for touching that are less than 2 cm apart.

Segments are plain ones, which act on both sides as Box2D 2.3's edges do. Box2D v3's chains act on one side, as turgor's
segments do, but want 4 points or more in a row, and take away the bumps where two segments meet, which all other
engines here have. Ground pushes nothing out that lies wholly behind it.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.task import Task

pyb2d3: Any = import_module("pyb2d3")  # Any: nearly all of it is compiled, and says no types

SUBSTEPS = 4  # Box2D v3's own advice; each solves twice: as often as Box2D 2.3 with its 8 velocity iterations
MOST_SUBSTEPS = 1000
MOST_WORLDS = 128  # of Box2D v3, in a process, at a time
SHORTEST, LONGEST = 0.005, 1e5  # [m]: it drops segments that are no longer, and keeps the lengths of springs within
SCENE = 0  # user data of a segment; a square's is its index + 1


class Box2Dv3World:
    """One agent's body and scene in Box2D v3; see `turgor.fidelity.drive.World`. The world ends with `close`, or with
    the object."""

    def __init__(
        self,
        task: Task,
        position: np.ndarray,
        velocity: np.ndarray | None = None,
        *,
        substeps: int = SUBSTEPS,
        continuous: bool = False,
    ) -> None:
        """At `position` [m] with `velocity` [m/s], shape [mass, 2]; `substeps` of a step, and whether collision is
        `continuous`: fast squares are stopped where they first touch the scene.

        Raises `InvalidInput` for what Box2D v3 would change in silence, and for more than 128 worlds at a time.
        """
        _check_springs(task)
        if not isinstance(substeps, int) or not 1 <= substeps <= MOST_SUBSTEPS:
            raise InvalidInput(f"substeps: expected a whole number, 1 to {MOST_SUBSTEPS}", describe(substeps))
        self.dt, self.substeps = task.physics.dt, substeps
        self.world = _make_world(task, continuous)
        _add_scene(self.world, task)
        self.masses = _add_masses(self.world, task, position, velocity)
        self.springs = _add_springs(self.world, task, self.masses)
        self.rest_length = task.body.rest_length.astype(np.float32)  # [m], shape [spring], as the world has them
        self.touches = np.zeros(1 + task.body.mass_count, dtype=np.int64)  # of the scene, then of each mass
        self.together = pyb2d3.Bodies()  # all masses, to be read by one call
        for mass in self.masses:
            self.together.append(mass)
        self.numbers = np.zeros((task.body.mass_count, 2), dtype=np.float32)  # what is read comes in here

    def read(self, position: np.ndarray, velocity: np.ndarray, touch: np.ndarray) -> None:
        self._check_open()
        position[:] = self.together.get_positions(self.numbers)
        velocity[:] = self.together.get_linear_velocities(self.numbers)
        touch[:] = self.touches[1:] > 0

    def step(self, rest_length: np.ndarray, force: np.ndarray) -> None:
        self._check_open()
        self._set_lengths(rest_length)
        for mass, x, y in zip(self.masses, *force.T.tolist(), strict=True):
            mass.apply_force_to_center((x, y))
        self.world.step(self.dt, self.substeps)
        self._count_touches()

    def close(self) -> None:
        self.world.destroy()

    def _check_open(self) -> None:
        # the package does not look: to read or step a world that was destroyed ends the process
        if not self.world.is_valid():
            raise InvalidInput("Box2D v3: expected an open world", "one that was closed")

    def _set_lengths(self, rest_length: np.ndarray) -> None:
        # Box2D v3 forgets a spring's last impulse, its warm start, where a length is set, be it the same
        new = rest_length.astype(np.float32)
        for spring in np.flatnonzero(new != self.rest_length).tolist():
            self.springs[spring].length = float(new[spring])
        self.rest_length = new

    def _count_touches(self) -> None:
        """Adds what the step's events tell: what began to touch when it looked for contacts, and what no longer did."""
        events = self.world.get_contact_events()
        for change, changed in ((1, events.begin_events()), (-1, events.end_events())):
            for event in changed:
                self.touches[event.shape_a.user_data] += change
                self.touches[event.shape_b.user_data] += change


def _check_springs(task: Task) -> None:
    shortest, longest = task.body.shortest * task.body.rest_length, task.body.longest * task.body.rest_length
    if (shortest < SHORTEST).any() or (longest > LONGEST).any():
        expected = f"Box2D v3: expected springs that are commanded to {SHORTEST:g} to {LONGEST:g} m"
        raise InvalidInput(expected, f"{describe(shortest.min())} to {describe(longest.max())}")


def _make_world(task: Task, continuous: bool) -> Any:
    """An empty world with the task's gravity and largest speed."""
    physics = task.physics
    world = pyb2d3.World(gravity=(0.0, -physics.gravity), maximum_linear_speed=physics.max_travel / physics.dt)
    if not world.is_valid():
        raise InvalidInput(f"Box2D v3: expected at most {MOST_WORLDS} worlds at a time", "more; close some")
    world.sleeping_enabled, world.continuous_enabled = False, continuous
    return world


def _add_scene(world: Any, task: Task) -> None:
    """A segment that acts on both sides for each of the scene's."""
    scene = world.create_static_body()
    material = pyb2d3.surface_material(friction=task.scene.friction, restitution=0.0)
    shape = pyb2d3.shape_def(material=material, enable_contact_events=True, user_data=SCENE)
    for x1, y1, x2, y2 in task.scene.segments.tolist():
        segment = scene.create_segment_shape(shape, pyb2d3.segment((x1, y1), (x2, y2)))
        if not segment.is_valid:
            expected = f"Box2D v3: expected segments longer than {SHORTEST:g} m in float32"
            raise InvalidInput(expected, describe((x1, y1, x2, y2)))


def _add_masses(world: Any, task: Task, position: np.ndarray, velocity: np.ndarray | None) -> list[Any]:
    """The squares: turned by their angle, and never further."""
    body, masses = task.body, []
    moving = np.zeros_like(position) if velocity is None else velocity
    material = pyb2d3.surface_material(friction=body.friction, restitution=0.0)
    for i, (x, y, vx, vy) in enumerate(np.concatenate([position, moving], axis=1).tolist()):
        turned = pyb2d3.Rot(float(body.angle[i]))
        mass = world.create_dynamic_body(
            position=(x, y), linear_velocity=(vx, vy), rotation=turned, fixed_rotation=True
        )
        density, half = float(body.density[i]), float(body.side[i]) / 2
        shape = pyb2d3.shape_def(density=density, material=material, enable_contact_events=True, user_data=1 + i)
        mass.create_polygon_shape(shape, pyb2d3.box(half, half))
        masses.append(mass)
    return masses


def _add_springs(world: Any, task: Task, masses: list[Any]) -> list[Any]:
    """The springs; what one joins does not collide."""
    body, springs = task.body, []
    for s, (i, j) in enumerate(body.springs.tolist()):
        spring = world.create_distance_joint(
            body_a=masses[i],
            body_b=masses[j],
            length=float(body.rest_length[s]),
            enable_spring=True,
            hertz=float(body.frequency[s]),
            damping_ratio=float(body.damping_ratio[s]),
            collide_connected=False,
        )
        springs.append(spring)
    return springs
