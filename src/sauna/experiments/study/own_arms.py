"""A rule of the user's own as an arm of a comparison: `my_samplers:signed_top`.

Such an arm is `ppo` with that sampler, loss weight or stop rule, or `sauna` with that filter. What
is joined to it by `+` is joined to that: `my_samplers:signed_top+random` is its matched control.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from typing import Any

from sauna.config.controls import control_of, rule_of
from sauna.config.plugins import import_name
from sauna.config.presets import RANDOM_CONTROL
from sauna.experiments.study.spec import reads
from sauna.system.errors import BadInput
from sauna.system.jax_setup import configure_jax

STAGES = ("filter", "sampler", "loss_weight", "stop")  # fields that name a rule of selection


def is_own(arm: str) -> bool:
    """Returns whether an arm is named as `module:name`."""
    return ":" in arm


def control_of_any(arm: str, given: Mapping[str, Any]) -> str | None:
    """Names the matched random control of an arm, the user's own or built in; see `control_of`."""
    if not is_own(arm):
        return control_of(arm, given)
    chosen = given.get("control", "none") != "none" or rule_of(arm) is not None
    return None if chosen or stage_of(arm, given) == "stop" else arm + RANDOM_CONTROL


def check_no_rule(settings: Mapping[str, Any], arms: Sequence[str]) -> None:
    """Refuses a rule for all arms at once, which would train under the names of others.

    Raises:
      BadInput: saying what to write.
    """
    for name in STAGES:
        value = settings.get(name, "none")
        if value != "none":
            raise BadInput(
                f"{name}: in a comparison a rule is an arm: write --arms {arms[0]},{value}"
            )


def with_own_arms(
    arms: Sequence[str], settings: Mapping[str, Any]
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Writes each arm as a study's entry.

    Arguments of rules (`sampler_kwargs`, ...) are those of the user's own rules if there are any.

    Returns:
      the entries, and the settings of all arms.
    """
    stages = {arm: stage_of(arm, settings) for arm in arms if is_own(arm)}
    taken = {f"{stage}_kwargs" for stage in stages.values()}
    common = {name: value for name, value in settings.items() if name not in taken}
    return [
        _entry(arm, stages[arm], settings) if arm in stages else {"label": arm} for arm in arms
    ], common


def _entry(arm: str, stage: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    rule, plus, others = arm.partition("+")
    base = "sauna" if stage == "filter" else "ppo"
    own: dict[str, Any] = {stage: rule}
    if (name := f"{stage}_kwargs") in settings:
        own[name] = json.loads(settings[name])
    name = "normalize_over"
    if stage == "sampler" and name not in settings and reads("ppo", {**settings, **own}, name):
        own[name] = "rollout"  # as the built-in samplers: a choice by A shifts the mean of A
    return {"label": arm, "arm": base + plus + others, **own}


def stage_of(arm: str, given: Mapping[str, Any]) -> str:
    """Finds which field takes the user's own rule; its module is imported.

    A function whose first parameter is `setup` makes a sampler. Others are called with the
    arguments that are given.

    Raises:
      BadInput: it is no rule and makes none.
    """
    name = arm.partition("+")[0]
    configure_jax()
    thing = import_name("arms", name)
    from sauna.algorithm.types import LossWeight, Sampler, StepFilter, StopRule

    kinds = dict(zip(STAGES, (StepFilter, Sampler, LossWeight, StopRule), strict=True))
    for stage, kind in kinds.items():
        if isinstance(thing, kind):
            return stage
    if callable(thing):
        if next(iter(inspect.signature(thing).parameters), "") == "setup":
            return "sampler"
        for stage, kind in kinds.items():
            try:
                made = thing(**json.loads(given.get(f"{stage}_kwargs", "{}")))
            except (TypeError, ValueError, KeyError):
                continue
            if isinstance(made, kind):
                return stage
    raise BadInput(
        f"arms: {name} is no Sampler, StepFilter, LossWeight or StopRule, and makes none (a "
        f"function that makes a Sampler takes `setup` first)"
    )
