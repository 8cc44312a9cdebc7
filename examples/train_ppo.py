"""Learn to move with PPO (`pip install "turgor[rl]"`), and write the learning curve to a CSV file.

An action is held for a tenth of a second: noise that changes sixty times a second moves nothing.
"""

import argparse
import csv

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor, VecNormalize

from turgor.rl import SB3VecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="Flat", choices=["Flat", "Hilly", "Escape", "Inflate"])
parser.add_argument("--terrain", type=int, help="seed of the only terrain (default: another one in every episode)")
parser.add_argument("--steps", type=int, default=18_000_000, help="of all agents together (default: 18,000,000)")
parser.add_argument("--agents", type=int, default=64)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--out", default="learning.csv")
options = parser.parse_args()
HOLD = 6  # steps


class Hold(VecEnvWrapper):
    """Holds an action for `HOLD` steps; what is rewarded after the end of an episode belongs to the next one."""

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        rewards, over, infos = np.zeros(self.num_envs, np.float32), np.zeros(self.num_envs, bool), None
        for _ in range(HOLD):
            observations, gained, ended, told = self.venv.step(self.actions)
            rewards += np.where(over, 0, gained)
            infos = infos or told
            infos = [new if end else old for new, old, end in zip(told, infos, ended, strict=True)]
            over |= ended
        return observations, rewards, over, infos


class Curve(BaseCallback):
    """Writes a row whenever agents finish an episode: steps of all agents so far, mean fitness of the episodes."""

    def _on_training_start(self):
        self.file = open(options.out, "w", newline="")  # noqa: SIM115
        self.rows = csv.writer(self.file)
        self.rows.writerow(["steps", "fitness"])

    def _on_step(self):
        fitness = [info["fitness"] for info in self.locals["infos"] if "episode" in info]
        if fitness:
            self.rows.writerow([HOLD * self.num_timesteps, np.mean(fitness)])
            print(f"{HOLD * self.num_timesteps:10,} steps: fitness {np.mean(fitness):6.2f}", flush=True)
        return True

    def _on_training_end(self):
        self.file.close()


torch.set_num_threads(1)  # for networks as small as these, more of them wait for each other
terrain = {} if options.terrain is None else {"seed_terrain": options.terrain}
envs = gymnasium.make_vec(f"turgor/{options.task}-v0", num_envs=options.agents, autoreset_mode="SameStep", **terrain)
model = PPO(
    "MlpPolicy",
    VecNormalize(VecMonitor(Hold(SB3VecEnv(envs))), gamma=0.98),
    n_steps=64,
    batch_size=8 * options.agents,
    gamma=0.98,
    learning_rate=1e-3,
    policy_kwargs={"net_arch": [64, 64], "log_std_init": -1.5},
    seed=options.seed,
    device="cpu",
)
model.learn(options.steps // HOLD, callback=Curve())
