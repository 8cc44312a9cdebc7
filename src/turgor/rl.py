"""turgor's environments for Stable-Baselines3 (`pip install "turgor[rl]"`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import Wrapper
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from turgor.errors import InvalidInput, describe


class SB3VecEnv(VecEnv):
    """Stable-Baselines3's `VecEnv` over a Gymnasium vector environment that resets in the same step.

    The infos of a step are empty but for agents whose episode it ended: those have the episode's last info,
    `terminal_observation` and `TimeLimit.truncated`. `reset_infos` holds what each agent's last reset told.
    """

    def __init__(self, envs: VectorEnv) -> None:
        """Raises `InvalidInput` for another autoreset mode than SAME_STEP."""
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise InvalidInput("envs: expected a vector environment with autoreset_mode=SAME_STEP", describe(mode))
        self.envs: Any = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """The first observations [agent, input]. Uses the seeds of `seed` and the options of `set_options` once."""
        if any(options != self._options[0] for options in self._options):
            raise InvalidInput("options: expected the same for every agent", describe(self._options))
        seeds = None if None in self._seeds else self._seeds
        observations, told = self.envs.reset(seed=seeds, options=self._options[0] or None)
        self.reset_infos = [info_of(told, k) for k in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations [agent, input], rewards [agent], float32, dones [agent] and a dict for every agent."""
        observations, rewards, terminated, truncated, told = self.envs.step(self._actions)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(dones).tolist():
            infos[k] = info_of(told["final_info"], k)
            infos[k]["terminal_observation"] = told["final_obs"][k]
            infos[k]["TimeLimit.truncated"] = bool(truncated[k] and not terminated[k])
            self.reset_infos[k] = info_of(told, k)
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of every agent, with `render_mode="rgb_array"`."""
        return self.envs.render() or [None] * self.num_envs

    # Agents share one environment, and with it their attributes and methods.

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = getattr(self.envs, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        self._expect_all("set_attr", indices)
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        self._expect_all("env_method", indices)
        value = getattr(self.envs, method_name)(*method_args, **method_kwargs)
        return [value for _ in range(self.num_envs)]

    def env_is_wrapped(self, wrapper_class: type[Wrapper], indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def _expect_all(self, name: str, indices: Any) -> None:
        if indices is not None and list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise InvalidInput(f"{name}: expected no indices, because all agents share one environment", str(indices))


def info_of(told: dict[str, Any], agent: int) -> dict[str, Any]:
    """One agent's info out of those of a vector environment, without what is only there for others."""
    own = {}
    for name, values in told.items():
        if name.startswith("_") or name in ("final_obs", "final_info") or not told[f"_{name}"][agent]:
            continue
        value = values[agent]
        own[name] = value.item() if isinstance(value, np.generic) else value
    return own
