"""What other trainers call a setting, and what it is called here.

Of Stable-Baselines3, CleanRL, rsl_rl and Brax. `seed`, `batch_size` and `target_kl` are accepted
as they are (see `accepted.py`); another name is answered with the one that means the same, as the
values may count otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from typing import Any, get_origin

from sauna.config.settings import FIELDS, TYPES, fields_with, flag
from sauna.system.errors import nearest

SAME = {
    "env_id": "env",
    "task": "env",
    "environment": "env",
    "total_timesteps": "steps",
    "num_timesteps": "steps",
    "timesteps": "steps",
    "n_envs": "envs",
    "num_envs": "envs",
    "n_steps": "rollout_steps",
    "num_steps": "rollout_steps",
    "num_steps_per_env": "rollout_steps",
    "unroll_length": "rollout_steps",
    "num_minibatches": "minibatches",
    "num_mini_batches": "minibatches",
    "minibatch_size": "batch_size",
    "n_epochs": "epochs",
    "update_epochs": "epochs",
    "num_learning_epochs": "epochs",
    "num_updates_per_batch": "epochs",
    "lr": "learning_rate",
    "lr_schedule": "learning_rate_schedule",
    "anneal_lr": "learning_rate_schedule",
    "schedule": "learning_rate_schedule",
    "kl_threshold": "desired_kl",
    "min_lr": "learning_rate_min",
    "max_lr": "learning_rate_max",
    "optimizer_class": "optimizer",
    "warmup_steps": "warmup",
    "clip_coef": "clip_range",
    "clip_param": "clip_range",
    "clipping_epsilon": "clip_range",
    "clip_vloss": "clip_value",
    "clip_range_vf": "clip_value",
    "use_clipped_value_loss": "clip_value",
    "norm_adv": "normalize_advantages",
    "normalize_advantage": "normalize_advantages",
    "ent_coef": "entropy_coef",
    "entropy_cost": "entropy_coef",
    "vf_coef": "value_coef",
    "value_loss_coef": "value_coef",
    "discounting": "gamma",
    "discount": "gamma",
    "discount_factor": "gamma",
    "lam": "gae_lambda",
    "rms_prop_eps": "rmsprop_epsilon",
    "use_rms_prop": "optimizer",
    "net_arch": "hidden",
    "policy_kwargs": "hidden",
    "actor_hidden_dims": "hidden",
    "critic_hidden_dims": "value_hidden",
    "activation_fn": "activation",
    "init_noise_std": "log_std_init",
    "use_expln": "sde_expln",
    "norm_obs": "normalize_observations",
    "empirical_normalization": "normalize_observations",
    "normalize_obs": "normalize_observations",
    "vec_normalize": "normalize_observations",
    "norm_reward": "normalize_rewards",
    "normalize_reward": "normalize_rewards",
    "reward_scaling": "normalize_rewards",
    "clip_obs": "clip_observations",
    "clip_reward": "clip_rewards",
    "frame_stack": "stack",
    "n_stack": "stack",
    "env_wrapper": "wrap",
    "episode_length": "env_kwargs",
    "action_repeat": "env_kwargs",
    "tensorboard": "track",
    "tensorboard_log": "track",
    "logger": "track",
    "wandb": "track",
    "wandb_project": "track_project",
    "wandb_project_name": "track_project",
    "save_interval": "checkpoint_every",
    "save_freq": "checkpoint_every",
    "exp_name": "out",
    "experiment_name": "out",
    "run_name": "out",
    "log_dir": "out",
    "eval_freq": "eval_every",
    "evaluation_frequency": "eval_every",
    "n_eval_episodes": "eval_episodes",
    "num_eval_episodes": "eval_episodes",
    "reward_threshold": "stop_at",
    "max_no_improvement_evals": "stop_when_flat",
    "cuda": "device",
    "n_seeds": "seeds",
}
ADVICE = {
    "max_iterations": "give steps: iterations x envs x rollout_steps",
    "num_iterations": "give steps: iterations x envs x rollout_steps",
    "capture_video": "`sauna eval RUN --video` records a trained policy",
    "torch_deterministic": "a run repeats itself to the bit by itself",
    "log_interval": "every iteration has its rows in metrics.jsonl and metrics.csv",
    "verbose": "`quiet=True` in Python shows nothing",
    "use_sde": "give distribution gsde: state-dependent exploration",
    "squash_output": "give distribution squashed: a Gaussian under a tanh",
    "policy": "the policy follows from the spaces; `network` chooses its trunk",
}
ACCEPTED = ("seed", "batch_size", "target_kl")


def key_hint(name: str) -> str:
    """Writes `; ...` with what an unknown keyword or key should be."""
    return _hint(name, lambda ours: ours) or nearest(name, FIELDS)


def flag_hint(argument: str, known: list[str], command: str | None) -> str:
    """Writes `; ...` with what an unknown argument of `command` should be.

    Args:
      argument: as it was typed.
      known: the flags of the command.
    """
    typed = argument.split("=")[0]
    name = typed.lstrip("-").removeprefix("no-").replace("-", "_")
    ours = SAME.get(name, name)
    changeable = (*fields_with("extends_run"), *fields_with("resumable"))
    if command == "resume" and ours in (*FIELDS, *ACCEPTED) and ours not in changeable:
        return (
            "; a resumed run computes what it began with: "
            "`sauna train --config RUN/config.json` trains anew with other settings"
        )
    near = nearest(typed.lstrip("-"), (other.lstrip("-") for other in known if other[:2] == "--"))
    return _hint(name, flag) or near.replace("mean '", "mean '--")


def spread_hint(arguments: Sequence[str], unknown: str) -> str:
    """Writes `; ...` if an unknown argument is a further value of a list: `--seeds 0 1 2`."""
    if unknown.startswith("-") or unknown not in arguments:
        return ""
    before = list(arguments[: arguments.index(unknown)])
    options = [place for place, word in enumerate(before) if word.startswith("--")]
    name = before[options[-1]].lstrip("-").replace("-", "_") if options else ""
    if get_origin(TYPES.get(name, tuple[str] if name in ("arms", "rules") else None)) is not tuple:
        return ""
    values = [*takewhile(lambda word: not word.startswith("-"), arguments[options[-1] + 1 :])]
    return f"; values of {flag(name)} are separated by commas: {flag(name)} {','.join(values)}"


def _hint(name: str, spell: Any) -> str:
    if name in SAME:
        ours = SAME[name]
        text = FIELDS[ours].metadata["help"] if ours in FIELDS else "samples per minibatch"
        return f"; here it is {spell(ours)!r}: {text}"
    return f"; {ADVICE[name]}" if name in ADVICE else ""
