"""Strategy and loop: bits that depend on the seed alone, pauses that leave no trace, honest ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from turgor.errors import InvalidInput
from turgor.evolution.cma_es import CMAES
from turgor.evolution.loop import Progress, evaluate, evolve, resume
from turgor.evolution.strategy import Degenerate
from turgor.runs import Run
from turgor.simulate import Simulator
from turgor.task import Task, make_task

GENERATIONS, POPULATION = 12, 21


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("flat", steps=40)


def slope(theta: np.ndarray) -> np.ndarray:
    return -np.sum(np.arange(1, theta.shape[1] + 1) * np.square(theta - 1), axis=1)


def generations(strategy: CMAES, count: int, fitness: Any = slope) -> list[np.ndarray]:
    asked = []
    for _ in range(count):
        asked.append(strategy.ask())
        strategy.tell(asked[-1], fitness(asked[-1]))
    return asked


def without_seconds(run: Run) -> list[tuple[Any, ...]]:
    return [row[:-1] for row in run.rows]


# --- the strategy -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "population"), [(374, 21), (784, 23), (1344, 25), (1, 4)])
def test_population_follows_the_number_of_parameters(count: int, population: int) -> None:
    assert CMAES(count, np.random.default_rng(0)).population == population


def test_first_generation_is_drawn_around_a_mean_within_one() -> None:
    theta = CMAES(50, np.random.default_rng(0), population=2000).ask()
    assert (np.abs(theta.mean(axis=0)) < 1.1).all()
    np.testing.assert_allclose(theta.std(axis=0), 0.5, atol=0.06)


def test_it_maximises() -> None:
    strategy = CMAES(10, np.random.default_rng(0))
    assert slope(generations(strategy, 200)[-1]).max() > -1e-3


@pytest.mark.parametrize("parameters", [5, 120])
def test_it_is_the_algorithm_that_pycma_runs(parameters: int) -> None:
    """Its own update and decomposition change nothing but the rounding."""
    ours = CMAES(parameters, np.random.default_rng(0))
    theirs = CMAES(parameters, np.random.default_rng(0))
    del theirs._evolution.sm.update  # the method of its class again
    theirs._evolution.sm.eigenmethod = np.linalg.eigh
    for _ in range(40):
        theta, same = ours.ask(), theirs.ask()
        np.testing.assert_allclose(theta, same, rtol=0, atol=1e-7)
        fitness = -(theta**2 * np.linspace(1, 5, parameters)).sum(axis=1)
        ours.tell(theta, fitness)
        theirs.tell(same, fitness)
        np.testing.assert_allclose(ours._evolution.sm.C, theirs._evolution.sm.C, rtol=0, atol=1e-8)
    assert ours._evolution.sm.count_eigen == theirs._evolution.sm.count_eigen > 1


def test_seed_decides_every_bit_and_the_global_generator_stays_as_it_is() -> None:
    np.random.seed(7)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    runs = [generations(CMAES(30, np.random.default_rng(seed)), 5) for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_interleaved_strategies_do_not_disturb_each_other() -> None:
    alone = generations(CMAES(30, np.random.default_rng(0)), 6)
    one, other = CMAES(30, np.random.default_rng(0)), CMAES(40, np.random.default_rng(5))
    together = []
    for _ in range(6):
        together += generations(one, 1)
        generations(other, 1)
    assert np.array_equal(alone, together)


@pytest.mark.parametrize("count", [1, 5, 120])
@pytest.mark.parametrize("after", [0, 1, 9, 30])
def test_restored_state_goes_on_with_the_same_bits(count: int, after: int, tmp_path: Path) -> None:
    strategy = CMAES(count, np.random.default_rng(3))
    generations(strategy, after)
    np.savez(tmp_path / "state.npz", **strategy.state())  # ty: ignore[invalid-argument-type]
    expected = generations(strategy, 25)
    with np.load(tmp_path / "state.npz", allow_pickle=False) as arrays:
        state = {name: arrays[name] for name in arrays.files}
    restored = CMAES(count + 1, np.random.default_rng(99))
    restored.restore(state)
    assert np.array_equal(generations(restored, 25), expected)
    assert restored.sigma == strategy.sigma


def test_state_taken_between_ask_and_tell_asks_the_same_again() -> None:
    strategy = CMAES(30, np.random.default_rng(3))
    generations(strategy, 8)
    asked = strategy.ask()
    restored = CMAES(30, np.random.default_rng(0))
    restored.restore(strategy.state())
    assert np.array_equal(restored.ask(), asked)


def test_state_is_a_copy() -> None:
    strategy = CMAES(30, np.random.default_rng(3))
    state = strategy.state()
    before = {name: value.copy() for name, value in state.items()}
    generations(strategy, 5)
    assert all(np.array_equal(state[name], before[name]) for name in before)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"C": None}, "no C"),
        ({"ps": np.zeros(3)}, r"shape \[30\] in ps"),
        ({"sigma": np.array(np.nan)}, "finite numbers of shape"),
        ({"mean": np.array(["a"] * 30)}, "finite numbers"),
        ({"C": -np.eye(30)}, "positive variances in C"),
        ({"D": np.zeros(30)}, "positive numbers in D"),
    ],
)
def test_state_of_another_kind_is_refused(change: dict[str, Any], text: str) -> None:
    state: dict[str, Any] = {**CMAES(30, np.random.default_rng(3)).state(), **change}
    with pytest.raises(InvalidInput, match=text):
        CMAES(30, np.random.default_rng(0)).restore({k: v for k, v in state.items() if v is not None})


@pytest.mark.parametrize("axes", [[1.0, 1e9], [1.0, 1e200], [1e-200, 1e200], [0.0, 1.0]])
def test_axes_that_float64_cannot_tell_apart_are_told(axes: list[float]) -> None:
    strategy = CMAES(2, np.random.default_rng(0))
    generations(strategy, 3)
    strategy._evolution.sm.D = np.array(axes)
    with pytest.raises(Degenerate, match="condition number is"):
        strategy._check(np.zeros(2))


def test_covariance_that_a_changed_state_turns_negative_is_told() -> None:
    strategy = CMAES(120, np.random.default_rng(0))
    generations(strategy, 3)
    state = strategy.state()
    strategy.restore({**state, "B": state["B"] * 1e-3})
    with pytest.raises(Degenerate, match="variance has become negative") as error:
        generations(strategy, 5)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 120


def test_bits_do_not_depend_on_the_threads_of_blas() -> None:
    code = (
        "import numpy as np, hashlib\n"
        "from turgor.evolution.cma_es import CMAES\n"
        "s = CMAES(340, np.random.default_rng(1))\n"
        "for _ in range(12): x = s.ask(); s.tell(x, -np.square(x).sum(axis=1))\n"
        "print(hashlib.sha256(s.ask().tobytes()).hexdigest())"
    )
    hashes = set()
    for threads in "12":
        variables = {name: threads for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")}
        done = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, **variables}, capture_output=True, text=True, check=True
        )
        hashes.add(done.stdout)
    assert len(hashes) == 1


def test_only_the_order_of_fitness_counts_and_nan_is_last() -> None:
    def ranks(theta: np.ndarray) -> np.ndarray:
        return np.argsort(np.argsort(slope(theta))).astype(float)

    def gaps(theta: np.ndarray) -> np.ndarray:
        return np.where(ranks(theta) > 0, 1e6 * ranks(theta), np.nan)

    runs = [generations(CMAES(20, np.random.default_rng(0)), 10, fitness) for fitness in (slope, ranks, gaps)]
    assert np.array_equal(runs[0], runs[1])
    assert np.array_equal(runs[0], runs[2])


def test_generations_of_nan_and_infinity_do_not_crash() -> None:
    for value in (np.nan, np.inf, -np.inf):
        theta = generations(CMAES(20, np.random.default_rng(0)), 10, lambda t, v=value: np.full(len(t), v))
        assert np.isfinite(theta).all()


@pytest.mark.parametrize(
    "fitness",
    [lambda t: t[:, 0], lambda t: -np.square(t).sum(axis=1), lambda t: -np.square(t * [1, 1e6, 1e12]).sum(axis=1)],
    ids=["without bound", "into a point", "ill-conditioned"],
)
def test_degenerate_numbers_are_told(fitness: Any) -> None:
    with pytest.raises(Degenerate, match=r"."):
        generations(CMAES(3, np.random.default_rng(0)), 8000, fitness)


@pytest.mark.parametrize(
    "change", [{"population": 3}, {"population": 10.5}, {"sigma": 0.0}, {"sigma": np.nan}, {"mean": [0.0, 1.0]}]
)
def test_impossible_settings_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match=next(iter(change))):
        CMAES(5, np.random.default_rng(0), **change)


def test_other_generators_are_refused() -> None:
    with pytest.raises(InvalidInput, match="PCG64"):
        CMAES(5, np.random.Generator(np.random.MT19937(0)))


# --- the loop -----------------------------------------------------------------------------------------------------


def test_history_champion_and_robust_fitness(task: Task) -> None:
    seen: list[Progress] = []
    run = evolve(task, GENERATIONS * POPULATION, seed=1, progress=seen.append, robust_repeats=7)
    assert run.status == "done"
    history = run.history
    assert history["evaluations"].tolist() == [POPULATION * k for k in range(1, GENERATIONS + 1)]
    assert (np.diff(history["best"]) >= 0).all()
    assert (history["median"] <= history["best"]).all()
    champion = run.checked_champion()
    assert history["best"][-1] == champion.fitness
    assert history["best"][champion.generation - 1] == champion.fitness
    simulator = Simulator(task)
    assert simulator.rollout(champion.theta[None]).fitness[0] == champion.fitness
    assert champion.robust_fitness == np.median(evaluate(simulator, champion.theta, 7).fitness)
    assert [p.generation for p in seen] == list(range(1, GENERATIONS + 1))
    assert seen[-1].seconds_left == 0
    assert sum(run.seconds.values()) == pytest.approx(2 * run.seconds["total"])


def test_public_name_works_whatever_is_imported_first() -> None:
    code = "import turgor.evolution.strategy, turgor; assert callable(turgor.evolve); assert turgor.CMAES"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_whole_generations(task: Task) -> None:
    assert evolve(task, 22, robust_repeats=1).evaluations == 42


def test_same_seed_same_bits_whatever_the_threads(task: Task) -> None:
    one, two = (evolve(task, 100, seed=2, threads=threads, robust_repeats=3) for threads in (1, 2))
    assert without_seconds(one) == without_seconds(two)
    assert np.array_equal(one.checked_champion().theta, two.checked_champion().theta)
    assert np.array_equal(one.checked_champion().robust, two.checked_champion().robust)


def test_pause_leaves_no_trace(task: Task, tmp_path: Path) -> None:
    whole = evolve(task, 200, seed=4, robust_repeats=3)

    def stop(progress: Progress) -> None:
        if progress.generation == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evolve(task, 200, seed=4, out=tmp_path / "run", progress=stop, robust_repeats=3)
    left = Run.open(tmp_path / "run")
    assert (left.status, left.generation) == ("interrupted", 4)
    resumed = resume(left)
    assert without_seconds(resumed) == without_seconds(whole)
    for run in (resumed, Run.open(tmp_path / "run")):
        assert run.status == "done"
        for name in ("theta", "fitness", "generation", "robust"):
            assert np.array_equal(getattr(run.checked_champion(), name), getattr(whole.checked_champion(), name))


def test_finished_run_can_be_evolved_further(task: Task, tmp_path: Path) -> None:
    run = evolve(task, 60, seed=4, out=tmp_path / "run", robust_repeats=2)
    with pytest.raises(InvalidInput, match="more than the 63 that are done"):
        resume(run)
    longer = resume(Run.open(tmp_path / "run"), 150)
    assert without_seconds(longer) == without_seconds(evolve(task, 150, seed=4, robust_repeats=2))


def test_first_interrupt_waits_for_the_generation_a_second_one_does_not(task: Task, tmp_path: Path) -> None:
    def interrupt(times: int) -> Any:
        def stop(progress: Progress) -> None:
            if progress.generation == 3:
                for _ in range(times):
                    signal.raise_signal(signal.SIGINT)

        return stop

    for times in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            evolve(task, 100, out=tmp_path / str(times), progress=interrupt(times), robust_repeats=1)
        run = Run.open(tmp_path / str(times))
        assert (run.status, run.generation) == ("interrupted", 3)
        assert (tmp_path / str(times) / "checkpoint.npz").exists() == (times == 1)
        assert resume(run).generation == 5
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_history_after_the_checkpoint_is_evolved_again(task: Task, tmp_path: Path) -> None:
    run = evolve(task, 60, out=tmp_path / "run", robust_repeats=1)
    history = tmp_path / "run" / "history.csv"
    history.write_text(history.read_text() + "4,84,9.5,1.0,0.5,3.0\n5,105,9")  # killed while it wrote
    run.status = "running"
    run.write_record()
    assert without_seconds(resume(Run.open(tmp_path / "run"), 63)) == without_seconds(run)


def test_agents_without_a_fitness_never_win(task: Task) -> None:
    def hostile(out: Any) -> np.ndarray:
        return np.where(np.arange(len(out.com)) % 2 == 0, np.nan, out.com[:, 0])

    run = evolve(msgspec.structs.replace(task, fitness=hostile), 60, robust_repeats=2)
    assert np.isfinite(run.checked_champion().fitness)
    assert (run.history["median"] == -np.inf).all()  # 11 of 21


def test_no_fitness_at_all_is_told(task: Task, tmp_path: Path) -> None:
    nothing = msgspec.structs.replace(task, fitness=lambda out: np.full(len(out.com), np.nan))
    with pytest.raises(InvalidInput, match="finite number from an agent of the first generation"):
        evolve(nothing, 60, out=tmp_path / "run")
    assert '"failed"' in (tmp_path / "run" / "run.json").read_text()


def test_degenerate_strategy_ends_the_run_with_a_note(task: Task, tmp_path: Path) -> None:
    class Breaks(CMAES):
        def ask(self) -> np.ndarray:
            if self._evolution.countiter == 2:
                raise Degenerate("its numbers broke down")
            return super().ask()

    run = evolve(task, 100, out=tmp_path / "run", strategy=Breaks, robust_repeats=2)
    assert (run.status, run.generation) == ("done", 2)
    assert run.note == "stopped in generation 3: its numbers broke down"
    assert Run.open(tmp_path / "run").checked_champion().robust_fitness is not None
    with pytest.raises(InvalidInput, match="numbers broke down"):
        resume(Run.open(tmp_path / "run"))


def test_best_solving_agent_is_kept_beside_the_best(tmp_path: Path) -> None:
    def out_there(position: np.ndarray) -> np.ndarray:
        return position[:, :, 0].mean(axis=1) < -0.01

    task = msgspec.structs.replace(make_task("flat", steps=40), end=out_there)
    run = evolve(task, 100, out=tmp_path / "run", robust_repeats=2)
    assert run.solver is not None
    assert run.solver.solved
    assert run.solver.fitness < 0 < run.checked_champion().fitness
    again = Run.open(tmp_path / "run", task)
    assert again.solver is not None
    assert np.array_equal(again.solver.theta, run.solver.theta)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"task": make_task("inflation")}, "controls something; got inflation, passive"),
        ({"evaluations": 0}, "evaluations: expected a whole number, at least 1"),
        ({"evaluations": 1e4}, "evaluations: expected a whole number"),
        ({"seed": -1}, "seed"),
        ({"threads": 0}, "threads"),
        ({"robust_repeats": 0}, "robust_repeats"),
    ],
)
def test_impossible_evolutions_are_refused(change: dict[str, Any], text: str, task: Task, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"task": task, "out": tmp_path / "run", **change}
    with pytest.raises(InvalidInput, match=text):
        evolve(**arguments)
    assert not (tmp_path / "run").exists()
