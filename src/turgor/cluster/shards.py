"""Shards: a population cut into parts, each simulated by a worker of its own."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from turgor.cluster.crew import Crew
from turgor.control import Sinusoid, check_theta
from turgor.physics.model import WIDTH
from turgor.rollout import Rollout, judge, starts_of
from turgor.simulate import Simulator
from turgor.task import Task

SMALLEST, LARGEST = 128, 512  # [agent], of a shard: far more work than the way to a worker and back; far less than all
SHARDS_A_THREAD = 4  # at most: so that they end together, and a death costs little
IN_HAND_A_THREAD = 2  # one is simulated while the next is on its way


class ShardedSimulator(Simulator):
    """A `Simulator` whose large batches are simulated by a cluster's workers, with the same bits."""

    def __init__(self, task: Task, executor: Any, *, threads: int | None = None) -> None:
        """`executor`: a Dask `Client`; `threads`: of this machine, for small batches. Raises `InvalidInput`."""
        super().__init__(task, threads=threads)
        self._crew = Crew(executor)
        self._task_sent = _packed(task)
        self._said = False

    def rollout(self, theta: ArrayLike, position: ArrayLike | None = None) -> Rollout:
        """What `Simulator.rollout` returns. Too few agents for two shards, and starts of their own, are simulated here.

        Raises also what `Crew.wait` raises.
        """
        theta = check_theta(theta, self.task.body, self.task.condition, self.task.controller)
        if position is not None:
            return super().rollout(theta, position)
        if self._too_few(len(theta)):
            return super().rollout(theta)
        (found,) = self._simulated([self.task], theta)
        return found

    def rollout_in(self, tasks: Sequence[Task], theta: ArrayLike) -> list[Rollout]:
        """What `Simulator.rollout_in` returns; too few agents for two shards are simulated here.

        Raises also what `Crew.wait` raises.
        """
        theta = check_theta(theta, self.task.body, self.task.condition, self.task.controller)
        if self._too_few(len(theta)):
            return super().rollout_in(tasks, theta)
        return self._simulated(tasks, theta)

    def _simulated(self, tasks: Sequence[Task], theta: np.ndarray) -> list[Rollout]:
        """The rollouts of `theta` in each of `tasks`, whose shards are in hand all at once."""
        shards = cut_into_shards(self._as_sent(theta), self._crew.threads)
        packed = [self._task_sent if task is self.task else _packed(task) for task in tasks]
        jobs = [(task, shard) for task in packed for shard in shards]
        crew, answers, begun = self._crew, dict[Any, Any](), 0
        try:
            while len(answers) < len(jobs):
                while begun < len(jobs) and crew.jobs < max(IN_HAND_A_THREAD * crew.threads, 1):
                    crew.give(begun, simulate_shard, *jobs[begun])
                    begun += 1
                answers.update(crew.wait())
        finally:
            crew.drop()
        found = []
        for k, task in enumerate(tasks):
            parts = [answers[k * len(shards) + n] for n in range(len(shards))]
            final, steps, solved = (np.concatenate(part) for part in zip(*parts, strict=True))
            found.append(judge(task, starts_of(task, len(theta), None), final, steps, solved))
        return found

    def _too_few(self, agents: int) -> bool:
        """Whether `agents` are too few to spread; says so once."""
        few = agents < 2 * SMALLEST
        if few and not self._said:
            self._said = True
            text = f"turgor: {agents} agents are too few to spread (from {2 * SMALLEST} on); simulated here"
            print(text, file=sys.stderr, flush=True)
        return few

    def _as_sent(self, theta: np.ndarray) -> np.ndarray:
        """Half the bytes, where the kernel rounds to float32 before it does anything else."""
        return theta if isinstance(self.task.controller, Sinusoid) else theta.astype(np.float32)


def cut_into_shards(theta: np.ndarray, threads: int) -> list[np.ndarray]:
    """`theta` [agent, parameter] in parts of whole blocks, for workers of so many `threads` in all."""
    wanted = -(-len(theta) // max(SHARDS_A_THREAD * threads, 1))
    agents = -(-min(max(wanted, SMALLEST), LARGEST) // WIDTH) * WIDTH
    return [theta[k : k + agents] for k in range(0, len(theta), agents)]


def simulate_shard(task: bytes, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Final positions [agent, mass, 2], steps [agent] and solved [agent] of `theta` [agent, parameter]: on a worker."""
    out = _simulator(task).rollout(theta)
    return out.position, out.steps, out.solved


@lru_cache(maxsize=8)
def _simulator(task: bytes) -> Simulator:
    return Simulator(pickle.loads(task), threads=1)


def _packed(task: Task) -> bytes:
    """`task` without its fitness, which is judged where all agents are seen; an end of the user's own goes along."""
    import cloudpickle

    return cloudpickle.dumps(msgspec.structs.replace(task, fitness="progress"))
