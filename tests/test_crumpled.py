"""Crumpled bodies, whose masses lie on each other, against real Box2D 2.3: one step from the same state.

A fresh Box2D world remembers no impulses and no age of its contacts, so that the order in which it solves them is known
from how it was made. In that order the reference has to do what Box2D does, to float rounding: all that is left to
differ in a trajectory is the order, which in Box2D hangs on the past (docs/crosscheck.md).
"""

from __future__ import annotations

import copy

import msgspec
import numpy as np
import pytest

from turgor.physics import reference
from turgor.physics.reference import WORLD, Contact, State
from turgor.task import Task, make_task

pytest.importorskip("Box2D", reason="box2d is not installed")

from turgor.fidelity.box2d import Box2DWorld
from turgor.fidelity.drive import Trace, new_trace, run

FROM, EVERY = 300, 20  # the first step looked at, and the next ones
TOLERANCE = 1e-4  # [m/s], some roundings of float32; a contact out of its turn makes 1e-2 to 1


def flight(task: Task, seed: int) -> Trace:
    """What a random controller does in Box2D."""
    theta, trace = np.random.default_rng(seed).uniform(-1, 1, (1, task.parameter_count)), new_trace()
    run(Box2DWorld, task, theta, task.position[None], trace=trace)
    return trace


def island(contacts: list[Contact], task: Task) -> tuple[list[Contact], list[int]]:
    """Contacts and springs in the order of a fresh Box2D world: depth first from the last mass over each mass's
    contacts, newest first, then its springs. Contacts are made with the scene first, then in the order of the pairs."""
    masses, springs = task.body.mass_count, task.body.springs.tolist()
    segments = len(task.scene.segments) // 2  # of a scene whose second half are the backs of the first
    made = {id(c): (0, c.key[2] % segments, c.b) if c.a == WORLD else (1, c.a, c.b) for c in contacts}
    newest = sorted(contacts, key=lambda c: made[id(c)], reverse=True)
    found: list[Contact] = []
    pulled: list[int] = []
    seen, stack = {masses - 1}, [masses - 1]
    while stack:
        mass = stack.pop()
        mine = [c for c in newest if mass in (c.a, c.b) and not any(c is other for other in found)]
        found += mine
        joined = [s for s in reversed(range(len(springs))) if mass in springs[s] and s not in pulled]
        pulled += joined
        ways = [(c.a, c.b) for c in mine if c.a != WORLD] + [springs[s] for s in joined]
        for a, b in ways:
            other = b if a == mass else a
            if other not in seen:
                seen.add(other)
                stack.append(other)
    return found, pulled


def state_of(trace: Trace, t: int, task: Task) -> State:
    """The state after step t with what acts in the next one, and without impulses to start from."""
    state = reference.start(task, trace.position[t], trace.velocity[t])
    state.rest_length[:], state.pressure[:] = trace.rest_length[t + 1], trace.pressure[t + 1]
    return state


def one_step(task: Task, state: State, contacts: list[Contact]) -> np.ndarray:
    """Velocity [m/s], shape [mass, 2], after a step that solves `contacts` in their order."""
    after, contacts = copy.deepcopy(state), copy.deepcopy(contacts)
    reference.solve(after, task, reference.pressure_force(state, task), contacts)
    return after.velocity


def one_step_in_box2d(task: Task, state: State) -> np.ndarray:
    """The same in a fresh world."""
    world = Box2DWorld(task, state.position, state.velocity)
    world.step(state.rest_length, reference.pressure_force(state, task))
    velocity = np.empty_like(state.velocity)
    world.read(np.empty_like(velocity), velocity, np.empty(len(velocity)))
    world.close()
    return velocity


@pytest.mark.parametrize(("body", "seed"), [("medium", 11), ("medium", 29), ("large", 16), ("large", 27)])
def test_one_step_of_a_crumpled_body(body: str, seed: int) -> None:
    task = make_task("escape", body=body)
    both_sides = msgspec.structs.replace(task, scene=task.scene.two_sided())
    trace = flight(task, seed)
    in_turn, as_here = [], []
    for t in range(FROM, len(trace.position) - 1, EVERY):
        state = state_of(trace, t, both_sides)
        contacts = reference.find_contacts(state, both_sides)
        ordered, pulled = island(contacts, both_sides)
        if any(c.a != WORLD for c in contacts) and pulled == sorted(pulled, reverse=True):
            there = one_step_in_box2d(task, state)
            in_turn.append(np.abs(one_step(both_sides, state, ordered) - there).max())
            as_here.append(np.abs(one_step(both_sides, state, contacts) - there).max())
    assert len(in_turn) >= 20, f"{len(in_turn)} states in which masses touch"
    assert max(in_turn) <= TOLERANCE, f"{max(in_turn):.1e} m/s in the worst of {len(in_turn)} steps"
    assert max(as_here) > 10 * TOLERANCE, "the order does not show: these states tell nothing"
