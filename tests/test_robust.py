"""Robust evolution: which worlds it draws, which run counts, and that neither threads nor pauses change a bit."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from sealing import seal

from turgor.body import ring
from turgor.cli import main
from turgor.errors import InvalidInput
from turgor.evolution.cma_es import CMAES
from turgor.evolution.loop import Progress, begin, evaluate, evolve, evolve_a_while, resume
from turgor.evolution.worlds import draw_worlds, judge_generation, kept
from turgor.experiments.campaign import open_run
from turgor.experiments.plan import Entry
from turgor.records import Checkpoint
from turgor.runs import Run
from turgor.scene import Scene, polyline
from turgor.simulate import Rollout, Simulator
from turgor.task import REST_GAP, Leave, Task, make_task, resting
from turgor.variants import Robust
from turgor.web.library import Library
from turgor.web.replay import read_replay, replay_of_run

NONE = {"friction": 0.0, "gravity": 0.0, "gas": 0.0, "damping": 0.0, "shift": 0.0, "jitter": 0.0}
QUICK = Robust(worlds=3)
POPULATION = 21
GRAVITY = 9.853673760439841  # [m/s^2], of the first world of seed 3, generation 4


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("hilly", steps=100)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a robust run, in which some agents escape."""
    out = tmp_path_factory.mktemp("robust") / "made"
    recipe = {"name": "escape", "body": "small", "condition": "pressure", "seed": 0}
    escape = make_task("escape", steps=120)
    above = escape.position + [1.55, 0.0]  # one mass above x = 0, which it has to leave
    task = msgspec.structs.replace(escape, end=Leave(half_width=0.0), position=above)
    evolve(task, 60, out=out, robust_repeats=4, recipe=recipe, robust=Robust(worlds=4, shift=0.2))
    return out


def bits_of(run: Run) -> tuple[Any, ...]:
    champion = run.checked_champion()
    rows = [row[:-1] for row in run.rows]  # without the seconds
    return rows, champion.theta.tobytes(), champion.fitness, champion.robust.tobytes()


def numbers_of(task: Task) -> dict[str, float]:
    """What a world may differ in, each as one number."""
    return {
        "friction": task.scene.friction,
        "gravity": task.physics.gravity,
        "gas": float(task.body.gas_amount[0]),
        "damping": float(task.body.damping_ratio[0]),
    }


# --- the worlds ---------------------------------------------------------------------------------------------------


def test_worlds_depend_on_seed_and_generation_alone(task: Task) -> None:
    def ids(*which: int, worlds: int = 3) -> list[str]:
        return [world.identity for world in draw_worlds(task, Robust(worlds=worlds), *which)]

    np.random.seed(3)  # noqa: NPY002
    assert ids(5, 7) == ids(5, 7)
    drawn = [*ids(5, 7), *ids(5, 8), *ids(6, 7), *ids(7, 5), *ids(0, 1), *ids(1, 0)]
    assert len(set(drawn)) == len(drawn)
    assert task.identity not in drawn
    assert ids(5, 7, worlds=9)[:3] == ids(5, 7)


def test_worlds_are_drawn_as_runs_that_are_kept_were(task: Task) -> None:
    """Another order of draws would make other worlds of an old run, whose champion could not be judged again."""
    u = 2 * np.random.default_rng(np.random.SeedSequence(3, spawn_key=(4,))).random((2, 5 + 2 * 10)) - 1
    for world, draw in zip(draw_worlds(task, Robust(worlds=2), 3, 4), u, strict=True):
        found, own = numbers_of(world), numbers_of(task)
        for name, spread, share in zip(own, (0.1, 0.02, 0.05, 0.2), draw[:4].tolist(), strict=True):
            assert found[name] == own[name] * (1 + spread * share)
        assert np.array_equal(world.position, task.position + [0.05 * draw[4], 0.0] + 1e-6 * draw[5:].reshape(10, 2))
    assert numbers_of(draw_worlds(task, Robust(worlds=1), 3, 4)[0])["gravity"] == GRAVITY


def test_numbers_are_uniform_within_their_spread(task: Task) -> None:
    robust = Robust(worlds=100, friction=0.3, gravity=0.05, gas=0.2, damping=0.5, shift=0.7, jitter=1e-4)
    still = msgspec.structs.replace(robust, shift=0.0)
    worlds = [world for generation in range(10) for world in draw_worlds(task, robust, 0, generation)]
    unmoved = [world for generation in range(10) for world in draw_worlds(task, still, 0, generation)]
    own = numbers_of(task)
    shares = {name: np.array([numbers_of(world)[name] / own[name] - 1 for world in worlds]) for name in own}
    jittered = np.array([world.position - task.position for world in unmoved])
    moved = np.array([world.position - task.position for world in worlds]) - jittered
    shares |= {"shift": moved[:, 0, 0], "jitter": jittered[:, 3, 1]}
    for name, values in shares.items():
        spread = getattr(robust, name)
        assert np.abs(values).max() <= spread * (1 + 1e-9)
        assert abs(values.mean()) < 0.06 * spread
        assert values.std() == pytest.approx(spread / math.sqrt(3), rel=0.06), name
    correlation = np.corrcoef(list(shares.values())) - np.eye(6)
    assert np.abs(correlation).max() < 0.12


def test_a_spread_changes_its_own_number_and_no_other(task: Task) -> None:
    both = draw_worlds(task, Robust(worlds=2), 0, 1)
    for name in numbers_of(task):
        (one, two) = draw_worlds(task, Robust(**{**NONE, "worlds": 2, name: getattr(Robust(), name)}), 0, 1)
        for world, whole in zip((one, two), both, strict=True):
            changed = {n for n, value in numbers_of(world).items() if value != numbers_of(task)[n]}
            assert changed == {name}
            assert numbers_of(world)[name] == numbers_of(whole)[name]  # drawn as with the others
            assert np.array_equal(world.position, task.position)
    for name in ("shift", "jitter"):
        (world, _) = draw_worlds(task, Robust(**{**NONE, "worlds": 2, name: 1e-3}), 0, 1)
        assert numbers_of(world) == numbers_of(task)
        moved = world.position - task.position
        assert np.ptp(moved, axis=0).max() < 1e-12 if name == "shift" else (moved != 0).all()


def test_without_spreads_a_world_is_the_tasks_own(task: Task) -> None:
    assert {world.identity for world in draw_worlds(task, Robust(worlds=4, **NONE), 0, 1)} == {task.identity}


def test_more_gas_means_more_pressure_in_everything_that_depends_on_it(task: Task) -> None:
    (world,) = draw_worlds(task, Robust(**{**NONE, "worlds": 1, "gas": 0.5}), 0, 1)
    share = world.body.gas_amount / task.body.gas_amount
    for name in ("pressure_range", "pressure_step", "pressure_start", "gas_energy"):
        np.testing.assert_allclose(getattr(world, name), getattr(task, name) * share, rtol=1e-12)
    assert abs(share[0] - 1) > 0.01


VALLEY = polyline(np.array([[-30.0, 20.0], [0.0, 0.0], [30.0, 20.0]]))


def gaps(task: Task) -> np.ndarray:
    """How far each square's lowest corner is above the ground below the square, found point by point [m]."""
    body, found = task.body, np.full(len(task.position), np.inf)
    reach = body.side / 2 * (np.abs(np.cos(body.angle)) + np.abs(np.sin(body.angle)))
    for i, (x, y) in enumerate(task.position):
        for x1, y1, x2, y2 in task.scene.segments[task.scene.depth > 0]:
            left, right = sorted((x1, x2))
            for at in {max(x - reach[i], left), min(x + reach[i], right)}:
                if left <= at <= right and abs(at - x) <= reach[i] + 1e-12 and x1 != x2:
                    found[i] = min(found[i], y - reach[i] - (y1 + (y2 - y1) * (at - x1) / (x2 - x1)))
    return found


@pytest.mark.parametrize("size", ["small", "medium", "large"])
@pytest.mark.parametrize("name", ["hilly", "flat", "escape", "escape-authors", "valley"])
def test_no_start_is_moved_into_the_ground_or_a_wall(name: str, size: str) -> None:
    task = make_task("flat" if name == "valley" else name, body=size)
    if name == "valley":  # in which a body lies that rests on the slope on either side
        lying = task.position + [0.0, 10.0]
        task = msgspec.structs.replace(task, scene=VALLEY, position=lying)
        task = msgspec.structs.replace(task, position=lying - [0.0, gaps(task).min() - REST_GAP / 2])
        assert gaps(task).min() == pytest.approx(REST_GAP / 2)
    before, raised = gaps(task), []
    for world in draw_worlds(task, Robust(worlds=40, **{**NONE, "shift": 1.0}), 0, 1):
        by = world.position - task.position
        assert np.ptp(by, axis=0).max() < 1e-12
        assert by[0, 1] >= 0
        raised.append(by[0, 1] > 1e-9)
        assert (gaps(world) >= np.minimum(before, REST_GAP) - 1e-9).all()
        if name.startswith("escape"):
            inside = np.abs(task.scene.segments[task.scene.depth == 0][:, [0, 2]]).min()
            assert (np.abs(world.position[:, 0]) + math.sqrt(0.5) < inside).all()
            assert np.abs(by[:, 1]).max() < 1e-12  # as near to the roof as before
    assert sum(raised) > 30 if name == "valley" else not any(raised)


def test_where_no_ground_is_a_start_is_moved_sideways_alone() -> None:
    body = ring(6, 3.0, gas_amount=100.0)
    ledge = Scene([[50.0, 5.0, 3.2, 5.0]], 2.0)  # ground from x = 3.2 m on, above the body's lowest mass
    for scene in (Scene([]), ledge):
        task = Task(name="own", body=body, scene=scene, position=resting(body))
        for world in draw_worlds(task, Robust(worlds=8, **{**NONE, "shift": 1.0}), 0, 1):
            by = world.position - task.position
            onto = scene is ledge and by[0, 0] > 0
            assert (by[:, 1] > 1.0).all() if onto and gaps(task).min() == np.inf else (by[:, 1] >= 0).all()
            assert (gaps(world) >= np.minimum(gaps(task), REST_GAP) - 1e-9).all()


# --- which run counts ---------------------------------------------------------------------------------------------


def rollout_of(fitness: list[float], mark: int) -> Rollout:
    agents = len(fitness)
    return Rollout(
        fitness=np.array(fitness),
        steps=np.full(agents, mark),
        solved=np.arange(agents) == mark,
        com=np.full((agents, 2), float(mark)),
        start=np.full((agents, 2), -float(mark)),
        position=np.full((agents, 3, 2), np.float32(mark)),
    )


@pytest.mark.parametrize(
    ("keep", "worlds", "expected"),
    [
        ("median", 5, [2, 1, 3, 0]),
        ("worst", 5, [3, 0, 1, 0]),
        ("median", 4, [1, 1, 3, 0]),  # the lower of the two in the middle
        ("worst", 4, [3, 0, 1, 0]),
        ("median", 1, [0, 0, 0, 0]),
        ("worst", 1, [0, 0, 0, 0]),
        ("median", 2, [1, 0, 1, 0]),
    ],
)
def test_the_run_that_counts_counts_in_all_its_fields(keep: Any, worlds: int, expected: list[int]) -> None:
    nan = math.nan
    table = [[5.0, 1.0, 9.0, 1.0], [2.0, 2.0, nan, 1.0], [3.0, 3.0, -1.0, 1.0], [-4.0, 4.0, -math.inf, 1.0],
             [9.0, 0.5, 7.0, 1.0]]  # fmt: skip
    if worlds == 5:
        expected = {"median": [2, 1, 2, 2], "worst": [3, 4, 1, 0]}[keep]
    if worlds == 4:
        expected = {"median": [1, 1, 3, 1], "worst": [3, 0, 1, 0]}[keep]
    out = kept([rollout_of(row, k) for k, row in enumerate(table[:worlds])], Robust(worlds=worlds, keep=keep))
    np.testing.assert_array_equal(out.fitness, [table[k][agent] for agent, k in enumerate(expected)])
    assert out.steps.tolist() == expected
    assert out.com[:, 0].tolist() == (-out.start[:, 1]).tolist() == out.position[:, 2, 1].tolist() == expected
    assert out.solved.tolist() == [agent == k for agent, k in enumerate(expected)]
    assert (out.solved.dtype, out.position.dtype) == (bool, np.float32)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("name", ["hilly", "escape"])
def test_rollouts_in_many_tasks_are_those_of_a_simulator_of_each(name: str, threads: int) -> None:
    task = make_task(name, steps=120)
    theta = np.random.default_rng(0).normal(0, 2, (37, task.parameter_count))
    worlds = draw_worlds(task, Robust(worlds=4, friction=0.5, gas=0.3), 1, 2)
    together = Simulator(task, threads=threads).rollout_in(worlds, theta)
    for out, world in zip(together, worlds, strict=True):
        alone = Simulator(world, threads=1).rollout(theta)
        for field in Rollout.__struct_fields__:
            assert getattr(out, field).tobytes() == getattr(alone, field).tobytes(), field
    assert len({out.fitness.tobytes() for out in together}) == 4
    assert Simulator(task).rollout_in([], theta) == []


@pytest.mark.parametrize("keep", ["median", "worst"])
def test_history_and_champion_are_what_the_drawn_worlds_say(keep: Any, task: Task) -> None:
    robust, seen = Robust(worlds=3, keep=keep), []

    class Watched(CMAES):
        def tell(self, theta: np.ndarray, fitness: np.ndarray) -> None:
            seen.append((theta.copy(), fitness.copy()))
            super().tell(theta, fitness)

    run = evolve(task, 4 * POPULATION, seed=6, strategy=Watched, robust_repeats=2, robust=robust)
    best = []
    for generation, (theta, told) in enumerate(seen, start=1):
        each = [Simulator(world).rollout(theta).fitness for world in draw_worlds(task, robust, 6, generation)]
        expected = np.median(each, axis=0) if keep == "median" else np.min(each, axis=0)
        assert np.array_equal(told, expected)
        assert np.ptp(each, axis=0).min() > 0
        best.append(expected.max())
        assert run.history["median"][generation - 1] == np.median(expected)
    assert np.array_equal(run.history["best"], np.maximum.accumulate(best))
    champion = run.checked_champion()
    assert champion.fitness == max(best)
    assert champion.generation == np.argmax(best) + 1
    assert np.array_equal(champion.robust, evaluate(Simulator(task), champion.theta, 2).fitness)  # of the task's world
    again = judge_generation(Simulator(task), champion.theta[None], robust, 6, champion.generation)
    assert again.fitness[0] == champion.fitness


def test_functions_of_the_users_own_judge_every_world() -> None:
    seen: list[tuple[int, ...]] = []

    def lowest(out: Rollout) -> np.ndarray:
        seen.append(out.position.shape)
        return np.where(out.solved, out.com[:, 1], -out.com[:, 1])

    def far(position: np.ndarray) -> np.ndarray:
        return np.abs(position[:, :, 0]).max(axis=1) > 5.3

    task = msgspec.structs.replace(make_task("flat", steps=30), fitness=lowest, end=far)
    run = evolve(task, 2 * POPULATION, robust_repeats=2, robust=QUICK)
    assert seen.count((POPULATION, 10, 2)) == 2 * 3
    worlds = draw_worlds(task, QUICK, 0, run.checked_champion().generation)
    each = [Simulator(world).rollout(run.checked_champion().theta[None]) for world in worlds]
    middle = sorted(each, key=lambda out: out.fitness[0])[1]
    champion = run.checked_champion()
    assert (champion.fitness, champion.steps, champion.solved) == (
        middle.fitness[0],
        middle.steps[0],
        middle.solved[0],
    )


# --- the same bits ------------------------------------------------------------------------------------------------


def test_same_seed_same_bits_whatever_the_threads(task: Task) -> None:
    one, two, three = (bits_of(evolve(task, 80, seed=2, threads=n, robust_repeats=3, robust=QUICK)) for n in (1, 2, 3))
    assert one == two == three
    assert one != bits_of(evolve(task, 80, seed=2, robust_repeats=3))
    assert one != bits_of(evolve(task, 80, seed=2, robust_repeats=3, robust=Robust(worlds=3, keep="worst")))


@pytest.mark.parametrize("keep", ["median", "worst"])
def test_one_world_without_spreads_is_the_plain_evolution(keep: Any, task: Task) -> None:
    plain = evolve(task, 120, seed=3, robust_repeats=3)
    assert bits_of(evolve(task, 120, seed=3, robust_repeats=3, robust=Robust(keep=keep, **NONE))) == bits_of(plain)
    alone = Robust(worlds=1, keep=keep, **NONE)
    assert bits_of(evolve(task, 120, seed=3, robust_repeats=3, robust=alone)) == bits_of(plain)


def test_pause_leaves_no_trace(task: Task, tmp_path: Path) -> None:
    whole = evolve(task, 160, seed=4, robust_repeats=3, robust=QUICK)

    def stop(progress: Progress) -> None:
        if progress.generation == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evolve(task, 160, seed=4, out=tmp_path / "run", progress=stop, robust_repeats=3, robust=QUICK)
    left = Run.open(tmp_path / "run")
    assert (left.generation, left.settings.robust) == (4, QUICK)
    assert bits_of(resume(left, threads=1)) == bits_of(whole)
    again = Run.open(tmp_path / "run")
    assert (bits_of(again), again.settings.robust) == (bits_of(whole), QUICK)
    longer = resume(again, 200)
    assert bits_of(longer) == bits_of(evolve(task, 200, seed=4, robust_repeats=3, robust=QUICK))


def test_pieces_of_a_run_have_the_bits_of_the_whole(task: Task) -> None:
    whole = evolve(task, 100, seed=4, robust_repeats=3, robust=QUICK)
    strategy = partial(CMAES, population=POPULATION)
    run, _ = begin(task, 100, 4, None, strategy, 1, 3, robust=QUICK)
    checkpoint, pieces = Checkpoint(), 0
    while run.status != "done":
        run = Run(task, run.settings)
        run.go_back(checkpoint)
        state = evolve_a_while(run, checkpoint, strategy, 0.0)  # a generation
        checkpoint = Checkpoint(rows=run.rows, champion=run.champion, solver=run.solver, state=state)
        pieces += 1
    assert pieces == 5
    assert bits_of(run) == bits_of(whole)


# --- what is kept, and what is refused ----------------------------------------------------------------------------


def test_the_settings_are_in_run_json_and_other_runs_have_none(task: Task, tmp_path: Path) -> None:
    evolve(task, 21, out=tmp_path / "robust", robust_repeats=2, robust=QUICK)
    evolve(task, 21, out=tmp_path / "plain", robust_repeats=2)
    robust, plain = (json.loads((tmp_path / name / "run.json").read_text())["settings"] for name in ("robust", "plain"))
    assert robust["robust"] == {"worlds": 3, "keep": "median", "friction": 0.1, "gravity": 0.02, "gas": 0.05,
                                "damping": 0.2, "shift": 0.05, "jitter": 1e-6}  # fmt: skip
    assert "robust" not in plain
    assert Run.open(tmp_path / "plain").settings.robust is None


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"worlds": 0}, "robust worlds: expected a whole number, 1 to 100; got 0"),
        ({"worlds": 101}, "robust worlds: expected a whole number, 1 to 100; got 101"),
        ({"worlds": 2.0}, "robust worlds: expected a whole number, 1 to 100; got 2.0"),
        ({"worlds": True}, "robust worlds: expected a whole number, 1 to 100; got True"),
        ({"keep": "best"}, "robust keep: expected one of median, worst; got 'best'"),
        ({"friction": -0.1}, "robust friction: expected a number from 0 to 1; got -0.1"),
        ({"gravity": 1.1}, "robust gravity: expected a number from 0 to 1; got 1.1"),
        ({"gas": math.nan}, "robust gas: expected a number from 0 to 1; got nan"),
        ({"damping": "a"}, "robust damping: expected a number from 0 to 1; got a"),
        ({"shift": math.inf}, "robust shift: expected a number from 0 to 1; got inf"),
        ({"jitter": 0.01}, "robust jitter: expected a number from 0 to 0.001; got 0.01"),
    ],
)
def test_impossible_numbers_are_refused(change: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidInput) as error:
        Robust(**change)
    assert str(error.value) == text


def test_what_cannot_be_evolved_is_refused_before_a_folder_is_made(task: Task, tmp_path: Path) -> None:
    edge = msgspec.structs.replace(task, position=task.position + [1e6 - 5.2 - task.position[:, 0].max() + 5, 0])
    steep = msgspec.structs.replace(task, scene=msgspec.structs.replace(task.scene, friction=1e9))
    wide = msgspec.structs.replace(task, scene=Scene(np.arange(100_000)[:, None] * [1, 0, 1, 0] + [0, 0, 0.5, 0]))
    crowd = ring(600, 1000.0)
    for hostile, robust, text in (
        (task, True, r"robust: expected a turgor.Robust, as in Robust\(worlds=5\); got True"),
        (edge, Robust(shift=1.0), "position: expected finite numbers"),
        (steep, Robust(), "ground friction: expected a finite number"),
        (Task(name="own", body=crowd, scene=wide.scene, position=resting(crowd), condition="springs"), Robust(),
         "robust shift: expected fewer masses or segments, in at most 256 MB; got 480 MB"),
    ):  # fmt: skip
        with pytest.raises(InvalidInput, match=text):
            evolve(hostile, 21, out=tmp_path / "run", strategy="sep-cma-es", robust=robust)  # ty: ignore[invalid-argument-type]
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("was", "now", "text"),
    [
        ('"worlds":4', '"worlds":0', r"robust worlds: expected a whole number, 1 to 100; got 0"),
        ('"worlds":4', '"worlds":4.5', r"Expected `int`, got `float` - at `\$.settings.robust.worlds`"),
        ('"shift":0.2', '"shift":1e300', r"robust shift: expected a number from 0 to 1; got 1e\+300"),
        ('"keep":"median"', '"keep":"best"', r"Invalid enum value 'best'"),
    ],
)
def test_a_changed_run_json_is_refused(was: str, now: str, text: str, made: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    for file in made.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    assert was in path.read_text()
    path.write_text(path.read_text().replace(was, now))
    seal(tmp_path)
    with pytest.raises(InvalidInput, match=text):
        Run.open(tmp_path)


def test_a_campaign_does_not_take_a_robust_run_for_its_own(tmp_path: Path) -> None:
    entry = Entry(task="flat", body="small", condition="pressure", seed=0, evaluations=21)
    evolve(entry.make_task(), 21, 0, tmp_path / entry.name, robust_repeats=1, robust=Robust(worlds=1))
    with pytest.raises(
        InvalidInput, match="expected a run that is not robust; choose another folder; got in a changed"
    ):
        open_run(tmp_path, entry)


# --- what is said -------------------------------------------------------------------------------------------------


def test_what_is_shown_is_the_tasks_own_world(made: Path) -> None:
    run = Run.open(made)
    champion, solver = run.checked_champion(), run.solver
    assert solver is not None
    nominal = Simulator(run.task).rollout(np.stack([champion.theta, solver.theta]))
    assert nominal.fitness[0] != champion.fitness
    for k, which in enumerate(("best", "solver")):
        header = read_replay(replay_of_run(made, which)).header
        assert header.fitness == nominal.fitness[k]
        assert header.solved == nominal.solved[k]
        assert header.title == "escape, small, pressure, robust, seed 0"


def test_the_viewer_says_what_a_fitness_is(made: Path) -> None:
    library = Library(made.parent)
    library.look()
    assert library.runs["made"].change == "robust: median of 4 changed worlds"
    assert library.details("made")["champion"]["judged"] == "median of 4 changed worlds"


def test_evaluate_tells_judged_and_nominal_fitness(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run.open(made)
    champion = run.checked_champion()
    nominal = Simulator(run.task).rollout(champion.theta[None]).fitness[0]
    assert main(["evaluate", str(made), "--repeats", "7", "--json", str(tmp_path / "found.json")]) == 0
    said = capsys.readouterr().out.splitlines()
    judged = f"median of 4 changed worlds, generation {champion.generation} of {made}"
    assert said[0] == f"champion   {champion.fitness:.3f} m/s, {judged}"
    assert said[1] == f"again      {champion.fitness:.3f} m/s, the same bits, the worlds of its generation drawn again"
    assert said[2].startswith("changed    ")
    assert said[2].endswith(", of 7 worlds of no generation")
    assert said[3] == f"nominal    {nominal:.3f} m/s, in the task's own world; so are all below"
    found = json.loads((tmp_path / "found.json").read_text())
    assert (found["fitness"], found["again"], found["nominal"]) == (champion.fitness, champion.fitness, nominal)
    assert run.settings.robust is not None
    worlds = draw_worlds(run.task, msgspec.structs.replace(run.settings.robust, worlds=7), run.settings.seed, 0)
    assert found["worlds"] == [Simulator(world).rollout(champion.theta[None]).fitness[0] for world in worlds]
    assert found["judged"] == "median of 4 changed worlds"
    assert main(["evaluate", str(made), "--repeats", "150"]) == 0
    assert ", of 100 worlds of no generation" in capsys.readouterr().out


def test_evaluate_notes_a_champion_of_other_bits(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in made.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    run = Run.open(tmp_path)
    run.champion = msgspec.structs.replace(run.checked_champion(), generation=1 + run.checked_champion().generation)
    run.write_champion()
    assert main(["evaluate", str(tmp_path), "--repeats", "2"]) == 0
    assert "m/s, not the same: another version or machine made the run" in capsys.readouterr().out


FAST = ["--task", "flat", "--steps", "40", "--evaluations", "42", "--no-video"]


def test_the_command_line_evolves_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["evolve", *FAST, "--robust"]) == 0
    said = capsys.readouterr().out
    assert "evolving flat, small, pressure, robust, seed 0: 374 parameters, 42 evaluations, each median of 5" in said
    assert " m/s, median of 5 changed worlds, generation " in said
    assert "of 30 starts moved by 1e-6 m" in said
    folder = Path("runs/flat-small-pressure-s0-robust")
    assert Run.open(folder).settings.robust == Robust()
    assert main(["resume", str(folder), "--evaluations", "63", "--no-video"]) == 0
    assert "resuming flat, small, pressure, robust, seed 0 after 42 evaluations" in capsys.readouterr().out
    assert bits_of(Run.open(folder)) == bits_of(evolve(make_task("flat", steps=40), 63, robust=Robust()))
    options = ["--robust-worlds", "2", "--robust-keep", "worst", "--robust-gas", "0", "--robust-shift", "0.5"]
    assert main(["evolve", *FAST, *options]) == 0  # any of them asks for it
    assert Run.open(f"{folder}-2").settings.robust == Robust(worlds=2, keep="worst", gas=0, shift=0.5)
    assert main(["evolve", *FAST]) == 0
    assert Run.open("runs/flat-small-pressure-s0").settings.robust is None


def test_the_video_says_what_is_seen(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, titles = Run.open(made), []
    from turgor.view import video

    draw = video.write_video
    monkeypatch.setattr(video, "write_video", lambda *a, title, **k: titles.append(title) or draw(*a, title=title, **k))
    assert main(["video", str(made), "--size", "64x64", "--to", "0.05", "--out", str(tmp_path / "a.mp4")]) == 0
    nominal = Simulator(run.task).rollout(run.checked_champion().theta[None]).fitness[0]
    assert titles == [f"escape, small, pressure, robust, seed 0: {nominal:.2f} m/s"]


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        (["--robust-worlds", "0"], "robust worlds: expected a whole number, 1 to 100; got 0"),
        (["--robust-worlds", "x"], "--robust-worlds: expected a whole number; got 'x'"),
        (["--robust-keep", "best"], "--robust-keep: expected one of median, worst; got 'best'"),
        (["--robust", "--robust-friction", "2"], "robust friction: expected a number from 0 to 1; got 2.0"),
        (["--robust", "yes"], "turgor evolve: expected options; got 'yes'"),
        (["--robust-frictions", "0.1"], "there is no option --robust-frictions; did you mean --robust-friction?"),
    ],
)
def test_errors_are_one_line(
    argv: list[str], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["evolve", *argv]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line
    assert not list(tmp_path.iterdir())
