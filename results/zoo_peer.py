"""Trains one seed with Stable-Baselines3's PPO and the numbers of one of our presets.

Run by an interpreter of its own environment (see `sauna bench --against sb3`), with the settings as
JSON in place of arguments: those of `sauna.config.settings.Config`. Prints the mean return of the
last 100 episodes.
"""

import json
import sys

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

s = json.loads(sys.argv[1])
torch.set_num_threads(1)
vector = DummyVecEnv([lambda: Monitor(gymnasium.make(s["env"]))] * s["envs"])
if s["normalize_observations"] or s["normalize_rewards"]:
    vector = VecNormalize(
        vector,
        norm_obs=s["normalize_observations"],
        norm_reward=s["normalize_rewards"],
        gamma=s["gamma"],
    )
rate = s["learning_rate"]
is_linear = s["learning_rate_schedule"] == "linear"
model = PPO(
    "MlpPolicy",
    vector,
    n_steps=s["rollout_steps"],
    batch_size=s["rollout_steps"] * s["envs"] // s["minibatches"],
    n_epochs=s["epochs"],
    gamma=s["gamma"],
    gae_lambda=s["gae_lambda"],
    clip_range=s["clip_range"],
    clip_range_vf=s["clip_range"] if s["clip_value"] else None,
    ent_coef=s["entropy_coef"],
    vf_coef=s["value_coef"] / 2,  # our value loss has the factor 0.5 inside
    max_grad_norm=s["max_grad_norm"],
    learning_rate=(lambda left: rate * left) if is_linear else rate,
    policy_kwargs={"log_std_init": s["log_std_init"]},
    seed=s["seed"],
    device="cpu",
)
model.learn(s["steps"])
print(json.dumps({"return": float(np.mean([one["r"] for one in model.ep_info_buffer]))}))
