"""Many agents at once: `gymnasium.make_vec("turgor/Hilly-v0", num_envs=1024)`."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import error
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from turgor.envs import tasks
from turgor.envs.rendering import Canvas
from turgor.errors import InvalidInput, describe, one_of
from turgor.simulate import Simulator, Step
from turgor.task import Task
from turgor.variants import Condition
from turgor.view.draw import checked_size


class VectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batch of agents of one task, each on a terrain of its own, stepped by one call of the kernel.

    Environment i does what `turgor.envs.scalar.Env` does, bit for bit, in Gymnasium's order of things: seeds count up
    from the first one's, and what an episode's end brings is `autoreset_mode`'s.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 60}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        body: Any = "small",
        condition: Condition = "pressure",
        seed_terrain: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        threads: int | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 360),
        **variants: Any,
    ) -> None:
        """`copy` False: every step's observations are written to the same array. `threads` None: all cores.
        `max_episode_steps` truncates episodes earlier than the task's `steps`. The rest is as in the scalar
        environment. Raises Gymnasium's `Error`."""
        if not isinstance(num_envs, int) or num_envs < 1:
            raise error.Error(f"num_envs: expected a whole number, at least 1; got {describe(num_envs)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise error.UnsupportedMode(f"render_mode: expected None or rgb_array; got {render_mode!r}")
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = [mode.value for mode in AutoresetMode]
            raise error.Error(str(one_of("autoreset_mode", modes, autoreset_mode))) from None
        if max_episode_steps is not None and (not isinstance(max_episode_steps, int) or max_episode_steps < 1):
            expected = "max_episode_steps: expected None or a whole number, at least 1"
            raise error.Error(f"{expected}; got {describe(max_episode_steps)}")
        self._rules = tasks.Rules(
            name=task, body=body, condition=condition, seed_terrain=seed_terrain, variants=variants
        )
        self._task = self._rules.task(seed_terrain or 0)
        self._measure = tasks.Measure(self._task)
        try:
            self.render_size = checked_size(render_size)
            self._simulator = Simulator(self._task, threads=threads)
        except InvalidInput as refused:
            raise error.Error(str(refused)) from None
        self.num_envs, self.copy, self.render_mode = num_envs, copy, render_mode
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.metadata["render_fps"] = round(1 / self._task.physics.dt)
        self.single_observation_space = tasks.observation_space(self._task)
        self.single_action_space = tasks.action_space(self._task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._length = min(self._task.steps, max_episode_steps or self._task.steps)
        self._randoms: list[np.random.Generator | None] = [None] * num_envs
        self._seeds: list[int] = [-1] * num_envs
        self._stand: Step | None = None  # where the agents stand; None: before the first reset
        self._start = np.zeros(num_envs)  # [m], x of the centres of mass
        self._gain = np.zeros(num_envs)
        self._steps = np.zeros(num_envs, dtype=np.int64)  # of the present episodes
        self._over = np.zeros(num_envs, dtype=bool)
        self._terrain = np.zeros(num_envs, dtype=np.int64)  # seeds of the present episodes
        self._canvases: list[Canvas] = []

    @property
    def task(self) -> Task:
        """The environments' `Task`; where terrains are drawn, theirs differ from its scene and start."""
        return self._task

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # ty: ignore[incompatible-property-override]
        """The generators that draw the environments' terrains."""
        return tuple(self._random(k) for k in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # ty: ignore[incompatible-property-override]
        """Their seeds."""
        return tuple(self._seeds[k] for k, _ in enumerate(self.np_random))

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """First observations [env, input], and infos. `seed`: environment i gets seed + i, or the i-th of a list.
        `options={"reset_mask": mask}` [env, bool] resets these alone; the others stand where they stood."""
        which = self._reset_mask(options)
        self._seed(seed, which)
        stand = self._begin(which, out=None if self.copy else self._stand)
        info = self._infos(stand, self._score(stand).fitness, which)
        return tasks.observations(stand), self._with_terrain(info, which)

    def step(self, actions: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Observations [env, input], rewards [env], terminated [env], truncated [env] and infos after a step of every
        environment with its row of `actions` [env, output]."""
        if self._stand is None:
            raise error.ResetNeeded("step: expected episodes that have begun; call reset first")
        waiting = self._over  # since the step before
        if waiting.any():
            if self.autoreset_mode is AutoresetMode.DISABLED:
                raise error.ResetNeeded(
                    f"step: expected episodes that are not over; {waiting.sum()} are, the first in environment "
                    f'{waiting.argmax()}; call reset(options={{"reset_mask": terminated | truncated}}) first'
                )
            actions = self._without(actions, waiting)
        commands = tasks.commands(actions, self.action_space.shape)  # ty: ignore[invalid-argument-type]
        stand = self._simulator.step(commands, out=None if self.copy else self._stand)
        self._steps += 1
        score = self._score(stand)
        rewards, self._gain = score.gain - self._gain, score.gain
        terminated, truncated = stand.solved, self._steps >= self._length
        self._stand = stand
        self._film(~waiting)
        if waiting.any():  # NEXT_STEP: this step is the reset
            rewards[waiting] = 0.0
            terminated &= ~waiting
            truncated &= ~waiting
            stand = self._begin(waiting, out=stand)
            fitness = np.where(waiting, self._score(stand).fitness, score.fitness)
            info = self._with_terrain(self._infos(stand, fitness), waiting)
        else:
            info = self._infos(stand, score.fitness)
        self._over = over = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            info = self._begin_at_once(stand, info, over)
        return tasks.observations(self._stand), rewards, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The present pictures, uint8 [height, width, 3] each, with `render_mode="rgb_array"`; otherwise None."""
        if self.render_mode is None:
            gymnasium.logger.warn('render: expected a render_mode, as in make_vec(..., render_mode="rgb_array")')
            return None
        if not self._canvases:
            raise error.ResetNeeded("render: expected episodes that have begun; call reset first")
        return tuple(canvas.frame() for canvas in self._canvases)

    # --- resets ---------------------------------------------------------------------------------------------------

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        """Which environments a reset with `options` is for, bool [env]."""
        options = dict(options or {})
        which = options.pop("reset_mask", None)
        if options:
            raise error.Error(f"options: expected none but reset_mask; got {describe(options)}")
        if which is None:
            return np.ones(self.num_envs, dtype=bool)
        which = np.asarray(which)
        if which.dtype != bool or which.shape != (self.num_envs,) or not which.any():
            expected = f"reset_mask: expected bools of shape [{self.num_envs}], at least one of them true"
            raise error.Error(f"{expected}; got {which.dtype} of shape {list(which.shape)}, {int(which.sum())} true")
        if self._stand is None and not which.all():
            raise error.ResetNeeded("reset_mask: expected episodes that have begun; call reset without a mask first")
        return which.copy()

    def _seed(self, seed: int | list[int | None] | None, which: np.ndarray) -> None:
        seeds = [seed + k for k in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        if seeds is None:
            return
        if len(seeds) != self.num_envs:
            raise error.Error(f"seed: expected one number, or {self.num_envs} of them; got {len(seeds)}")
        for k in np.flatnonzero(which).tolist():
            if seeds[k] is not None:
                self._randoms[k], self._seeds[k] = seeding.np_random(seeds[k])

    def _random(self, k: int) -> np.random.Generator:
        random = self._randoms[k]
        if random is None:
            random, self._seeds[k] = seeding.np_random()
            self._randoms[k] = random
        return random

    def _begin(self, which: np.ndarray, out: Step | None) -> Step:
        """Begins a new episode in the environments `which` [env, bool]; returns where all agents stand, in `out` if
        there is one."""
        fresh = np.flatnonzero(which)
        own: list[Task] = []  # tasks of the terrains that were drawn
        if self._rules.has_terrain:
            self._terrain[fresh] = [self._rules.draw(self._random(k)) for k in fresh.tolist()]
            if self._rules.seed_terrain is None:
                own = [self._rules.task(terrain) for terrain in self._terrain[fresh].tolist()]
        position = np.stack([task.position for task in own]) if own else None
        scenes = [task.scene for task in own] if own else None
        if self._stand is None:
            self._stand = self._simulator.reset(self.num_envs, position, scenes=scenes)
        else:
            self._stand = self._simulator.restart(which, position, scenes=scenes, out=out)
        stand = self._stand
        self._start[fresh] = self._measure.centre(stand.position[fresh])
        self._gain[fresh], self._steps[fresh] = 0.0, 0
        self._over = self._over & ~which
        if self.render_mode is not None:
            self._canvases = self._canvases or [Canvas(self._task, self.render_size)] * self.num_envs
            for k, agent in enumerate(fresh.tolist()):
                self._canvases[agent] = Canvas(own[k] if own else self._task, self.render_size)
            self._film(which)
        return stand

    def _begin_at_once(self, stand: Step, info: dict[str, Any], over: np.ndarray) -> dict[str, Any]:
        """SAME_STEP: the infos of the episodes that have begun, with what the last ones ended with as `final_obs` and
        `final_info`."""
        last = np.full(self.num_envs, None, dtype=object)
        for k in np.flatnonzero(over).tolist():
            last[k] = tasks.observations(stand)[k].copy()
        final: dict[str, Any] = {}
        for name, values in info.items():
            if not name.startswith("_"):
                final[name] = _only(over, values)
                final[f"_{name}"] = over.copy()
        fitness = info["fitness"]
        stand = self._begin(over, out=stand)
        info = self._infos(stand, np.where(over, self._score(stand).fitness, fitness))
        ends = {"final_obs": last, "_final_obs": over.copy(), "final_info": final, "_final_info": over.copy()}
        return self._with_terrain(info, over) | ends

    def _without(self, actions: ArrayLike, waiting: np.ndarray) -> ArrayLike:
        """`actions` without those that nobody waits for: an environment that begins anew takes none."""
        array = np.array(actions, dtype=np.float32)
        if array.shape == self.action_space.shape:
            array[waiting] = 0.0
        return array

    # --- what is told ---------------------------------------------------------------------------------------------

    def _score(self, stand: Step) -> tasks.Score:
        return self._measure.score(stand.position, self._start, self._steps)

    def _infos(self, stand: Step, fitness: np.ndarray, which: np.ndarray | None = None) -> dict[str, Any]:
        """Infos as Gymnasium's vector environments have them: an array a name, and `_name` for which it is told."""
        info: dict[str, Any] = {}
        for name, values in self._measure.infos(stand, fitness).items():
            info[name] = values if which is None else _only(which, values)
            info[f"_{name}"] = np.ones(self.num_envs, dtype=bool) if which is None else which.copy()
        return info

    def _with_terrain(self, info: dict[str, Any], which: np.ndarray) -> dict[str, Any]:
        if self._rules.has_terrain:
            info |= {"terrain": _only(which, self._terrain), "_terrain": which.copy()}
        return info

    def _film(self, which: np.ndarray) -> None:
        if self.render_mode is not None and self._stand is not None:
            for agent in np.flatnonzero(which).tolist():
                self._canvases[agent].add(self._stand, agent)


def _only(which: np.ndarray, values: np.ndarray) -> np.ndarray:
    """`values` [env, ...] of the environments `which` [env, bool], 0 for the others."""
    out = np.zeros_like(values)
    out[which] = values[which]
    return out
