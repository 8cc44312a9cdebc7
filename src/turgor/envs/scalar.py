"""One agent at a time: `gymnasium.make("turgor/Hilly-v0")`."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import numpy as np
from gymnasium import error, logger
from gymnasium.envs.registration import EnvSpec

from turgor.envs import tasks
from turgor.envs.rendering import Canvas, Window
from turgor.errors import InvalidInput, describe
from turgor.simulate import Simulator, Step
from turgor.task import Task
from turgor.variants import Condition
from turgor.view.draw import checked_size


class Env(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task for one agent that is driven from outside.

    Observation: the window's mean that a controller of turgor sees, float32 [input]. Action: spring commands, then the
    chambers' pressure commands, float32 [output], all in [-1, 1]. docs/environments.md tells the units.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 60}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        *,
        body: Any = "small",
        condition: Condition = "pressure",
        seed_terrain: int | None = None,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 360),
        **variants: Any,
    ) -> None:
        """`task` is "hilly", "flat", "escape" or "inflate"; `variants` are those of `turgor.make_task`.
        `seed_terrain` None: every reset draws a terrain. `render_size` [px]: width and height.
        Raises Gymnasium's `Error`."""
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise error.UnsupportedMode(f"render_mode: expected None, human or rgb_array; got {render_mode!r}")
        try:
            self.render_size = checked_size(render_size)
        except InvalidInput as refused:
            raise error.Error(f"render_{refused}") from None
        self.render_mode = render_mode
        self._rules = tasks.Rules(
            name=task, body=body, condition=condition, seed_terrain=seed_terrain, variants=variants
        )
        self._task = self._rules.task(seed_terrain or 0)
        self._spec: EnvSpec | None = None
        self._terrain: int | None = None  # of the present episode; None: before the first reset
        self._steps = 0  # of the present episode
        self._over = False
        self._canvas: Canvas | None = None
        self._window: Window | None = None
        self.observation_space = tasks.observation_space(self._task)
        self.action_space = tasks.action_space(self._task)
        self.metadata = self.metadata | {"render_fps": round(1 / self._task.physics.dt)}

    @property
    def task(self) -> Task:
        """The present episode's `Task`."""
        return self._task

    @property
    def spec(self) -> EnvSpec | None:
        """How `gymnasium.make` made this environment, with the steps after which it ends an episode."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else dataclasses.replace(spec, max_episode_steps=self._task.steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The first observation of a new episode, and its info, with the terrain's seed as `terrain`."""
        super().reset(seed=seed)
        if options:
            raise error.Error(f"options: expected none; got {describe(options)}")
        stand = self._begin(self._rules.draw(self.np_random))
        info = self._info(stand, self._score(stand).fitness)
        if self._rules.has_terrain:
            info["terrain"] = self._terrain
        self._show()
        return tasks.observations(stand)[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Observation, reward, terminated, truncated and info after one step."""
        if self._terrain is None:
            raise error.ResetNeeded("step: expected an episode that has begun; call reset first")
        if self._over:
            raise error.ResetNeeded("step: expected an episode that is not over; call reset to begin the next one")
        stand = self._advance(tasks.commands(action, self.action_space.shape))  # ty: ignore[invalid-argument-type]
        score = self._score(stand)
        reward, self._gain = score.gain - self._gain, score.gain
        terminated = bool(stand.solved[0])
        truncated = self._steps >= self._task.steps
        self._over = terminated or truncated
        info = self._info(stand, score.fitness)
        self._show()
        return tasks.observations(stand)[0], float(reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The present picture, uint8 [height, width, 3], with `render_mode="rgb_array"`; otherwise None."""
        if self.render_mode is None:
            logger.warn('render: expected a render_mode, as in gymnasium.make(..., render_mode="rgb_array")')
            return None
        if self._canvas is None:
            raise error.ResetNeeded("render: expected an episode that has begun; call reset first")
        if self.render_mode == "rgb_array":
            return self._canvas.frame()
        self._show()
        return None

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None

    def _begin(self, terrain: int) -> Step:
        """Puts the agent at the start on that terrain."""
        if terrain != self._terrain:
            self._task = self._rules.task(terrain)
            self._simulator, self._measure = Simulator(self._task, threads=1), tasks.Measure(self._task)
            self._terrain = terrain
        stand = self._simulator.reset(1)
        self._start = self._measure.centre(stand.position)
        self._gain, self._steps, self._over = np.zeros(1), 0, False
        self._canvas = None if self.render_mode is None else Canvas(self._task, self.render_size)
        self._film(stand)
        return stand

    def _advance(self, commands: np.ndarray) -> Step:
        """One step of the simulator."""
        self._steps += 1
        stand = self._simulator.step(commands[None])
        self._film(stand)
        return stand

    def _score(self, stand: Step) -> tasks.Score:
        return self._measure.score(stand.position, self._start, np.array([self._steps]))

    def _info(self, stand: Step, fitness: np.ndarray) -> dict[str, Any]:
        told = self._measure.infos(stand, fitness)
        return {name: values[0].copy() if values.ndim > 1 else values[0].item() for name, values in told.items()}

    def _film(self, stand: Step) -> None:
        if self._canvas is not None:
            self._canvas.add(stand)

    def _show(self) -> None:
        """The present picture in the window, opened when first needed."""
        if self.render_mode == "human" and self._canvas is not None:
            if self._window is None:
                title = self._rules.name if self._spec is None else self._spec.id
                self._window = Window(self.render_size, title, self.metadata["render_fps"])
            self._window.show(self._canvas.surface())

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_window": None}
