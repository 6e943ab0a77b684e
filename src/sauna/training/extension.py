"""Training a run further than it was to go: what `resume` may change of its end, and what follows.

Each schedule reads the share of the budget that is left, and a warm-up lasts a share of it. With
more steps both are longer: from there on the run has the values of a run that was given so many
steps at once. Restarted ones begin anew at the end of the steps before.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.config.presets import RunConfig
from sauna.config.readers import moved_by
from sauna.config.settings import Config, fields_with, to_json
from sauna.system import run_directory
from sauna.system.errors import BadInput

CHANGED = (*fields_with("extends_run"), "schedule_start")
GOES_FURTHER = ("steps", "stop_at", "stop_when_flat")  # what lets a complete run go on


def check_extension(before: Config, after: Config) -> None:
    """Refuses to cut a budget.

    Raises:
      BadInput: there are fewer steps than before.
    """
    if after.steps < before.steps:
        raise BadInput(f"steps: can only grow on resume; the run has {before.steps}")


def check_restart(path: Path, before: Config, parsed: Mapping[str, Any]) -> int:
    """Returns the step of the budget at which the schedules begin anew.

    Raises:
      BadInput: no steps are added, the run has not ended, or nothing is scheduled.
    """
    if parsed.get("steps", 0) <= before.steps:
        raise BadInput(f"restart_schedule: needs steps above {before.steps}")
    if not run_directory.is_complete(path):
        raise BadInput(f"restart_schedule: {path} is not complete; resume it first")
    if not moved_by(before):
        raise BadInput("restart_schedule: the run has no schedule or warm-up of its budget")
    return before.steps


def extension(before: RunConfig, changed: RunConfig) -> RunConfig:
    """Takes over from `changed` what is stored of a resume: that which extends the run."""
    return before.replace(**{name: getattr(changed.config, name) for name in CHANGED})


def extended(stored: Mapping[str, Any], before: RunConfig) -> list[dict[str, Any]]:
    """Lists what a run was to be before: of earlier checkpoints, the values that have changed."""
    values = to_json(before.config)
    return [*stored.get("extended", []), {name: values[name] for name in CHANGED}]


def goes_further(before: Config, after: Config) -> bool:
    """Returns whether a run that was complete may have to go on."""
    return any(getattr(before, name) != getattr(after, name) for name in GOES_FURTHER)


def describe_extension(before: Config, after: Config) -> str:
    """Says in a line how far a run goes now, and what its schedules do; empty if not further."""
    if after.steps == before.steps:
        return ""
    text = f"steps: {before.steps:,} -> {after.steps:,}"
    if not (names := moved_by(after)):
        return text
    named = ", ".join(names)
    if after.schedule_start != before.schedule_start:
        return f"{text}; {named}: anew from {after.schedule_start:,} to {after.steps:,}"
    left = 1 - (before.steps - after.schedule_start) / (after.steps - after.schedule_start)
    return (
        f"{text}; {named}: as in a run of {after.steps:,} steps, with {left:.0%} left at "
        f"{before.steps:,}"
    )
