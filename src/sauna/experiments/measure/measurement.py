"""What a measurement of trained members is: one record, of Python names and plain functions.

A study's `measure` names a record of this package (`BUILT_IN`), or a user's own as `module:name`.
Nothing here and nothing in a record's module imports JAX: the half that computes is named by
`compute` and imported in a process of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.experiments.report.figures import Section
from sauna.system.errors import BadInput, nearest

ALONG = (0.05, 0.25, 0.5, 0.75, 1.0)
BUILT_IN = {
    "noise": "sauna.experiments.measure.noise_report:MEASUREMENT",
    "coverage": "sauna.experiments.measure.coverage_report:MEASUREMENT",
    "posture": "sauna.experiments.measure.posture_report:MEASUREMENT",
}
FORMER_NAMES = {"dial": "coverage", "torso": "posture"}  # in studies and results of 0.1.0


def accept_all(configs: Sequence[Config]) -> None:
    """Accepts every study."""


def accept_spaces(config: Config, spaces: Spaces) -> None:
    """Accepts every environment."""


def always(config: Config) -> bool:
    return True


@dataclass(frozen=True)
class Measurement:
    """One kind of measurement of trained members.

    Attributes:
      name: of its folder and of its files.
      compute: `module:function`. It is called as `compute(snapshot, scale, file)` with the
        `MemberSnapshot` of a checkpoint, that of the scale (or None) and the file that the result
        is written to, and returns JSON values.
      report: what the study's page says of all results: `report(measured, folder)`, where `folder`
        is the study's, or None if there is none.
      points: shares of the budget in (0, 1], in rising order. A member is measured at the
        checkpoint nearest to each.
      check: raises BadInput where a study with these configs cannot be measured.
      check_spaces: raises BadInput where an environment with these spaces cannot be measured.
      applies: whether there is anything to measure of members with this config.
      scaled: whether `compute` needs a scale: the baseline's first seed at its end.
      curves: names of the members' curves that are stored beside the results.
    """

    name: str
    compute: str
    report: Callable[[Mapping[str, Any], Path | None], Section]
    points: tuple[float, ...] = ALONG
    check: Callable[[Sequence[Config]], None] = accept_all
    check_spaces: Callable[[Config, Spaces], None] = accept_spaces
    applies: Callable[[Config], bool] = always
    scaled: bool = False
    curves: tuple[str, ...] = ()

    def folder(self, place: Path) -> Path:
        """Returns where a study in `place` keeps this measurement's files; of 0.1.0 under the old
        name."""
        for former, name in FORMER_NAMES.items():
            if name == self.name and (place / former).is_dir():
                return place / former
        return place / self.name


def current_name(name: str) -> str:
    """Returns the name that a measurement has now."""
    return FORMER_NAMES.get(name, name)


def find_measurement(name: str) -> Measurement:
    """Finds a measurement of this package by name, or a user's own by `module:name`.

    Raises:
      BadInput: there is none, or what is there is no `Measurement`.
    """
    if not isinstance(name, str) or (":" not in name and name not in BUILT_IN):
        raise BadInput(
            f"study: measure must be one of {', '.join(BUILT_IN)}, or module:name, not {name!r}"
            f"{nearest(str(name), BUILT_IN)}"
        )
    found = import_name("measure", BUILT_IN.get(name, name))
    if not isinstance(found, Measurement):
        raise BadInput(f"measure: {name} is no sauna.experiments.measure.Measurement")
    return found


def check_measurement(measurement: Measurement, configs: Sequence[Config]) -> None:
    """Refuses a study whose members would lack what the measurement needs.

    Raises:
      BadInput: naming the setting.
    """
    for config in configs:
        rollout = config.rollout_steps * config.envs
        kept = config.keep_checkpoints * config.checkpoint_every * rollout
        if measurement.points[0] < 1 and kept < config.steps:
            every = min(config.checkpoint_every, -(-config.steps // (100 * rollout)))
            raise BadInput(
                "keep_checkpoints: measure needs the checkpoints along training; set "
                f"checkpoint_every = {every} and keep_checkpoints = "
                f"{-(-config.steps // (every * rollout))}"
            )
        if config.backend == "device":
            raise BadInput("backend: measure needs environments on the host")
    measurement.check(configs)
