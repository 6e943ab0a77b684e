"""How far a member's budget reaches, and its hyperparameters on the way."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.types import Array, Hypers
from sauna.config.checks import has_room
from sauna.config.settings import Config
from sauna.training.loop.job import Setting
from sauna.training.loop.member_state import Counters
from sauna.training.loop.schedules import scheduled


def budget_left(config: Config, counters: Counters) -> bool:
    """Returns whether a whole rollout still fits in the budget: a run never oversteps it.

    A member that was stopped early has none left.
    """
    return not counters.stopped and has_room(config, counters.env_steps, counters.kept_steps)


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
    values = {name: getattr(member_config, name) for name in Hypers._fields}
    coming = member_config.rollout_steps * member_config.envs
    values |= scheduled(member_config, values, used, member_config.steps, coming)
    return Hypers(**{name: np.float32(value) for name, value in values.items()})  # type: ignore[arg-type]


def device_hypers(config: Config, setting: Setting, used: Array) -> Hypers:
    """Computes a member's hyperparameters from `setting`, when `used` steps of its budget are."""
    first, coming = setting.hypers._asdict(), config.rollout_steps * config.envs
    moved = scheduled(config, first, used.astype(jnp.float32), setting.steps, coming)
    return setting.hypers._replace(**moved)
