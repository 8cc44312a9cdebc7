"""The agent in Box2D 2.3, the paper's engine, through pybox2d (package `box2d`).

Everything comes from the task: squares that do not turn, an isolated edge for every segment, a soft distance joint for
every spring. Box2D's own constants stand for slop, skin, Baumgarte's factor and the limits of a correction and a step;
they are the defaults of `Physics`, and a task with others is refused. Edges act on both sides, where turgor's segments
act on one.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from turgor.errors import InvalidInput, describe
from turgor.task import Physics, Task

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # turned into an error, its DeprecationWarning would crash the interpreter
    import Box2D

CONSTANTS = ("slop", "baumgarte", "max_correction", "max_travel", "skin")  # of `Physics`, compiled into Box2D


class Box2DWorld:
    """One agent's body and scene in Box2D 2.3; see `turgor.fidelity.drive.World`."""

    continuous = False  # collision: fast squares are stopped where they first touch the scene
    substeps = 1  # of a step, under the same forces and lengths

    def __init__(self, task: Task, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        check_task(task)
        self.physics = task.physics
        self.touches = _Touches(task.body.mass_count)
        self.world = Box2D.b2World(
            gravity=(0, -task.physics.gravity), doSleep=False, contactListener=self.touches, continuousPhysics=False
        )
        self.world.continuousPhysics, self.world.warmStarting = self.continuous, True
        self.world.autoClearForces = False
        _add_scene(self.world, task)
        self.masses = _add_masses(self.world, task, position, velocity)
        self.springs = _add_springs(self.world, task, self.masses)
        # live views: they read Box2D's own numbers, and live as long as the world
        self.positions = [mass.position for mass in self.masses]
        self.velocities = [mass.linearVelocity for mass in self.masses]

    def read(self, position: np.ndarray, velocity: np.ndarray, touch: np.ndarray) -> None:
        position[:] = [(p.x, p.y) for p in self.positions]
        velocity[:] = [(v.x, v.y) for v in self.velocities]
        touch[:] = self.touches.count

    def step(self, rest_length: np.ndarray, force: np.ndarray) -> None:
        for spring, length in zip(self.springs, rest_length.tolist(), strict=True):
            spring.length = length
        for mass, push in zip(self.masses, force.tolist(), strict=True):
            mass.ApplyForceToCenter(push, True)
        for _ in range(self.substeps):
            self.world.Step(
                self.physics.dt / self.substeps, self.physics.velocity_iterations, self.physics.position_iterations
            )
        self.world.ClearForces()

    def close(self) -> None:
        self.positions, self.velocities = [], []
        self.masses, self.springs = [], []
        del self.world


class ContinuousBox2DWorld(Box2DWorld):
    """The same with continuous collision on: Box2D's default, and the paper's program."""

    continuous = True


class FineBox2DWorld(Box2DWorld):
    """The same in steps of a quarter of the length, while controller and gas keep theirs: what hangs on the step."""

    substeps = 4


class _Touches(Box2D.b2ContactListener):
    """How many things each mass touches; Box2D tells what changes, at the start of its step."""

    def __init__(self, mass_count: int) -> None:
        super().__init__()
        self.count = [0] * mass_count

    def BeginContact(self, contact: Any) -> None:
        self._add(contact, 1)

    def EndContact(self, contact: Any) -> None:
        self._add(contact, -1)

    def _add(self, contact: Any, change: int) -> None:
        for fixture in (contact.fixtureA, contact.fixtureB):
            mass = fixture.body.userData
            if mass is not None:  # the scene
                self.count[mass] += change


def check_task(task: Task) -> None:
    """Raises `InvalidInput` for a task with other constants than Box2D's."""
    for name in CONSTANTS:
        value, default = getattr(task.physics, name), getattr(Physics(), name)
        if value != default:
            raise InvalidInput(f"{name}: expected {default:g}, which cannot be changed in Box2D", describe(value))


def _add_scene(world: Any, task: Task) -> None:
    scene = world.CreateStaticBody()
    for x1, y1, x2, y2 in task.scene.segments.tolist():
        edge = Box2D.b2EdgeShape(vertices=[(x1, y1), (x2, y2)])
        scene.CreateFixture(shape=edge, friction=task.scene.friction, restitution=0)


def _add_masses(world: Any, task: Task, position: np.ndarray, velocity: np.ndarray | None) -> list[Any]:
    """The squares: turned by their angle, and never further."""
    body, masses = task.body, []
    velocity = np.zeros_like(position) if velocity is None else velocity
    for i, (where, how_fast) in enumerate(zip(position.tolist(), velocity.tolist(), strict=True)):
        angle, half, density = float(body.angle[i]), float(body.side[i]) / 2, float(body.density[i])
        mass = world.CreateDynamicBody(
            position=where, linearVelocity=how_fast, angle=angle, fixedRotation=True, userData=i
        )
        square = Box2D.b2PolygonShape(box=(half, half))
        mass.CreateFixture(shape=square, density=density, friction=body.friction, restitution=0)
        masses.append(mass)
    return masses


def _add_springs(world: Any, task: Task, masses: list[Any]) -> list[Any]:
    """The springs; what one joins does not collide."""
    body, springs = task.body, []
    for s, (i, j) in enumerate(body.springs.tolist()):
        spring = world.CreateDistanceJoint(
            bodyA=masses[i],
            bodyB=masses[j],
            anchorA=masses[i].worldCenter,
            anchorB=masses[j].worldCenter,
            length=float(body.rest_length[s]),
            frequencyHz=float(body.frequency[s]),
            dampingRatio=float(body.damping_ratio[s]),
            collideConnected=False,
        )
        springs.append(spring)
    return springs
