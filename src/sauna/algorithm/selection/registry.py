"""Which rule a name means."""

from __future__ import annotations

from sauna.algorithm.selection.random_drop import random_drop
from sauna.algorithm.selection.vex_filter import sauna_at_rate, sauna_joint, sauna_per_env
from sauna.algorithm.types import Filter
from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.system.errors import BadInput


def make_filter(config: Config) -> Filter | None:
    """The filter that `config` names, or None where every transition is kept.

    Raises:
      BadInput: a user's `module:name` is something else.
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
    filter = import_name("filter", config.filter)
    if not isinstance(filter, Filter):
        raise BadInput(f"filter: {config.filter} is not a sauna.Filter")
    return filter
