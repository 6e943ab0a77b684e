"""Stable-Baselines3's PPO with this project's `mujoco` preset; prints its env steps per second.

Run by an interpreter of its own environment, with the environment id, seed and seconds as
arguments. The rate is that of whole rollouts and updates, after the first two.
"""

import json
import sys
import time

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

env_id, seed, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
torch.set_num_threads(1)


class Clock(BaseCallback):
    """Notes the time at the start of every rollout; stops after enough seconds."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[float, int]] = []

    def _on_rollout_start(self) -> None:
        self.seen.append((time.perf_counter(), self.num_timesteps))

    def _on_step(self) -> bool:
        return len(self.seen) < 5 or time.perf_counter() - self.seen[2][0] < seconds


env = VecNormalize(DummyVecEnv([lambda: Monitor(gymnasium.make(env_id))]), gamma=0.99)
model = PPO(
    "MlpPolicy", env, seed=seed, n_steps=2048, batch_size=64, n_epochs=10, clip_range=0.2,
    clip_range_vf=0.2, vf_coef=0.5, ent_coef=0.0, max_grad_norm=0.5, gamma=0.99, gae_lambda=0.95,
    learning_rate=lambda left: 3e-4 * left, device="cpu",
)  # fmt: skip
clock = Clock()
model.learn(100_000_000, callback=clock)
(first, before), (last, after) = clock.seen[2], clock.seen[-1]
print(json.dumps({"rate": (after - before) / (last - first)}))
