"""Every controller: its parameters, what is refused, the engine against the plain reference, and symmetry."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import pytest
from numba import njit

from turgor.body import LARGE, MEDIUM, SMALL, Body, ring
from turgor.control import (
    CLOCK,
    CONTROLLERS,
    MLP,
    Controller,
    Distributed,
    Linear,
    Sinusoid,
    check_theta,
    pack,
    parameter_count,
    turn_per_step,
)
from turgor.errors import InvalidInput
from turgor.physics import reference, reference_control
from turgor.physics.control import sine
from turgor.physics.memory import Floats, aligned, field_of, layout
from turgor.physics.model import WIDTH
from turgor.physics.views import Width, views
from turgor.scene import flat
from turgor.simulate import Simulator
from turgor.task import Task, make_task, task_from_json, task_to_json

BODIES = {"small": SMALL, "medium": MEDIUM, "large": LARGE}
OTHERS = ("mlp", "sinusoid", "distributed")


# --- parameters ---------------------------------------------------------------------------------------------------

COUNTS: dict[str, tuple[Controller, list[int], list[int]]] = {  # with pressure, springs only
    "linear": (Linear(), [374, 784, 1344], [340, 735, 1280]),
    "mlp": (MLP(), [731, 1056, 1381], [714, 1039, 1364]),
    "mlp of 4": (MLP(hidden=4), [191, 276, 361], [186, 271, 356]),
    "sinusoid": (Sinusoid(), [34, 49, 64], [31, 46, 61]),
    "distributed": (Distributed(), [100, 100, 100], [91, 91, 91]),
    "distributed, talking": (Distributed(hidden=5, messages=3), [108, 108, 108], [102, 102, 102]),
    "distributed, silent": (Distributed(hidden=1, messages=0), [10, 10, 10], [8, 8, 8]),
}


@pytest.mark.parametrize("case", COUNTS)
def test_parameter_counts(case: str) -> None:
    controller, pressure, springs = COUNTS[case]
    for condition, counts in (("pressure", pressure), ("springs", springs), ("passive", [0, 0, 0])):
        assert [parameter_count(body, condition, controller) for body in BODIES.values()] == counts
        tasks = [make_task(body=body, condition=condition, controller=controller) for body in BODIES]
        assert [task.parameter_count for task in tasks] == counts
        for task in tasks:
            theta = np.arange(2.0 * task.parameter_count).reshape(2, -1) / 1000
            packed = np.concatenate(pack(theta, task.body, condition, controller, 0.1), axis=1)
            kept = theta[:, 1:] if controller == Sinusoid() else theta
            assert np.isin(kept, packed).all()
            assert packed.shape == theta.shape


def test_layers_are_weights_row_by_row_then_biases() -> None:
    theta = np.arange(731.0)[None]
    weights, biases = pack(theta, SMALL, "pressure", MLP(), 0.1)
    np.testing.assert_array_equal(weights[0], [*range(528), *range(544, 704), *range(714, 730)])
    np.testing.assert_array_equal(biases[0], [*range(528, 544), *range(704, 714), 730])
    theta = np.arange(100.0)[None]
    weights, biases = pack(theta, SMALL, "pressure", Distributed(), 0.1)
    np.testing.assert_array_equal(weights[0], [*range(56), *range(64, 96)])
    np.testing.assert_array_equal(biases[0], [*range(56, 64), *range(96, 100)])


def test_frequencies() -> None:
    dt = 1 / 60
    for u, f in ((0, 1), (1, 2), (-1, 0.5), (3, 8), (100, 8), (-1e9, 1 / 8)):
        assert turn_per_step(np.float64(u), dt) / dt == pytest.approx(f, abs=dt / CLOCK * 3600)
    turns = turn_per_step(np.linspace(-4, 4, 99), 0.7)
    assert ((turns >= 0) & (turns < 1)).all()
    np.testing.assert_array_equal(turns * CLOCK, np.round(turns * CLOCK))


REFUSED = {
    "unknown": (lambda: make_task(controller="pid"), "controller: expected one of linear, mlp", "'pid'"),
    "a number": (lambda: make_task(controller=3), "controller: Expected `object`", "int"),
    "a tag": (lambda: make_task(controller={"type": "pid"}), "controller: Invalid value 'pid'", ""),
    "not one in a task": (
        lambda: msgspec.structs.replace(make_task(), controller="mlp"),
        "controller: expected a Linear, MLP, Sinusoid or Distributed",
        "got mlp",
    ),
    "no hidden units": (lambda: MLP(hidden=0), "hidden: expected a whole number, 1 to 1000", "got 0"),
    "half a unit": (lambda: Distributed(hidden=2.5), "hidden: expected a whole number", "got 2.5"),
    "negative messages": (lambda: Distributed(messages=-1), "messages: expected a whole number, 0 to 1000", "got -1"),
    "theta of another": (lambda: check_theta(np.zeros((1, 374)), SMALL, "pressure", MLP()), "[agent, 731]", "[1, 374]"),
    "rollout of another": (
        lambda: Simulator(make_task(controller="sinusoid")).rollout(np.zeros((1, 374))),
        "shape [agent, 34]",
        "[1, 374]",
    ),
    "record of another": (
        lambda: Simulator(make_task(controller="distributed")).record(np.zeros(374)),
        "shape [agent, 100]",
        "[1, 374]",
    ),
    "open chain": (lambda: own(SMALL.springs[:-1]), "distributed: expected closed rings", "mass 9, the first of 0"),
    "springs against each other": (lambda: own([[1, 0], *SMALL.springs[1:]]), "closed rings", "mass 0, the first of 0"),
    "crossing springs": (lambda: own([*SMALL.springs, [0, 5]]), "closed rings", "mass 0, the first of 2"),
}


def own(springs: object, controller: Controller = Distributed(), condition: str = "springs") -> Task:  # noqa: B008
    body = Body(SMALL.position, springs=springs)
    return Task(name="own", body=body, scene=flat(), position=body.position, controller=controller, condition=condition)


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(case: str) -> None:
    make, expected, got = REFUSED[case]
    with pytest.raises(InvalidInput) as error:
        make()
    assert "\n" not in str(error.value)
    assert expected in str(error.value)
    assert got in str(error.value)


def test_only_a_distributed_controller_asks_for_rings() -> None:
    own(SMALL.springs[:-1], Linear())
    own(SMALL.springs[:-1], condition="passive")


# --- stored tasks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("controller", [MLP(hidden=3), Sinusoid(), Distributed(hidden=2, messages=4)])
def test_a_task_read_back_has_its_controller(controller: Controller) -> None:
    task = make_task("flat", controller=controller, steps=20)
    again = task_from_json(task_to_json(task))
    assert again.controller == controller
    assert again.identity == task.identity
    assert make_task("flat", controller=msgspec.to_builtins(controller), steps=20).identity == task.identity


def test_identities_tell_controllers_apart_and_leave_linear_tasks_as_they_were() -> None:
    kinds = [None, *OTHERS, MLP(hidden=3), Distributed(hidden=3), Distributed(messages=2)]
    tasks = [make_task("flat") if kind is None else make_task("flat", controller=kind) for kind in kinds]
    assert len({task.identity for task in tasks}) == len(kinds)
    assert make_task("flat", controller="linear").identity == tasks[0].identity
    assert b"controller" not in task_to_json(tasks[0])
    assert task_from_json(task_to_json(tasks[0])).controller == Linear()
    # of versions that had no other controller
    assert make_task("hilly", seed=1).identity == "c7dbebdf06b50a71"


def test_controllers_are_made_by_name() -> None:
    for name, kind in CONTROLLERS.items():
        assert make_task(controller=name).controller == kind()


# --- the engine and the reference ---------------------------------------------------------------------------------


@pytest.mark.parametrize("condition", ["pressure", "springs", "passive"])
@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("controller", OTHERS)
def test_the_first_30_steps(controller: str, body: str, condition: str) -> None:
    """At the tolerances of tests/test_kernel.py, where single steps are compared as well."""
    task = make_task(body=body, condition=condition, controller=controller, steps=30)
    theta = np.random.default_rng(1).uniform(-1, 1, task.parameter_count)
    mine, plain = Simulator(task).record(theta), reference.rollout(task, theta)
    assert np.abs(mine.position - plain.position).max() <= 2e-5
    assert np.abs(mine.velocity - plain.velocity).max() <= 2e-4
    np.testing.assert_allclose(mine.rest_length, plain.rest_length, rtol=1e-6)
    np.testing.assert_allclose(mine.pressure, plain.pressure, rtol=1e-6)
    if condition != "passive":
        assert np.ptp(plain.rest_length) > 0.1


def test_a_sinusoid_does_not_drift() -> None:
    """The clock of the last of 20,000 steps is that of float64."""
    body = ring(3, 2.0)
    start = body.position + np.array([0.0, 50.0])
    task = Task(
        name="long",
        body=body,
        scene=flat(),
        position=start,
        condition="springs",
        controller=Sinusoid(),
        steps=20_000,
    )
    theta = np.array([0.7, 1.0, 0.0, 0.0, 1.0, 0.5, 0.5, 0.0, 0.1, -0.1])
    rest = Simulator(task).record(theta).rest_length[1:]
    turn = 2 * math.pi * (np.arange(20_000) * turn_per_step(theta[0], task.physics.dt) % 1)
    command = np.tanh(np.stack([np.cos(turn), np.sin(turn)], axis=1) @ theta[1:7].reshape(3, 2).T + theta[7:])
    np.testing.assert_allclose(rest, body.rest_length * (1 - 0.25 * command), atol=2e-6)


class Values(NamedTuple):
    x: Annotated[Floats, "row"]
    y: Annotated[Floats, "row"]


@njit(error_model="numpy")
def sine_of_rows(buffer, offsets, width, count):
    v = views(Values, buffer, offsets, width)
    for r in range(count):
        v.y[r] = sine(v.x[r])


def test_sine() -> None:
    x = np.linspace(-0.25, 0.25, 100_000).astype(np.float32).reshape(-1, WIDTH)
    lengths = {"row": len(x)}
    offsets = layout(Values, lengths, WIDTH)
    buffer = aligned(1, offsets[-1])[0]
    field_of(buffer, Values, offsets, "x", lengths, WIDTH)[:] = x
    sine_of_rows(buffer, offsets, Width(WIDTH), len(x))
    y = field_of(buffer, Values, offsets, "y", lengths, WIDTH)
    assert np.abs(y - np.sin(2 * np.pi * x.astype(np.float64))).max() <= 3e-7


# --- the distributed one ------------------------------------------------------------------------------------------


def test_one_theta_drives_every_body() -> None:
    theta = np.random.default_rng(3).uniform(-1, 1, (5, 100))
    for body in BODIES:
        out = Simulator(make_task(body=body, controller="distributed", steps=200)).rollout(theta)
        assert len({x.tobytes() for x in out.position}) == 5
        assert np.isfinite(out.fitness).all()


def test_two_rings_are_driven_like_one_each() -> None:
    """Springs of two rings in any order; each hears its own, and each chamber its own masses' votes."""
    n, far = 10, np.array([60.0, 0.0])
    position = np.concatenate([SMALL.position, SMALL.position + far])
    springs = np.concatenate([SMALL.springs, SMALL.springs + n])[np.random.default_rng(0).permutation(2 * n)]
    body = Body(
        position,
        angle=np.tile(SMALL.angle, 2),
        springs=springs,
        chambers=[range(n), range(n, 2 * n)],
        gas_amount=np.tile(SMALL.gas_amount, 2),
    )
    start = body.position + np.array([0.0, 5.6])
    task = Task(name="two", body=body, scene=flat(), position=start, controller=Distributed(), steps=30)
    theta = np.random.default_rng(5).uniform(-1, 1, 100)
    mine, plain = Simulator(task).record(theta), reference.rollout(task, theta)
    assert np.abs(mine.position - plain.position).max() <= 2e-5
    np.testing.assert_allclose(mine.pressure, plain.pressure, rtol=1e-6)


@pytest.mark.parametrize("turn", [1, 4, 9])
def test_numbering_does_not_matter(turn: int) -> None:
    """A ring whose masses, springs and loop are numbered from another place on behaves the same, but for the order
    in which the solver takes its springs."""

    def body(turn: int) -> Body:
        return Body(
            np.roll(SMALL.position, -turn, axis=0),
            angle=np.roll(SMALL.angle, -turn),
            springs=[(i, (i + 1) % 10) for i in range(10)],
            chambers=[np.roll(range(10), turn)],
            gas_amount=SMALL.gas_amount,
        )

    records = []
    for here in (body(0), body(turn)):
        start = here.position + np.array([0.0, 5.6])
        task = Task(name="ring", body=here, scene=flat(), position=start, controller=Distributed(), steps=25)
        records.append(Simulator(task).record(np.random.default_rng(7).uniform(-1, 1, 100)))
    usual, turned = records
    np.testing.assert_allclose(turned.rest_length[1], np.roll(usual.rest_length[1], -turn), rtol=1e-6)
    np.testing.assert_allclose(turned.pressure[1], usual.pressure[1], rtol=1e-6)
    np.testing.assert_allclose(turned.rest_length, np.roll(usual.rest_length, -turn, axis=1), rtol=1e-3)
    np.testing.assert_allclose(turned.position, np.roll(usual.position, -turn, axis=1), atol=1e-2)
    assert np.ptp(usual.rest_length) > 0.1


def test_messages_travel_one_spring_a_step() -> None:
    """What one mass feels reaches the mass k springs away k steps later, and no other before."""
    task = make_task("flat", condition="springs", controller=Distributed(hidden=1), steps=6)
    theta = np.zeros(task.parameter_count)
    weights = dict(zip(("touch", "x", "y", "before", "after", "from_before", "from_after"), range(7), strict=True))
    theta[weights["from_before"]] = theta[weights["touch"]] = 1.0  # h = tanh(touch + what the mass before says)
    theta[8 + 0], theta[8 + 2] = 1.0, 1.0  # spring and the message to the mass after: h
    state = reference.start(task, task.position + np.array([0.0, 30.0]))
    touched = np.zeros(task.body.mass_count, dtype=bool)
    touched[3] = True
    reached = []
    for _ in range(5):
        state.touch[:] = touched
        state.window.clear()
        commands, _ = reference_control.control(state, reference_control.sense(state, task), theta, task)
        reached.append(set(np.flatnonzero(commands).tolist()))
    assert reached == [{3}, {3, 4}, {3, 4, 5}, {3, 4, 5, 6}, {3, 4, 5, 6, 7}]
