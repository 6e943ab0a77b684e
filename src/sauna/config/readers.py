"""What reads a field that not every run reads: in words, and as a predicate.

Of a `Config`, or of an environment's `Spaces` for `needs_spaces`; see `fields.option`.
"""

from __future__ import annotations

from typing import Any

from sauna.config.choices import BOUNDED

ON_HOST = ("environments on the host", lambda c: c.backend != "device")
WORKERS = ("env_processes above 0", lambda c: c.env_processes > 0)
TRACKED = ("track", lambda c: c.track != ("none",))
PPO = ("algorithm ppo", lambda c: c.algorithm == "ppo")
ADAM = ("optimizer adam", lambda c: c.optimizer == "adam")
RMSPROP = ("optimizer rmsprop", lambda c: c.optimizer == "rmsprop")
KL_RATE = ("learning_rate_schedule kl", lambda c: c.learning_rate_schedule == "kl")
NO_KL_RATE = (
    "a learning_rate_schedule other than kl",
    lambda c: c.learning_rate_schedule != "kl",
)
ENTROPY = ("entropy_coef above 0", lambda c: c.entropy_coef > 0)
MLP = ("the mlp network", lambda c: c.network in ("auto", "mlp"))
RECURRENT = ("recurrent lstm or gru", lambda c: c.recurrent != "none")
VALUE_MLP = (
    "the mlp network with trunk separate",
    lambda c: c.network in ("auto", "mlp") and c.trunk == "separate",
)
CONTINUOUS = ("continuous actions", lambda spaces: spaces.action_kind == "continuous")
CHOICES = (
    "Discrete or MultiDiscrete actions",
    lambda spaces: spaces.action_kind in ("discrete", "multi_discrete"),
)
DATA = "data:"  # before recorded episodes that init_from names
LOG_STD = (
    "a distribution other than beta, and no init_from RUN, whose log-std is taken over",
    lambda c: c.distribution != "beta" and (not c.init_from or c.init_from.startswith(DATA)),
)
GSDE = ("distribution gsde", lambda c: c.distribution == "gsde")
UNBOUNDED = (
    "distribution gaussian or gsde: the others are stretched to the bounds by themselves",
    lambda c: c.distribution not in BOUNDED,
)
VECTORS = (
    "vector observations: others have no running moments",
    lambda spaces: spaces.normalized > 0,
)
NORMALIZED = ("normalize_observations", lambda c: c.normalize_observations)
SCALED = ("normalize_rewards", lambda c: c.normalize_rewards)
VEX = ("vex_coef above 0", lambda c: c.vex_coef > 0)
FILTERED = ("a filter", lambda c: c.filter != "none")
REPLACED = (
    "a filter with dropped=replace",
    lambda c: c.filter != "none" and c.dropped == "replace",
)
THRESHOLD = (
    "a filter other than none and random-drop, and keep_rate_target 0",
    lambda c: c.filter not in ("none", "random-drop") and not c.keep_rate_target,
)
SAUNA = ("filter sauna", lambda c: c.filter == "sauna")
SEVERAL = ("filter sauna and several envs", lambda c: c.filter == "sauna" and c.envs > 1)
RANDOM = ("filter random-drop", lambda c: c.filter == "random-drop")
OWN_FILTER = ("a filter of your own, module:name", lambda c: ":" in c.filter)
SAMPLER = ("a sampler", lambda c: c.sampler != "none")
MASKED = (
    "a sampler with selection_losses=all, a filter with dropped=mask, or replay_rollouts",
    lambda c: (
        (c.sampler != "none" and c.selection_losses == "all")
        or (c.filter != "none" and c.dropped == "mask")
        or c.replay_rollouts > 0
    ),
)
CENTRED = ("advantage_sign both", lambda c: c.advantage_sign == "both")
STANDARDISED = (
    "normalize_advantages, or advantage_sign positive",
    lambda c: c.normalize_advantages or c.advantage_sign == "positive",
)
SQUARED = (
    "algorithm ppo with critic squared",
    lambda c: c.algorithm == "ppo" and c.critic == "squared",
)
WEIGHTED = ("a loss_weight", lambda c: c.loss_weight != "none")
STOPPED = ("a stop rule", lambda c: c.stop != "none")
UNSCHEDULED = ("constant", "kl")  # schedules that do not follow the budget


def moved_by(config: Any) -> list[str]:
    """Names the fields that move a rate over the budget: schedules, and the warm-up."""
    schedules = [name for name in vars(config) if name.endswith("_schedule")]
    moving = [name for name in schedules if getattr(config, name) not in UNSCHEDULED]
    return [*moving, "warmup"] if config.warmup else moving


SCHEDULED = ("a schedule of the budget, or a warm-up", lambda c: bool(moved_by(c)))
EVALUATED = ("eval_every above 0", lambda c: c.eval_every > 0)
FINE_TUNED = ("init_from", lambda c: bool(c.init_from))
CLONED = ("init_from data:...", lambda c: c.init_from.startswith(DATA))
AUXILIARY = ("an auxiliary head", lambda c: c.auxiliary != "none")
