"""Which of our settings each peer reads, so that both train with the same ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sauna.config.choices import ACTIVATIONS
from sauna.config.settings import FIELDS, Config
from sauna.envs.make import is_mujoco
from sauna.system.errors import BadInput

_ANY = None


def _any(*names: str) -> dict[str, Any]:
    return dict.fromkeys(names, _ANY)


# What every peer reads, but CleanRL's script.
_ALL = _any(
    "envs",
    "rollout_steps",
    "minibatches",
    "epochs",
    "learning_rate",
    "clip_range",
    "entropy_coef",
    "gamma",
    "gae_lambda",
)
_LOSS = _any("max_grad_norm", "value_coef")
_HOST = _any("normalize_advantages", "log_std_init")
_SCALED = _any("normalize_observations", "normalize_rewards")
_SCHEDULES = {"learning_rate_schedule": ("constant", "linear")}
_ACTIVATIONS = {"activation": ("tanh", "relu", "elu", "gelu", "selu", "sigmoid", "silu")}


def _one_width(hidden: tuple[int, ...]) -> bool:
    return len(hidden) > 0 and len(set(hidden)) == 1


# Of each peer, the settings of learning that it reads, with the values that it knows, or a function
# that says whether it knows one. CleanRL's script has numbers of its own: those of preset mujoco,
# which are our defaults.
READ: dict[str, Mapping[str, Any]] = {
    "sb3": {
        **_ALL,
        **_LOSS,
        **_HOST,
        **_SCALED,
        **_SCHEDULES,
        **_ACTIVATIONS,
        **_any("env", "env_kwargs", "clip_value", "hidden", "value_hidden"),
        **_any("clip_observations", "clip_rewards", "sde_sample_freq", "sde_expln"),
        "algorithm": ("ppo", "a2c"),
        "clip_range_schedule": ("constant", "linear"),
        "distribution": ("gaussian", "gsde"),
    },
    "cleanrl": _any("env"),
    "rltools": {
        **_ALL,
        **_HOST,
        **_any("env_kwargs"),
        "env": is_mujoco,
        "hidden": _one_width,
        "activation": ("tanh", "relu", "sigmoid", "gelu"),
    },
    "rl_games": {
        **_ALL,
        **_LOSS,
        **_HOST,
        **_SCALED,
        **_SCHEDULES,
        **_ACTIVATIONS,
        **_any("clip_value", "hidden"),
        "env": is_mujoco,
        "trunk": ("separate", "shared"),
    },
    "rejax": {
        **_ALL,
        **_LOSS,
        **_SCALED,
        **_SCHEDULES,
        **_any("env", "env_kwargs", "hidden", "value_hidden"),
        "activation": ACTIVATIONS,
    },
    "purejaxrl": {
        **_ALL,
        **_LOSS,
        **_SCHEDULES,
        **_any("env"),
        "hidden": ((64, 64),),
        "activation": ("tanh", "relu"),
    },
}
# What a peer has nothing of, and is measured without, whatever we train with.
LACKS: dict[str, tuple[str, ...]] = {
    "rltools": (
        "learning_rate_schedule",
        "max_grad_norm",
        "clip_value",
        "value_coef",  # it has an optimiser for each network
        "normalize_observations",
        "normalize_rewards",
        "clip_observations",
        "clip_rewards",
    ),
    "rl_games": ("clip_observations", "clip_rewards"),
}
GYMNAX_PEERS = ("rejax", "purejaxrl")  # they have environments on the device, and no others
_LEARNING = ("task", "learning", "network", "normalisation")
_COSTLESS = ("rescale_actions",)  # a multiplication of each action, or none
# What a preset or a peer may differ in from the defaults, and what of it a peer does by itself.
_ALONE: dict[str, dict[str, Any]] = {
    "a2c": {"optimizer": "rmsprop", "trunk": "separate"},
    "atari": {"trunk": "shared", "sign_rewards": True},
    "purejaxrl": {"normalize_observations": False, "normalize_rewards": False},
}


def peer_settings(peer: str, config: Config) -> dict[str, Any]:
    """Picks what a peer is given of a run's settings.

    Arms and filters are not among them: what they cost beside a peer's PPO is a fair question.

    Raises:
      BadInput: the run has a setting of learning that the peer does not read, or not with this
        value; the field is named.
    """
    if peer not in READ:
        raise BadInput(f"against: unknown peer {peer!r} (known: {', '.join(READ)})")
    read = READ[peer]
    atari = config.env.startswith("ALE/")
    if config.algorithm not in read.get("algorithm", ("ppo",)) or (
        atari and config.algorithm != "ppo"
    ):
        raise BadInput(f"against: {peer} is run with PPO, not with {config.algorithm}")
    if peer in GYMNAX_PEERS and not config.env.startswith("gymnax/"):
        raise BadInput(f"against: {peer} cannot train {config.env}; it has gymnax's environments")
    alone = {
        **_ALONE.get(config.algorithm, {}),
        **(_ALONE["atari"] if atari else {}),
        **_ALONE.get(peer, {}),
    }
    for name, known in read.items():
        value = getattr(config, name)
        if known is not _ANY and not (known(value) if callable(known) else value in known):
            raise BadInput(f"{name}: {peer} has no {value}")
    left_out = (*read, *_COSTLESS, *LACKS.get(peer, ()))
    for name, field in FIELDS.items():
        usual = alone.get(name, field.default)
        unread = field.metadata["group"] in _LEARNING and name not in left_out
        if unread and getattr(config, name) != usual:
            raise BadInput(f"{name}: not read by {peer}, which has {usual}")
    return {name: getattr(config, name) for name in read}
