"""The built-in strategies: the published algorithms, bits that depend on the generator alone, honest ends."""

from __future__ import annotations

import inspect
import math
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turgor.errors import InvalidInput
from turgor.evolution import STRATEGIES
from turgor.evolution.loop import Progress, evolve, resume
from turgor.evolution.openai_es import OpenAIES, centred_ranks
from turgor.evolution.sep_cma_es import SepCMAES
from turgor.evolution.strategy import Degenerate, built_in
from turgor.runs import Run
from turgor.task import Task, make_task

EVERY = list(STRATEGIES)
OWN = [name for name in EVERY if name != "cma-es"]  # that one has tests of its own
ADAPTIVE = ["sep-cma-es", "lm-ma-es"]


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def sphere(theta: np.ndarray) -> np.ndarray:
    return -np.square(theta - 0.5).sum(axis=1)


def ellipsoid(theta: np.ndarray) -> np.ndarray:
    return -(np.square(theta - 0.5) * np.logspace(0, 3, theta.shape[1])).sum(axis=1)


def generations(strategy: Any, count: int, fitness: Any = ellipsoid) -> list[np.ndarray]:
    asked = []
    for _ in range(count):
        asked.append(strategy.ask())
        strategy.tell(asked[-1], fitness(asked[-1]))
    return asked


# --- they find the best -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ADAPTIVE)
@pytest.mark.parametrize(("parameters", "fitness"), [(1, sphere), (3, sphere), (20, sphere), (20, ellipsoid)])
def test_adaptive_strategies_converge(name: str, parameters: int, fitness: Any) -> None:
    strategy = built_in(name)(parameters, rng())
    assert any(fitness(*generations(strategy, 1, fitness)).max() > -1e-8 for _ in range(1500))


@pytest.mark.parametrize("fitness", [sphere, ellipsoid])
def test_openai_es_improves_until_its_step_size_is_too_large(fitness: Any) -> None:
    asked = generations(OpenAIES(20, rng(), sigma=0.1, alpha=0.05), 600, fitness)
    assert fitness(asked[-1].mean(axis=0)[None])[0] > 0.01 * fitness(asked[0].mean(axis=0)[None])[0]


@pytest.mark.parametrize("name", ADAPTIVE)
def test_populations_larger_than_the_number_of_parameters_converge(name: str) -> None:
    asked = generations(built_in(name)(4, rng(), population=40), 400, sphere)
    assert sphere(asked[-1]).max() > -1e-8


# --- they are the published algorithms ----------------------------------------------------------------------------


def test_sep_cma_es_is_what_the_cmaes_package_runs() -> None:
    """With the paper's learning rates in place of that package's, which scales the one of rank mu alone."""
    n, cmaes = 30, pytest.importorskip("cmaes")
    ours = SepCMAES(n, rng())
    theirs = cmaes.SepCMA(mean=ours._mean.copy(), sigma=0.5, population_size=ours.population)
    theirs._c1, theirs._cmu, theirs._g = ours._c_1, ours._c_mu, -1  # it counts from 1, the paper from 0
    np.testing.assert_allclose(theirs._weights, ours._w, rtol=1e-14)
    for _ in range(100):
        theta = ours.ask()
        fitness = ellipsoid(theta)
        ours.tell(theta, fitness)
        theirs.tell([(x, -f) for x, f in zip(theta, fitness, strict=True)])
        np.testing.assert_allclose(ours._mean, theirs._mean, rtol=0, atol=1e-10)
        np.testing.assert_allclose(ours._C, theirs._C, rtol=1e-10)
        np.testing.assert_allclose(ours._p_c, theirs._pc, rtol=0, atol=1e-10)
        assert ours.sigma == pytest.approx(theirs._sigma, rel=1e-10)


def test_sep_cma_es_has_the_learning_rates_of_2008() -> None:
    n, w = 30, [math.log(7 + 1) - math.log(i) for i in range(1, 8)]
    strategy = SepCMAES(n, rng(), population=14)
    mu_eff = sum(w) ** 2 / sum(x * x for x in w)
    c_cov = 1 / mu_eff * 2 / (n + 2**0.5) ** 2 + (1 - 1 / mu_eff) * min(1, (2 * mu_eff - 1) / ((n + 2) ** 2 + mu_eff))
    assert strategy._c_1 == pytest.approx((n + 2) / 3 * c_cov / mu_eff)
    assert strategy._c_mu == pytest.approx((n + 2) / 3 * c_cov * (1 - 1 / mu_eff))


def test_lm_ma_es_is_the_algorithm_of_the_paper() -> None:
    """Number by number: no vector, no matrix."""
    n, count = 12, 60
    strategy = built_in("lm-ma-es")(n, rng(3))
    same = rng(3)
    y, sigma = same.uniform(-1, 1, n).tolist(), 0.5
    lam = m = 4 + math.floor(3 * math.log(n))
    mu = lam // 2
    raw = [math.log(mu + 0.5) - math.log(i + 1) for i in range(mu)]
    w = [x / sum(raw) for x in raw]
    mu_w = 1 / sum(x * x for x in w)
    c_s = min(1, 2 * lam / n)  # 1 here, where the paper's is 1.83
    c_d = [1 / (1.5**i * n) for i in range(m)]
    c_c = [min(1, lam / (4**i * n)) for i in range(m)]
    p, vectors = [0.0] * n, [[0.0] * n for _ in range(m)]
    for t in range(count):
        z = same.standard_normal((lam, n)).tolist()
        d = [list(row) for row in z]
        for row in d:
            for j in range(min(t, m)):
                along = sum(vectors[j][k] * row[k] for k in range(n))
                for k in range(n):
                    row[k] = (1 - c_d[j]) * row[k] + c_d[j] * vectors[j][k] * along
        theta = np.array([[y[k] + sigma * row[k] for k in range(n)] for row in d])
        np.testing.assert_allclose(strategy.ask(), theta, rtol=0, atol=1e-8)
        asked = strategy._asked[0]
        fitness = ellipsoid(asked)
        strategy.tell(asked, fitness)
        order = sorted(range(lam), key=lambda i: -fitness[i])[:mu]
        y = [y[k] + sigma * sum(w[i] * d[order[i]][k] for i in range(mu)) for k in range(n)]
        z_w = [sum(w[i] * z[order[i]][k] for i in range(mu)) for k in range(n)]
        p = [(1 - c_s) * p[k] + (mu_w * c_s * (2 - c_s)) ** 0.5 * z_w[k] for k in range(n)]
        for i in range(m):
            keep, take = 1 - c_c[i], (mu_w * c_c[i] * (2 - c_c[i])) ** 0.5
            vectors[i] = [keep * vectors[i][k] + take * z_w[k] for k in range(n)]
        sigma *= math.exp(c_s / 2 * (sum(x * x for x in p) / n - 1))
        assert strategy.sigma == pytest.approx(sigma, rel=1e-8)


def test_openai_es_mirrors_its_agents_and_moves_them_by_adam() -> None:
    strategy = OpenAIES(5, rng(1), population=8, sigma=0.3, alpha=0.02)
    mean, m, v = strategy._mean.copy(), np.zeros(5), np.zeros(5)
    for t in range(1, 30):
        theta = strategy.ask()
        np.testing.assert_allclose(theta[:4] + theta[4:], np.broadcast_to(2 * mean, (4, 5)), atol=1e-14)
        fitness = ellipsoid(theta)
        ranks = np.argsort(np.argsort(fitness)) / 7 - 0.5
        strategy.tell(theta, fitness)
        g = sum(ranks[i] * (theta[i] - mean) / 0.3 for i in range(8)) / (8 * 0.3)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        mean = mean + 0.02 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8 / math.sqrt(1 - 0.999**t))
        np.testing.assert_allclose(strategy._mean, mean, rtol=0, atol=1e-12)


def test_equal_fitness_shares_a_rank() -> None:
    np.testing.assert_allclose(centred_ranks(np.array([3.0, 1, 2, 2, -7])), [0.5, -0.25, 0.125, 0.125, -0.5])
    strategy = OpenAIES(5, rng())
    before = strategy.ask()
    strategy.tell(before, np.full(strategy.population, np.nan))
    assert np.array_equal(strategy.state()["mean"], OpenAIES(5, rng()).state()["mean"])  # nothing learned, no step


# --- bits ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OWN)
def test_only_the_order_of_fitness_counts_and_nan_is_last(name: str) -> None:
    def ranks(theta: np.ndarray) -> np.ndarray:
        return np.argsort(np.argsort(ellipsoid(theta))).astype(float)

    def gaps(theta: np.ndarray) -> np.ndarray:
        return np.where(ranks(theta) > 0, 1e6 * ranks(theta), np.nan)

    runs = [generations(built_in(name)(20, rng()), 10, fitness) for fitness in (ellipsoid, ranks, gaps)]
    assert np.array_equal(runs[0], runs[1])
    assert np.array_equal(runs[0], runs[2])


@pytest.mark.parametrize("name", OWN)
def test_seed_decides_every_bit_and_the_global_generator_stays_as_it_is(name: str) -> None:
    np.random.seed(7)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    runs = [generations(built_in(name)(30, rng(seed)), 5) for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize("count", [1, 40])
@pytest.mark.parametrize("after", [0, 1, 9])
def test_restored_state_goes_on_with_the_same_bits(name: str, count: int, after: int, tmp_path: Path) -> None:
    strategy = built_in(name)(count, rng(3), population=10, sigma=0.3)
    generations(strategy, after)
    np.savez(tmp_path / "state.npz", **strategy.state())  # ty: ignore[invalid-argument-type]
    expected = generations(strategy, 15)
    with np.load(tmp_path / "state.npz", allow_pickle=False) as arrays:
        state = {key: arrays[key] for key in arrays.files}
    restored = built_in(name)(count + 1, rng(99))
    restored.restore(state)
    assert (restored.population, len(restored.ask())) == (10, 10)
    restored.restore(state)
    assert np.array_equal(generations(restored, 15), expected)
    assert restored.sigma == strategy.sigma


@pytest.mark.parametrize("name", OWN)
def test_state_taken_between_ask_and_tell_asks_the_same_again(name: str) -> None:
    strategy = built_in(name)(30, rng(3))
    generations(strategy, 8)
    asked = strategy.ask()
    restored = built_in(name)(30, rng())
    restored.restore(strategy.state())
    assert np.array_equal(restored.ask(), asked)
    for each in (strategy, restored):
        each.tell(asked, ellipsoid(asked))
    assert np.array_equal(restored.ask(), strategy.ask())


@pytest.mark.parametrize("name", OWN)
def test_state_is_a_copy_and_so_is_what_is_restored(name: str) -> None:
    strategy, other = (built_in(name)(30, rng(3)) for _ in range(2))
    generations(strategy, 3)
    state = strategy.state()
    before = {key: value.copy() for key, value in state.items()}
    other.restore(state)
    generations(strategy, 5)
    generations(other, 5)
    assert all(np.array_equal(state[key], before[key]) for key in before)


def test_bits_do_not_depend_on_the_threads_of_blas() -> None:
    code = (
        "import numpy as np, hashlib\n"
        "from turgor.evolution.strategy import built_in\n"
        f"for name in {OWN}:\n"
        "    s = built_in(name)(1344, np.random.default_rng(1), population=64)\n"
        "    for _ in range(8): x = s.ask(); s.tell(x, -np.square(x).sum(axis=1))\n"
        "    print(hashlib.sha256(s.ask().tobytes()).hexdigest())"
    )
    hashes = set()
    for threads in "12":
        variables = {name: threads for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")}
        done = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, **variables}, capture_output=True, text=True, check=True
        )
        hashes.add(done.stdout)
    assert len(hashes) == 1
    assert len(hashes.pop().split()) == len(OWN)


# --- what cannot be -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"p_sigma": None, "v": None}, "no (p_sigma|v)"),
        ({"p_sigma": np.zeros(3), "v": np.zeros(3)}, r"shape \[30\] in (p_sigma|v)"),
        ({"mean": np.zeros((30, 2))}, r"shape \[30\] in mean"),
        ({"sigma": np.array(np.nan)}, "finite numbers of shape"),
        ({"sigma": np.array(-1.0)}, "positive sigma"),
        ({"population": np.array(2)}, "population of 4 to 100000"),
        ({"mean": np.array(["a"] * 30)}, "finite numbers"),
        ({"generator": np.zeros(6)}, "in generator"),
    ],
)
def test_state_of_another_kind_is_refused(name: str, change: dict[str, Any], text: str) -> None:
    state: dict[str, Any] = built_in(name)(30, rng(3)).state()
    state |= {key: value for key, value in change.items() if key in state}
    with pytest.raises(InvalidInput, match=text):
        built_in(name)(30, rng()).restore({k: v for k, v in state.items() if v is not None})


def test_state_with_other_numbers_is_refused() -> None:
    for name, change, text in (
        ("sep-cma-es", {"C": np.zeros(30)}, "positive numbers in C"),
        ("lm-ma-es", {"m": np.zeros((3, 30))}, "vectors in m"),
    ):
        strategy = built_in(name)(30, rng())
        with pytest.raises(InvalidInput, match=text):
            strategy.restore({**strategy.state(), **change})


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize(
    "change", [{"population": 2}, {"population": 10.5}, {"sigma": 0.0}, {"sigma": np.nan}, {"mean": [0.0, 1.0]}]
)
def test_impossible_settings_are_refused(name: str, change: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match=next(iter(change))):
        built_in(name)(5, rng(), **change)
    with pytest.raises(InvalidInput, match="PCG64"):
        built_in(name)(5, np.random.Generator(np.random.MT19937(0)))
    with pytest.raises(InvalidInput, match="something to evolve"):
        built_in(name)(0, rng())


def test_openai_es_takes_pairs_and_a_positive_rate() -> None:
    assert [OpenAIES(n, rng()).population for n in (374, 784, 1344)] == [22, 24, 26]
    with pytest.raises(InvalidInput, match="population: expected an even whole number, 4 to 1000000; got 7"):
        OpenAIES(5, rng(), population=7)
    with pytest.raises(InvalidInput, match="alpha: expected a positive number"):
        OpenAIES(5, rng(), alpha=0.0)


@pytest.mark.parametrize("name", EVERY)
def test_only_what_was_asked_can_be_told(name: str) -> None:
    strategy = built_in(name)(5, rng())
    theta = strategy.ask()
    for wrong, text in ((theta[:-1], "theta"), (theta[:, :-1], "theta"), (theta * np.nan, "theta")):
        with pytest.raises(InvalidInput, match=f"{text}: expected finite numbers of shape"):
            strategy.tell(wrong, ellipsoid(wrong))
    with pytest.raises(InvalidInput, match="fitness: expected numbers of shape"):
        strategy.tell(theta, ellipsoid(theta)[:-1])
    if name == "lm-ma-es":
        with pytest.raises(InvalidInput, match="what lm-ma-es was asked for last"):
            strategy.tell(theta + 1, ellipsoid(theta))
    strategy.tell(theta, ellipsoid(theta))


@pytest.mark.parametrize("name", ADAPTIVE)
@pytest.mark.parametrize(
    "fitness", [lambda t: t[:, 0], lambda t: -np.square(t).sum(axis=1)], ids=["without bound", "into a point"]
)
def test_degenerate_numbers_are_told(name: str, fitness: Any) -> None:
    with pytest.raises(Degenerate, match=r"."):
        generations(built_in(name)(3, rng()), 20_000, fitness)


@given(
    name=st.sampled_from(EVERY),
    parameters=st.integers(1, 6),
    population=st.sampled_from([None, 4, 6, 30]),
    sigma=st.sampled_from([1e-160, 1e-12, 0.5, 1e3, 1e14]),
    seed=st.integers(0, 5),
    data=st.data(),
)
@settings(max_examples=150, deadline=None)
def test_whatever_the_fitness_it_goes_on_or_says_that_it_cannot(
    name: str, parameters: int, population: int | None, sigma: float, seed: int, data: st.DataObject
) -> None:
    numbers = st.one_of(st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e308, -1e308, 5e-324]), st.floats())
    try:
        strategy = built_in(name)(parameters, rng(seed), population=population, sigma=sigma)
        for _ in range(6):
            theta = strategy.ask()
            assert np.isfinite(theta).all()
            told = data.draw(st.lists(numbers, min_size=3, max_size=3))
            strategy.tell(theta, np.resize(told, strategy.population))
            again = built_in(name)(1, rng())
            again.restore(strategy.state())
            assert np.array_equal(again.ask(), strategy.ask())
    except Degenerate:
        pass


# --- docstrings, evolutions ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVERY)
def test_example_in_the_docstring_runs(name: str) -> None:
    text = inspect.getdoc(built_in(name)) or ""
    blocks = re.findall(r"\n\n((?: {4}.*\n)+)", text)
    code = "\n".join(line[4:] for line in blocks[0].splitlines()).replace("range(100)", "range(3)")
    names: dict[str, Any] = {"np": np, built_in(name).__name__: built_in(name)}
    exec(code, names)
    assert names["theta"].shape == (names["strategy"].population, len(names["theta"][0]))


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("flat", steps=40)


def without_seconds(run: Run) -> list[tuple[Any, ...]]:
    return [row[:-1] for row in run.rows]


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("started", [0, 4])
def test_pause_leaves_no_trace_and_resume_finds_the_strategy(
    name: str, started: int, task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = partial(built_in(name), population=16, sigma=0.2)
    whole = evolve(task, 100, 4, strategy=make, robust_repeats=2)
    assert (whole.settings.strategy, whole.settings.population, whole.settings.sigma) == (name, 16, 0.2)

    def stop(progress: Progress) -> None:
        if progress.generation == started:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if not started:  # killed before there was anything to go on from
            patch.setattr("turgor.evolution.loop._generations", lambda *_: stop(Progress(**dict.fromkeys(FIELDS, 0))))
            patch.setattr("turgor.runs.Run.write_checkpoint", lambda *_: None)
        with pytest.raises(KeyboardInterrupt):
            evolve(task, 100, 4, tmp_path / "run", strategy=make, progress=stop, robust_repeats=2)
    left = Run.open(tmp_path / "run")
    assert left.generation == started
    assert (tmp_path / "run" / "checkpoint.npz").exists() == (started > 0)
    assert without_seconds(resume(left)) == without_seconds(whole)


FIELDS = Progress.__struct_fields__


def test_strategy_by_its_name(task: Task) -> None:
    named, made = (evolve(task, 60, 1, strategy=s, robust_repeats=1) for s in ("sep-cma-es", SepCMAES))
    assert without_seconds(named) == without_seconds(made)
    with pytest.raises(
        InvalidInput, match="strategy: expected one of cma-es, sep-cma-es, lm-ma-es, openai-es; got 'x'"
    ):
        evolve(task, strategy="x")


def test_own_strategy_has_to_be_given_again(task: Task, tmp_path: Path) -> None:
    class Own(SepCMAES):
        name = "own"

    evolve(task, 40, strategy=Own, out=tmp_path / "run", robust_repeats=1)
    run = Run.open(tmp_path / "run")
    with pytest.raises(InvalidInput, match="one of your own that the run was evolved with; got none, and 'own' is not"):
        resume(run, 60)
    with pytest.raises(InvalidInput, match="strategy: expected own; got sep-cma-es"):
        resume(run, 60, strategy="sep-cma-es")
    assert resume(run, 60, strategy=Own).evaluations >= 60
