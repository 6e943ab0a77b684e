"""Which matched random control belongs to an arm: `gigaflow+random` to `gigaflow`.

A control chooses as many samples as its rule in each iteration, without the rule's idea, so that
the two differ in the choice alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from sauna.config.checks import check_rules
from sauna.config.presets import CONTROLS, RANDOM_CONTROL, arm_config, arm_settings, parse_all
from sauna.system.errors import BadInput


def control_of(arm: str, given: Mapping[str, Any] = MappingProxyType({})) -> str | None:
    """Names the matched random control of an arm, such as `gigaflow+random`.

    None for an arm that chooses no samples, is a control itself, or can have none with these
    settings of the user's.
    """
    if rule_of(arm) is not None or given.get("control", "none") != "none":
        return None
    control = arm + RANDOM_CONTROL
    try:
        check_rules(arm_config(control, parse_all(given)))
    except BadInput:
        return None
    return control


def rule_of(arm: str) -> str | None:
    """Names the arm that a control follows, `gigaflow` of `gigaflow+random`; None for others."""
    rule, _, control = arm.rpartition("+")
    return rule if rule and control in CONTROLS else None


def with_controls(
    arms: Sequence[str],
    given: Mapping[str, Any],
    control_of: Callable[[str, Mapping[str, Any]], str | None] = control_of,
) -> tuple[str, ...]:
    """Puts behind each arm that chooses samples its matched random control.

    An arm with a control among `arms` gets no other; `random-drop` is one of every filter.

    Args:
      control_of: names the control of an arm.
    """
    named = {rule_of(arm) for arm in arms}
    if "random-drop" in arms:
        built_in = (arm for arm in arms if ":" not in arm)
        named |= {arm for arm in built_in if arm_settings(arm)["filter"] != "none"}
    found = []
    for arm in arms:
        control = control_of(arm, given) if arm not in named else None
        found += [arm, *([control] if control else [])]
    return tuple(found)
