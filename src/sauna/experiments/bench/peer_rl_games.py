"""rl_games' PPO on EnvPool with our settings, on the CPU; prints its env steps per second.

Run by an interpreter of its own environment, with one argument: the settings as JSON, by our names
(`peer_settings.py`), besides `seed` and `seconds`. It learns in one thread, EnvPool steps in one
thread. What we do not set is as in its published `mujoco/halfcheetah_envpool.yaml`, and the model
goes through `torch.compile`, which is its default. The rate is that of whole rollouts and updates,
after the first two.

What stays different: it normalises values where we normalise rewards, advantages over the rollout
and not over a minibatch, clips observations at 5, and its Adam has an epsilon of 1e-8. The MuJoCo
of EnvPool is the one compiled into it. EnvPool begins an episode anew with a step that does
nothing, and rl_games counts it.
"""

import json
import os
import sys
import time

import envpool
import torch
from rl_games.common.algo_observer import AlgoObserver
from rl_games.torch_runner import Runner

settings = json.loads(sys.argv[1])
# What it compiles is kept with its environment.
os.environ["TORCHINDUCTOR_CACHE_DIR"] = os.path.join(sys.prefix, "compiled")
ACTIVATIONS = {"silu": "swish"}  # where it has another name
FOREVER = 1_000_000_000


class Enough(Exception):
    """Ends a training."""


class Clock(AlgoObserver):
    """Notes the time after every update; ends the training after enough seconds."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[float, int]] = []

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        self.seen.append((time.perf_counter(), frame))
        warm = self.seen[1:]
        if len(warm) > 2 and warm[-1][0] - warm[0][0] > settings["seconds"]:
            raise Enough


def network() -> dict[str, object]:
    activation = settings["activation"]
    sigma = {"name": "const_initializer", "val": settings["log_std_init"]}
    continuous = {
        "mu_activation": "None",
        "sigma_activation": "None",
        "mu_init": {"name": "default"},
        "sigma_init": sigma,
        "fixed_sigma": True,
    }
    return {
        "name": "actor_critic",
        "separate": settings["trunk"] == "separate",
        "space": {"continuous": continuous},
        "mlp": {
            "units": settings["hidden"],
            "activation": ACTIVATIONS.get(activation, activation),
            "initializer": {"name": "variance_scaling_initializer", "scale": 2.0},
        },
    }


def learning() -> dict[str, object]:
    batch = settings["envs"] * settings["rollout_steps"]
    return {
        "num_actors": settings["envs"],
        "horizon_length": settings["rollout_steps"],
        "minibatch_size": batch // settings["minibatches"],
        "mini_epochs": settings["epochs"],
        "learning_rate": settings["learning_rate"],
        "lr_schedule": {"linear": "linear"}.get(settings["learning_rate_schedule"]),
        "truncate_grads": True,
        "grad_norm": settings["max_grad_norm"],
        "e_clip": settings["clip_range"],
        "clip_value": settings["clip_value"],
        "normalize_advantage": settings["normalize_advantages"],
        "entropy_coef": settings["entropy_coef"],
        "critic_coef": settings["value_coef"],  # both halve the squared error
        "gamma": settings["gamma"],
        "tau": settings["gae_lambda"],
        "normalize_input": settings["normalize_observations"],
        "normalize_value": settings["normalize_rewards"],
        "value_bootstrap": True,
        "bounds_loss_coef": 0.0,
        "reward_shaper": {"scale_value": 1},
    }


def config() -> dict[str, object]:
    seed = settings["seed"] + 1  # it takes 0 for none
    return {
        "seed": seed,
        "torch_threads": 1,
        "algo": {"name": "a2c_continuous"},
        "model": {"name": "continuous_a2c_logstd"},
        "network": network(),
        "config": {
            **learning(),
            "name": "peer",
            "env_name": "envpool",
            "env_config": {"env_name": settings["env"], "seed": seed, "num_threads": 1},
            "device": "cpu",
            "max_epochs": FOREVER,
            "save_best_after": FOREVER,
            "print_stats": False,
        },
    }


if settings["env"] not in envpool.list_all_envs():
    sys.exit(f"EnvPool {envpool.__version__} has no {settings['env']}")
torch.set_num_threads(1)
clock = Clock()
runner = Runner(clock)
runner.load({"params": config()})
try:
    runner.run({"train": True})
except Enough:
    pass
(first, before), (last, after) = clock.seen[1], clock.seen[-1]
print(json.dumps({"rate": (after - before) / (last - first)}))
