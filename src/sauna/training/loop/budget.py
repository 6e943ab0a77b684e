"""How far a member's budget reaches, and its hyperparameters on the way."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.types import Array, Hypers
from sauna.config.settings import Config
from sauna.training.loop.job import Setting
from sauna.training.loop.member_state import Counters


def budget_left(config: Config, counters: Counters) -> bool:
    """Returns whether a whole rollout still fits in the budget: a run never oversteps it.

    A member that was stopped early has none left.
    """
    if counters.stopped:
        return False
    used = counters.kept_steps if config.budget == "kept" else counters.env_steps
    return config.steps - used >= config.rollout_steps * config.envs


def step_limit(config: Config, counters: Counters) -> int:
    """Counts the env steps that each env may try in the coming rollout; 0: it has finished."""
    if not budget_left(config, counters):
        return 0
    if config.budget == "kept":
        return capacity(config)
    return min(capacity(config), (config.steps - counters.env_steps) // config.envs)


def hypers_now(member_config: Config, counters: Counters) -> Hypers:
    """Computes the traced hyperparameters of a member, of whose budget `counters` are used."""
    used = counters.kept_steps if member_config.budget == "kept" else counters.env_steps
    left = share_left(member_config, used)
    values = {name: getattr(member_config, name) for name in Hypers._fields}
    values["threshold"] = scheduled(member_config.threshold, member_config.threshold_schedule, left)
    if member_config.learning_rate_schedule == "linear":
        values["learning_rate"] = member_config.learning_rate * left
    return Hypers(**{name: np.float32(value) for name, value in values.items()})  # type: ignore[arg-type]


def share_left(config: Config, used: int) -> float:
    """Computes the share of the schedules that is left when `used` steps of the budget are used.

    It is 1 up to `schedule_start` and falls to 0 at the end of the budget.
    """
    if not config.schedule_start:
        return 1.0 - used / config.steps
    first = config.schedule_start
    return min(1.0, 1.0 - (used - first) / (config.steps - first))


def scheduled(threshold: Any, schedule: str, left: Any) -> Any:
    """Schedules the threshold, when the share `left` of the budget is left."""
    return {"constant": threshold, "rising": threshold * (1.0 - left), "falling": threshold * left}[
        schedule
    ]


def device_hypers(config: Config, setting: Setting, used: Array) -> Hypers:
    """Computes a member's hyperparameters from `setting`, when `used` steps of its budget are."""
    left, rate = _device_share_left(config, setting, used), setting.hypers.learning_rate
    return setting.hypers._replace(
        learning_rate=rate * left if config.learning_rate_schedule == "linear" else rate,
        threshold=scheduled(setting.hypers.threshold, config.threshold_schedule, left),
    )


def _device_share_left(config: Config, setting: Setting, used: Array) -> Array:
    """The device's twin of `share_left`."""
    if not config.schedule_start:
        return 1.0 - used.astype(jnp.float32) / setting.steps
    first = config.schedule_start
    after = (used - first).astype(jnp.float32) / (setting.steps - first)
    return jnp.minimum(1.0, 1.0 - after)
