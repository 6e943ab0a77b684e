"""Which rule a name means, at each stage.

`config/` names each rule, too, so that bad input is refused without JAX: `SAMPLERS` and the other
choices of `choices.py`, and `ARMS`. See "Add a built-in rule" in docs/concepts/architecture.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from sauna.algorithm.selection.avec import avec
from sauna.algorithm.selection.control import MAX_STRIDE_ROWS, controlled, controlled_weight
from sauna.algorithm.selection.delight import delight
from sauna.algorithm.selection.gigaflow import gigaflow
from sauna.algorithm.selection.gradient_norm import gradient_norm
from sauna.algorithm.selection.kondo import kondo
from sauna.algorithm.selection.merl import next_observation, shuffled_observation
from sauna.algorithm.selection.objectives import spo, unclipped
from sauna.algorithm.selection.pods import pods
from sauna.algorithm.selection.positive import positive
from sauna.algorithm.selection.prioritized import prioritized
from sauna.algorithm.selection.random_drop import random_drop
from sauna.algorithm.selection.sample_dropout import sample_dropout
from sauna.algorithm.selection.stops import espo, target_kl
from sauna.algorithm.selection.top_advantage import top_advantage
from sauna.algorithm.selection.vex_filter import sauna_at_rate, sauna_joint, sauna_per_env
from sauna.algorithm.selection.vex_oracle import vex_oracle
from sauna.algorithm.types import Array, LossWeight, Sampler, SamplerSetup, StepFilter, StopRule
from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.system.errors import BadInput

SAMPLERS: dict[str, Callable[..., Sampler]] = {
    "gigaflow": gigaflow,
    "top-advantage": top_advantage,
    "prioritized": prioritized,
    "gradient-norm": gradient_norm,
    "kondo": kondo,
    "positive": positive,
    "pods": pods,
    "vex-oracle": vex_oracle,
}
LOSS_WEIGHTS: dict[str, Callable[..., LossWeight]] = {
    "delight": delight,
    "sample-dropout": sample_dropout,
}
STOPS: dict[str, Callable[..., StopRule]] = {"target-kl": target_kl, "espo": espo}
OBJECTIVES: dict[str, Callable[[Array, Array, Array], Array] | None] = {
    "clip": None,  # PPO's own, which stands in `learner/ppo.py`
    "unclipped": unclipped,
    "spo": spo,
}
CRITICS: dict[str, Callable[[Array, Array], Array] | None] = {"squared": None, "avec": avec}
AUXILIARY: dict[str, Callable[[Array, Array, Array, Array], Array] | None] = {
    "none": None,
    "next-observation": next_observation,
    "shuffled-observation": shuffled_observation,
}


class Rules(NamedTuple):
    """The rules of one run's learner; None is PPO's (or A2C's) own way."""

    sampler: Sampler | None = None
    loss_weight: LossWeight | None = None
    objective: Callable[[Array, Array, Array], Array] | None = None
    critic: Callable[[Array, Array], Array] | None = None
    stop: StopRule | None = None
    auxiliary: Callable[[Array, Array, Array, Array], Array] | None = None


def make_rules(config: Config, action_kind: str, action_sizes: tuple[int, ...]) -> Rules:
    """The rules that `config` names.

    Raises:
      BadInput: a user's `module:name` is something else, or a rule does not take its arguments.
    """
    rows = config.rollout_steps * config.envs
    setup = SamplerSetup(
        config.rollout_steps,
        config.envs,
        config.steps // rows,
        action_kind,
        action_sizes,
        config.replay_rollouts,
        config.distribution,
    )
    sampler = _made("sampler", config.sampler, SAMPLERS, Sampler, config.sampler_kwargs, setup)
    weight = _made(
        "loss_weight", config.loss_weight, LOSS_WEIGHTS, LossWeight, config.loss_weight_kwargs
    )
    if config.control != "none":
        if config.control == "stride" and setup.rows > MAX_STRIDE_ROWS:
            raise BadInput(
                f"control: stride takes at most {MAX_STRIDE_ROWS} rows, not {setup.rows}"
            )
        sampler = sampler and controlled(config.control, sampler)
        weight = weight and controlled_weight(config.control, weight)
    beta = action_kind == "continuous" and config.distribution == "beta"
    if weight is not None and weight.on_mean and beta:
        raise BadInput(
            "loss_weight: its on_mean needs a parameter of the mean, which distribution beta has "
            "none of"
        )
    return Rules(
        sampler=sampler,
        loss_weight=weight,
        objective=_function("objective", config.objective, OBJECTIVES),
        critic=_function("critic", config.critic, CRITICS),
        stop=_made("stop", config.stop, STOPS, StopRule, config.stop_kwargs),
        auxiliary=AUXILIARY[config.auxiliary],
    )


def _made(
    field: str,
    name: str,
    known: Mapping[str, Callable[..., Any]],
    kind: type,
    kwargs: str,
    *arguments: Any,
) -> Any:
    """The rule of that name, made with its own arguments; None for `none`.

    A user's `module:name` is a rule already, or a function that makes one.
    """
    if name == "none":
        return None
    made = known[name] if name in known else import_name(field, name)
    given = json.loads(kwargs)
    if callable(made) and not isinstance(made, kind):
        try:
            made = made(*arguments, **given)
        except (TypeError, ValueError, KeyError) as error:
            raise BadInput(f"{field}_kwargs: {name} cannot be made: {error}") from error
    elif given:
        raise BadInput(f"{field}_kwargs: {name} is a rule already and takes none")
    if not isinstance(made, kind):
        raise BadInput(f"{field}: {name} is not a sauna.{kind.__name__}")
    return made


def _function(field: str, name: str, known: Mapping[str, Any]) -> Any:
    """The function of that name; None for PPO's own.

    Raises:
      BadInput: a user's `module:name` is something else.
    """
    made = known[name] if name in known else import_name(field, name)
    if made is not None and not callable(made):
        raise BadInput(f"{field}: {name} is not a function")
    return made


def make_filter(config: Config) -> StepFilter | None:
    """The filter that `config` names, or None where every transition is kept.

    Raises:
      BadInput: a user's `module:name` is something else, or does not take its arguments.
    """
    if config.filter == "none":
        return None
    if config.filter == "random-drop":
        return random_drop()
    if config.filter == "sauna" and config.keep_rate_target:
        return sauna_at_rate(config.keep_rate_target)
    if config.filter == "sauna":
        rule = sauna_joint if config.decision == "joint" else sauna_per_env
        return rule(config.history, config.rollout_steps)
    own: StepFilter = _made("filter", config.filter, {}, StepFilter, config.filter_kwargs)
    return own
