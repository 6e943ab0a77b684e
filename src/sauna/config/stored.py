"""The settings of a run as `config.json` and the manifests of its checkpoints hold them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from sauna.config.presets import BEFORE, RunConfig, parse_all
from sauna.config.settings import Config, to_json
from sauna.system.errors import BadInput
from sauna.system.migrations import with_arms, without_removed

NAMES_RULES = "names_rules"


def to_stored(run: RunConfig) -> dict[str, Any]:
    """Writes `config`, and in `arms` the values in which each arm differs from it.

    If members are called by a rule of the user's own, that is noted.
    """
    shared = to_json(run.config)
    arms = {
        arm: {name: value for name, value in to_json(config).items() if value != shared[name]}
        for arm, config in run.arms.items()
    }
    return {"config": shared, "arms": arms, **({NAMES_RULES: True} if run.names_rules else {})}


def read_stored(stored: Mapping[str, Any]) -> RunConfig:
    """Reads what `to_stored` wrote, or what 0.1.0 did; needs no default or preset of today.

    Raises:
      BadInput: it holds no config, or a key or a value cannot be read.
    """
    for name in ("config", "arms", "given"):
        if not isinstance(stored.get(name, {}), dict):
            raise BadInput(f"config: {name!r} is no table")
    if not stored.get("config"):
        raise BadInput("config: it holds no 'config'")
    config = stored_config(stored["config"])
    arms: dict[str, dict[str, Any]] = with_arms(dict(stored))["arms"]
    if set(arms) != set(config.arm) or not all(isinstance(own, dict) for own in arms.values()):
        raise BadInput(f"config: 'arms' must hold a table for each of {', '.join(config.arm)}")
    own = {
        arm: dataclasses.replace(config, **parse_all(without_removed(arms[arm])))
        for arm in config.arm
    }
    return RunConfig(config, own, stored.get(NAMES_RULES) is True)


def stored_config(stored: Mapping[str, Any]) -> Config:
    """Reads the config that `settings.to_json` wrote, perhaps before some fields existed.

    A field that is missing has its default, or what was done before it existed (`BEFORE`). One
    that exists no more is left out.

    Raises:
      BadInput: a key is unknown, or a value cannot be read.
    """
    return Config(**parse_all({**BEFORE, **without_removed(dict(stored))}))
