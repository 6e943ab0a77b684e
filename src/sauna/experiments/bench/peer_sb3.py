"""Stable-Baselines3's PPO or A2C with our presets; prints its env steps per second.

The preset is `atari` for `ALE/...` (PPO), else `mujoco` or `a2c-mujoco`.

Run by an interpreter of its own environment, with the environment id, seed, seconds and the
algorithm as arguments. The rate is that of whole rollouts and updates, after the first two.
"""

import json
import sys
import time

import gymnasium
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

env_id, seed, seconds, algorithm = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
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


common = {"seed": seed, "max_grad_norm": 0.5, "gamma": 0.99, "device": "cpu"}


def mujoco() -> PPO | A2C:
    number = 1 if algorithm == "ppo" else 16
    env = VecNormalize(DummyVecEnv([lambda: Monitor(gymnasium.make(env_id))] * number), gamma=0.99)
    both = {"vf_coef": 0.5, "ent_coef": 0.0, **common}
    if algorithm == "a2c":
        return A2C("MlpPolicy", env, n_steps=5, learning_rate=lambda left: 7e-4 * left, **both)
    return PPO(
        "MlpPolicy",
        env,
        n_steps=2048,
        batch_size=64,
        n_epochs=10,
        clip_range=0.2,
        clip_range_vf=0.2,
        gae_lambda=0.95,
        learning_rate=lambda left: 3e-4 * left,
        **both,
    )


def atari() -> PPO:
    """Its own wrappers, which want the game without a frame skip of its own."""
    import ale_py  # noqa: F401 - registers the games

    game = env_id.removeprefix("ALE/").removesuffix("-v5") + "NoFrameskip-v4"
    env = VecFrameStack(make_atari_env(game, n_envs=8, seed=seed), n_stack=4)
    return PPO(
        "CnnPolicy",
        env,
        n_steps=128,
        batch_size=256,
        n_epochs=3,
        clip_range=0.1,
        clip_range_vf=0.1,
        vf_coef=1.0,
        ent_coef=0.01,
        gae_lambda=0.95,
        learning_rate=lambda left: 2.5e-4 * left,
        **common,
    )


model = atari() if env_id.startswith("ALE/") else mujoco()
clock = Clock()
model.learn(100_000_000, callback=clock)
(first, before), (last, after) = clock.seen[2], clock.seen[-1]
print(json.dumps({"rate": (after - before) / (last - first)}))
