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


def over_the_budget(name: str) -> object:
    """A setting as a number, or as what SB3 calls with the share of the budget that is left."""
    value, schedule = s[name], s[f"{name}_schedule"]
    if schedule not in ("constant", "linear"):
        raise SystemExit(f"{name}_schedule: not known here: {schedule}")
    return (lambda left: value * left) if schedule == "linear" else value


clip = over_the_budget("clip_range")
model = PPO(
    "MlpPolicy",
    vector,
    n_steps=s["rollout_steps"],
    batch_size=s["rollout_steps"] * s["envs"] // s["minibatches"],
    n_epochs=s["epochs"],
    gamma=s["gamma"],
    gae_lambda=s["gae_lambda"],
    clip_range=clip,
    clip_range_vf=clip if s["clip_value"] else None,
    ent_coef=s["entropy_coef"],
    vf_coef=s["value_coef"] / 2,  # our value loss has the factor 0.5 inside
    max_grad_norm=s["max_grad_norm"],
    learning_rate=over_the_budget("learning_rate"),
    policy_kwargs={"log_std_init": s["log_std_init"]},
    seed=s["seed"],
    device="cpu",
)
model.learn(s["steps"])
print(json.dumps({"return": float(np.mean([one["r"] for one in model.ep_info_buffer]))}))
