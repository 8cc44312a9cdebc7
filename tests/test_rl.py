"""Stable-Baselines3 over the vector environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from turgor.errors import InvalidInput

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from turgor.rl import SB3VecEnv


def made(name: str, number: int = 3, mode: AutoresetMode = AutoresetMode.SAME_STEP, **keywords: Any) -> SB3VecEnv:
    return SB3VecEnv(gymnasium.make_vec(name, num_envs=number, autoreset_mode=mode, **keywords))


@pytest.mark.parametrize("name", ["turgor/Hilly-v0", "turgor/Escape-v0"])
def test_tells_what_stable_baselines_own_tells(name: str) -> None:
    """The same steps as SB3's environments one by one: observations, rewards, ends, infos at the end."""
    cage = {"cage_width": 0.1, "cage_wall": 0.1} if "Escape" in name else {}
    ours, theirs = made(name, steps=7, **cage), make_vec_env(name, 3, env_kwargs={"steps": 7, **cage})
    for envs in (ours, theirs):
        envs.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    assert ours.reset_infos == theirs.reset_infos
    random = np.random.default_rng(0)
    for _ in range(20):
        actions = random.uniform(-1, 1, (3, 11)).astype(np.float32)
        one, other = ours.step(actions), theirs.step(actions)
        for a, b in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        assert ours.reset_infos == theirs.reset_infos
        for done, info, expected in zip(one[2], one[3], other[3], strict=True):
            if done:
                np.testing.assert_array_equal(info.pop("terminal_observation"), expected.pop("terminal_observation"))
                expected.pop("episode")  # of their Monitor
                assert info == expected
            else:
                assert info == {}


def test_learns_evaluates_and_stores() -> None:
    envs = VecMonitor(made("turgor/Flat-v0", steps=20))
    model = PPO("MlpPolicy", envs, n_steps=32, batch_size=48, n_epochs=1, seed=0, device="cpu")
    model.learn(192)
    assert len(model.ep_info_buffer) == 9
    assert {info["l"] for info in model.ep_info_buffer} == {20}
    mean, _ = evaluate_policy(model, envs, n_eval_episodes=3)
    assert np.isfinite(mean)


def test_seed_is_used_once() -> None:
    envs = made("turgor/Hilly-v0")
    envs.seed(3)
    terrains = []
    for _ in range(2):
        envs.reset()
        terrains.append([info["terrain"] for info in envs.reset_infos])
    assert not set(terrains[0]) & set(terrains[1])
    envs.seed(3)
    envs.reset()
    assert [info["terrain"] for info in envs.reset_infos] == terrains[0]


def test_attributes_are_shared() -> None:
    envs = made("turgor/Flat-v0")
    assert envs.get_attr("num_envs", [0, 2]) == [3, 3]
    assert not envs.has_attr("wheels")
    envs.set_attr("has_wheels", lambda: True)
    envs.set_attr("wheels", 4)
    assert envs.get_attr("wheels") == [4, 4, 4]
    assert envs.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    assert envs.env_method("has_wheels") == [True] * 3
    for call in (lambda: envs.set_attr("wheels", 4, 0), lambda: envs.env_method("close", indices=[1])):
        with pytest.raises(InvalidInput, match="expected no indices"):
            call()


def test_pictures() -> None:
    envs = made("turgor/Flat-v0", 2, render_mode="rgb_array", render_size=(64, 64))
    envs.reset()
    assert envs.render().shape == (128, 64, 3)
    envs.close()


def test_what_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"autoreset_mode=SAME_STEP; got AutoresetMode\.NEXT_STEP"):
        made("turgor/Flat-v0", mode=AutoresetMode.NEXT_STEP)
    envs = made("turgor/Flat-v0")
    envs.set_options([{}, {"a": 1}, {}])
    with pytest.raises(InvalidInput, match="options: expected the same"):
        envs.reset()
