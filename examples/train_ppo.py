"""Learn to move with PPO (`pip install "turgor[rl]"`) and write the learning curve to a CSV file."""

import argparse
import csv

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from turgor.rl import SB3VecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="Flat", choices=["Flat", "Hilly", "Escape", "Inflate"])
parser.add_argument("--steps", type=int, default=1_000_000, help="of all agents together")
parser.add_argument("--agents", type=int, default=64)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--out", default="learning.csv")
options = parser.parse_args()


class Curve(BaseCallback):
    """Writes a row whenever the agents have finished an episode: steps so far, mean reward of an episode."""

    def _on_training_start(self) -> None:
        self.file = open(options.out, "w", newline="")  # noqa: SIM115
        self.rows = csv.writer(self.file)
        self.rows.writerow(["steps", "episode_reward"])

    def _on_step(self) -> bool:
        rewards = [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        if rewards:
            self.rows.writerow([self.num_timesteps, sum(rewards) / len(rewards)])
            print(f"{self.num_timesteps:10,} steps: {sum(rewards) / len(rewards):7.2f} an episode", flush=True)
        return True

    def _on_training_end(self) -> None:
        self.file.close()


agents = gymnasium.make_vec(f"turgor/{options.task}-v0", num_envs=options.agents, autoreset_mode="SameStep")
model = PPO(
    "MlpPolicy",
    VecMonitor(SB3VecEnv(agents)),
    n_steps=128,
    batch_size=32 * options.agents,
    gamma=0.995,
    policy_kwargs={"net_arch": [64, 64], "log_std_init": -0.5},
    seed=options.seed,
    device="cpu",
)
model.learn(options.steps, callback=Curve())
