"""Stable-Baselines3's PPO or A2C with our settings; prints its env steps per second.

Run by an interpreter of its own environment, with one argument: the settings as JSON, by our names
(`peer_settings.py`), besides `seed`, `seconds` and `folder`, where modules of the user are found.
The rate is that of whole rollouts and updates, after the first two.
"""

import importlib
import json
import sys
import time

import gymnasium
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

settings = json.loads(sys.argv[1])
torch.set_num_threads(1)


class Clock(BaseCallback):
    """Notes the time at the start of every rollout; stops after enough seconds."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[float, int]] = []

    def _on_rollout_start(self) -> None:
        self.seen.append((time.perf_counter(), self.num_timesteps))

    def _on_step(self) -> bool:
        began = self.seen[2][0] if len(self.seen) > 2 else 0.0
        return len(self.seen) < 5 or time.perf_counter() - began < settings["seconds"]


def make_env() -> gymnasium.Env:
    module, _, name = settings["env"].rpartition(":")
    kwargs = json.loads(settings["env_kwargs"])
    if module and not name.rpartition("-v")[2].isdigit():
        sys.path.insert(0, settings["folder"])
        return Monitor(getattr(importlib.import_module(module), name)(**kwargs))
    return Monitor(gymnasium.make(settings["env"], **kwargs))


def make_envs() -> DummyVecEnv | VecNormalize | VecFrameStack:
    """The environments; of Atari with its own wrappers, which skip frames themselves."""
    number = settings["envs"]
    if settings["env"].startswith("ALE/"):
        import ale_py  # noqa: F401 - registers the games

        game = settings["env"].removeprefix("ALE/").removesuffix("-v5") + "NoFrameskip-v4"
        return VecFrameStack(make_atari_env(game, n_envs=number, seed=settings["seed"]), n_stack=4)
    envs = DummyVecEnv([make_env] * number)
    if not settings["normalize_observations"] and not settings["normalize_rewards"]:
        return envs
    return VecNormalize(
        envs,
        norm_obs=settings["normalize_observations"],
        norm_reward=settings["normalize_rewards"],
        clip_obs=settings["clip_observations"],
        clip_reward=settings["clip_rewards"],
        gamma=settings["gamma"],
    )


def over_the_budget(value: float, schedule: str) -> object:
    """A number, or what SB3 calls with the share of the budget that is left."""
    return (lambda left: value * left) if schedule == "linear" else value


def policy_of(space: gymnasium.Space) -> tuple[str, dict[str, object]]:
    """Its policy class and the arguments of it."""
    chosen: dict[str, object] = {"log_std_init": settings["log_std_init"]}
    pictures = is_image_space(space)
    if not pictures:
        names = {"relu": "ReLU", "elu": "ELU", "gelu": "GELU", "selu": "SELU", "silu": "SiLU"}
        name = settings["activation"]
        chosen["activation_fn"] = getattr(torch.nn, names.get(name, name.capitalize()))
        value = settings["value_hidden"] or settings["hidden"]
        chosen["net_arch"] = {"pi": settings["hidden"], "vf": value}
    if settings["distribution"] == "gsde":
        chosen["use_expln"] = settings["sde_expln"]
    if pictures:
        return "CnnPolicy", chosen
    combined = isinstance(space, gymnasium.spaces.Dict)
    return "MultiInputPolicy" if combined else "MlpPolicy", chosen


def make_model() -> PPO | A2C:
    env = make_envs()
    policy, policy_kwargs = policy_of(env.observation_space)
    both = {
        "policy": policy,
        "policy_kwargs": policy_kwargs,
        "env": env,
        "n_steps": settings["rollout_steps"],
        "learning_rate": over_the_budget(
            settings["learning_rate"], settings["learning_rate_schedule"]
        ),
        "normalize_advantage": settings["normalize_advantages"],
        "ent_coef": settings["entropy_coef"],
        "vf_coef": settings["value_coef"] / 2,  # our value loss has the factor 0.5 inside
        "max_grad_norm": settings["max_grad_norm"],
        "gamma": settings["gamma"],
        "gae_lambda": settings["gae_lambda"],
        "use_sde": settings["distribution"] == "gsde",
        "sde_sample_freq": settings["sde_sample_freq"] or -1,
        "seed": settings["seed"],
        "device": "cpu",
    }
    if settings["algorithm"] == "a2c":
        return A2C(**both, rms_prop_eps=settings["rmsprop_epsilon"])
    clip = over_the_budget(settings["clip_range"], settings["clip_range_schedule"])
    return PPO(
        **both,
        batch_size=settings["rollout_steps"] * settings["envs"] // settings["minibatches"],
        n_epochs=settings["epochs"],
        clip_range=clip,
        clip_range_vf=clip if settings["clip_value"] else None,
    )


model = make_model()
clock = Clock()
model.learn(100_000_000, callback=clock)
(first, before), (last, after) = clock.seen[2], clock.seen[-1]
print(json.dumps({"rate": (after - before) / (last - first)}))
