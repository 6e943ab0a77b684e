"""What a setting is: its default, its help line, the values it accepts, and who may change it.

Everything about a setting stands at the setting, in `Config`. To add one, add a line
there: the command line, `config.json`, the checks, resuming and studies read its marks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

# The groups of `--help`, in its order.
GROUPS = (
    "task",
    "run",
    "where it runs",
    "evaluation",
    "learning",
    "network",
    "normalisation",
    "selection",
    "update rules",
)


def option(
    default: Any,
    help: str,
    *,
    group: str,
    common: bool = False,
    choices: tuple[str, ...] = (),
    plugin: bool = False,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    shapes_program: bool = True,
    read_when: tuple[str, Callable[[Any], bool]] | None = None,
    needs_spaces: tuple[str, Callable[[Any], bool]] | None = None,
    device_only: bool = False,
    resumable: bool = False,
    extends_run: bool = False,
    machine_local: bool = False,
    decided_by_study: bool = False,
    rule_of_experiment: bool = False,
) -> Any:
    """Declares a field of `Config`.

    Args:
      default: its value where neither a preset, an arm nor the user gives one.
      help: its line in `--help`.
      group: one of `GROUPS`.
      common: whether most people need it; `--help` shows these first.
      choices: the values of a text; none: any text.
      plugin: it may name a part of the user's own, `module:name`, which Python takes by value.
      at_least, above, at_most: bounds of a number, or of each number of a list.
      shapes_program: False for a value that is traced (one compiled program serves members that
        differ in it) or that does not touch training at all.
      read_when: what reads it, in words and as a predicate of a config. A value that the user
        gives and nothing reads is refused, so that no setting is silently without effect.
      needs_spaces: what it needs of the environment, in words and as a predicate of its `Spaces`.
      device_only: it is read only by environments on the device.
      resumable: `resume` may change it: it does not touch what is computed, or only its rounding
        when another number of devices computes it.
      extends_run: `resume` may change it, and the run goes on with the new value from there on: it
        says how far a run goes, or how it is watched, and not how it learns.
      machine_local: machines that train together may differ in it.
      decided_by_study: a study or a comparison sets it itself.
      rule_of_experiment: a rule of the experiment rather than of the filter. An unfiltered arm that
        shares the program of a filtered one takes it over: only the filter differs.
    """
    metadata = {name: value for name, value in locals().items() if name != "default"}
    return dataclasses.field(default=default, metadata=metadata)
