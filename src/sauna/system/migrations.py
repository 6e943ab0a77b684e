"""What an older version stored, as today's would have stored it. Plain JSON values."""

from __future__ import annotations

from typing import Any

REMOVED = ("drop_rate_from", "tensorboard")  # fields that 0.1.0 had: stored values are left out
_UNFILTERED = ("ppo", "vex-head")
_VEX_COEF = 0.5  # the default of 0.1.0


def with_arms(stored: dict[str, Any]) -> dict[str, Any]:
    """Adds `arms` to a config.json or a manifest of 0.1.0, which kept what the user gave instead.

    `arms[name]` holds the values in which an arm differs from `config`. There were two: `ppo` had
    no Vex loss, and an arm that did not filter had threshold 0 beside one that did. `config` was
    that of the first arm that filtered, or else of the first arm.
    """
    if "arms" in stored:
        return stored
    config, given = stored.get("config", {}), stored.get("given", {})
    names = config.get("arm", [])
    filtering = any(name not in _UNFILTERED for name in names)
    arms: dict[str, dict[str, Any]] = {}
    for name in names:
        own: dict[str, Any] = {}
        if name == "ppo":
            own["vex_coef"] = 0.0
        elif not filtering and names[0] == "ppo":
            own["vex_coef"] = given.get("vex_coef", _VEX_COEF)
        if filtering and name in _UNFILTERED:
            own["threshold"] = 0.0
        arms[name] = {key: value for key, value in own.items() if config.get(key) != value}
    rest = {key: value for key, value in stored.items() if key != "given"}
    return {**rest, "arms": arms}


def without_removed(settings: dict[str, Any]) -> dict[str, Any]:
    """Leaves out stored settings of fields that exist no more; `tensorboard` was a tracker."""
    kept = {name: value for name, value in settings.items() if name not in REMOVED}
    return {"track": ["tensorboard"], **kept} if settings.get("tensorboard") is True else kept
