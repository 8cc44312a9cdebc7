"""The native vector environment: what environment i does, the scalar environment does, bit for bit."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import error
from gymnasium.utils.performance import benchmark_vector_step
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics, RecordVideo

import turgor
from turgor.envs.registration import ENVIRONMENTS
from turgor.envs.vector import VectorEnv

NAMES = list(ENVIRONMENTS)
OPEN_CAGE = {"cage_width": 0.1, "cage_wall": 0.85, "cage_aperture": 10.9}  # left by spreading a little


def make(name: str, num_envs: int, **keywords: Any) -> VectorEnv:
    env = gymnasium.make_vec(name, num_envs=num_envs, **keywords)
    assert isinstance(env, VectorEnv)
    return env


def sync(name: str, num_envs: int, mode: AutoresetMode, **keywords: Any) -> SyncVectorEnv:
    env = gymnasium.make_vec(
        name, num_envs=num_envs, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **keywords
    )
    assert isinstance(env, SyncVectorEnv)
    return env


def actions(steps: int, num_envs: int, outputs: int = 11, seed: int = 0) -> np.ndarray:
    """[step, env, output]: waves, a little beyond 1 at times."""
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0, 7, (2, num_envs, outputs))
    return (1.1 * np.sin(phase + 0.04 * speed * np.arange(steps)[:, None, None])).astype(np.float32)


def equal(mine: Any, theirs: Any, where: str = "") -> None:
    """The same keys, types, shapes and bits."""
    if isinstance(theirs, dict):
        assert set(mine) == set(theirs), where
        for key in theirs:
            equal(mine[key], theirs[key], f"{where}/{key}")
    elif theirs.dtype == object:
        assert mine.dtype == object
        for k, (one, other) in enumerate(zip(mine, theirs, strict=True)):
            assert (one is None) == (other is None), f"{where}[{k}]"
            if one is not None:
                equal(one, other, f"{where}[{k}]")
    else:
        assert (mine.dtype, mine.shape) == (theirs.dtype, theirs.shape), where
        assert mine.tobytes() == theirs.tobytes(), where


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("turgor/Hilly-v0", {"steps": 40}),
        ("turgor/Hilly-v0", {"steps": 40, "seed_terrain": 3, "condition": "springs"}),
        ("turgor/Escape-v0", {"steps": 70, **OPEN_CAGE}),
        ("turgor/Inflate-v0", {"steps": 30, "body": "medium"}),
        ("turgor/Flat-v0", {"steps": 30, "window": 7, "fitness": "elapsed"}),
    ],
)
def test_every_environment_is_the_scalar_one(name: str, keywords: dict[str, Any], mode: AutoresetMode) -> None:
    """Gymnasium's own SyncVectorEnv over scalar environments returns the same, infos included, over several episodes;
    in the cage they end at different times."""
    count = 19
    mine, theirs = make(name, count, autoreset_mode=mode, **keywords), sync(name, count, mode, **keywords)
    equal_spaces(mine, theirs)
    for seed in (5, None, [None, 3] * 9 + [2]):
        one, other = mine.reset(seed=seed), theirs.reset(seed=seed)
        if seed is None or isinstance(seed, list):
            for environment, random in zip(theirs.envs, mine.np_random, strict=True):  # not seeded: not alike
                environment.unwrapped.np_random = copy.deepcopy(random)
            one, other = mine.reset(), theirs.reset()
        for a, b in zip(one, other, strict=True):
            equal(a, b, "reset")
        ends = np.zeros(count, dtype=int)
        for t, action in enumerate(actions(100, count, mine.single_action_space.shape[0])):
            one, other = mine.step(action), theirs.step(np.array(action))
            for part, a, b in zip(
                ("observation", "reward", "terminated", "truncated", "info"), one, other, strict=True
            ):
                equal(a, b, f"{part} in step {t}")
            ends += one[2] | one[3]
        assert (ends >= 1).all()
    if name == "turgor/Escape-v0":
        assert len(np.unique(ends)) > 1


def equal_spaces(mine: VectorEnv, theirs: SyncVectorEnv) -> None:
    for space in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(mine, space) == getattr(theirs, space)
    assert mine.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    assert mine.metadata["render_fps"] == theirs.metadata["render_fps"]


def test_resets_by_a_mask() -> None:
    """Gymnasium's DISABLED mode."""
    count, mode = 18, AutoresetMode.DISABLED
    keywords = {"steps": 25}
    mine, theirs = (
        make("turgor/Hilly-v0", count, autoreset_mode=mode, **keywords),
        sync("turgor/Hilly-v0", count, mode, **keywords),
    )
    for a, b in zip(mine.reset(seed=1), theirs.reset(seed=1), strict=True):
        equal(a, b)
    drive, rng = iter(actions(90, count)), np.random.default_rng(0)
    for t, action in enumerate(drive):
        one, other = mine.step(action), theirs.step(action)
        for a, b in zip(one, other, strict=True):
            equal(a, b, f"step {t}")
        over = one[2] | one[3] | (rng.uniform(size=count) < 0.1)
        if over.any():
            seed = None if t % 2 else 100 + t
            again = [env.reset(seed=seed, options={"reset_mask": over.copy()}) for env in (mine, theirs)]
            for a, b in zip(*again, strict=True):
                equal(a, b, f"reset after step {t}")
    mine.reset(seed=2)
    for action in actions(25, count):
        _, _, _, truncated, _ = mine.step(action)
    assert truncated.all()
    with pytest.raises(error.ResetNeeded, match=r"18 are, the first in environment 0; call reset\(options="):
        mine.step(action)


@pytest.mark.usefixtures("all_threads")
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_do_not_matter(threads: int) -> None:
    one, many = (make("turgor/Hilly-v0", 50, threads=n, steps=20) for n in (1, threads))
    equal(one.reset(seed=0)[0], many.reset(seed=0)[0])
    for action in actions(45, 50):
        for a, b in zip(one.step(action), many.step(action), strict=True):
            equal(a, b)


def test_observations_without_a_copy() -> None:
    env = make("turgor/Flat-v0", 4, copy=False)
    first, _ = env.reset(seed=0)
    later = [env.step(action)[0] for action in actions(3, 4)]
    assert all(np.shares_memory(observation, first) for observation in later)
    assert first.flags.c_contiguous
    env = make("turgor/Flat-v0", 4)
    first, _ = env.reset(seed=0)
    kept = first.copy()
    env.step(actions(1, 4)[0])
    env.reset()
    np.testing.assert_array_equal(first, kept)


def test_ignored_actions_may_be_anything() -> None:
    env = make("turgor/Flat-v0", 3, steps=1)
    env.reset(seed=0)
    env.step(np.zeros((3, 11)))
    observation, rewards, _, truncated, _ = env.step(np.full((3, 11), np.nan))
    assert not truncated.any()
    assert not rewards.any()
    equal(observation, env.reset()[0])


def test_limit_of_episodes() -> None:
    env = make("turgor/Flat-v0", 2, max_episode_steps=5)
    env.reset(seed=0)
    ends = [env.step(action)[3].all() for action in actions(6, 2)]
    assert ends == [False] * 4 + [True, False]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_copy_goes_on_alike(copied: Any, mode: AutoresetMode) -> None:
    env = make("turgor/Hilly-v0", 17, steps=30, autoreset_mode=mode, render_mode="rgb_array", render_size=(160, 90))
    env.reset(seed=4)
    drive = actions(80, 17)
    for action in drive[:20]:
        env.step(action)
    twin = copied(env)
    for action in drive[20:]:
        for a, b in zip(env.step(action), twin.step(action), strict=True):
            equal(a, b)
    for a, b in zip(env.render(), twin.render(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_wrappers(tmp_path: Any) -> None:
    env = make("turgor/Hilly-v0", 3, steps=12, render_mode="rgb_array", render_size=(160, 90))
    env = RecordVideo(RecordEpisodeStatistics(env), str(tmp_path / "videos"), video_length=12)
    env.reset(seed=0)
    total = np.zeros(3)
    for action in actions(12, 3):
        _, rewards, _, truncated, info = env.step(action)
        total += rewards
    assert truncated.all()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    env.close()
    assert list(tmp_path.glob("videos/*.mp4"))


def test_pictures_are_those_of_the_scalar_environment() -> None:
    env = make("turgor/Hilly-v0", 3, render_mode="rgb_array", steps=30)
    env.reset(seed=6)
    one = gymnasium.make("turgor/Hilly-v0", render_mode="rgb_array", steps=30)
    one.reset(seed=8)
    for action in actions(20, 3):
        env.step(action)
        one.step(action[2])
    frames = env.render()
    assert len(frames) == 3
    np.testing.assert_array_equal(frames[2], one.render())


@pytest.mark.parametrize("name", NAMES)
def test_gymnasiums_benchmark_runs(name: str) -> None:
    env = make(name, 64, steps=20, autoreset_mode="SameStep")
    assert benchmark_vector_step(env, target_duration=0.2, seed=0) > 1000


REFUSED = [
    ({"num_envs": 0}, "num_envs: expected a whole number, at least 1; got 0"),
    ({"autoreset_mode": "sometimes"}, "autoreset_mode: expected one of NextStep, SameStep, Disabled"),
    ({"threads": 0}, "threads: expected a whole number, 1 to 1024"),
    ({"gravty": 9.81}, "unknown keyword 'gravty'; did you mean gravity"),
    ({"max_episode_steps": 0}, "max_episode_steps: expected None or a whole number, at least 1; got 0"),
    ({"render_mode": "human"}, "render_mode: expected None or rgb_array; got 'human'"),
    ({"render_mode": "rgb_array", "render_size": (1, 1)}, "expected"),
]


@pytest.mark.parametrize(("keywords", "message"), REFUSED)
def test_impossible_environment(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(error.Error) as caught:
        make("turgor/Hilly-v0", **{"num_envs": 2, **keywords})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_impossible_steps_and_resets() -> None:
    env = make("turgor/Hilly-v0", 2)
    with pytest.raises(error.ResetNeeded, match="call reset first"):
        env.step(np.zeros((2, 11)))
    with pytest.raises(error.ResetNeeded, match="without a mask first"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    with pytest.raises(error.InvalidAction, match=r"shape \[2, 11\], within \[-1, 1\]; got shape \[11\]"):
        env.step(np.zeros(11))
    with pytest.raises(error.InvalidAction, match=r"got nan at \[1, 3\]"):
        env.step(np.where(np.arange(22).reshape(2, 11) == 14, np.nan, 0.0))
    for mask in (np.zeros(2, bool), np.array([0, 1]), np.ones(3, bool)):
        with pytest.raises(error.Error, match=r"reset_mask: expected bools of shape \[2\]"):
            env.reset(options={"reset_mask": mask})
    with pytest.raises(error.Error, match="options: expected none but reset_mask"):
        env.reset(options={"terrain": 1})
    with pytest.raises(error.Error, match="seed: expected one number, or 2 of them; got 3"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(error.Error, match="Seed"):
        env.reset(seed=-5)
    assert repr(env) == "VectorEnv(turgor/Hilly-v0, num_envs=2)"
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_terrains_are_the_tasks() -> None:
    env = make("turgor/Hilly-v0", 5)
    _, info = env.reset(seed=3)
    for k in range(5):
        task = turgor.make_task("hilly", seed=int(info["terrain"][k]))
        expected = task.position.astype(np.float32)
        np.testing.assert_array_equal(env._stand.position[k], expected)
