"""What a study trains: tasks x arms x seeds, from a small declarative file.

    name = "mine"
    tasks = ["Hopper-v5", "HalfCheetah-v5"]
    seeds = 6
    steps = 1e6

    [[arms]]
    label = "ppo"

    [[arms]]
    label = "sauna 0.8"
    arm = "sauna"
    threshold = 0.8

Any setting of a run may stand at the top, for all arms, or in an arm. `baseline` is the label that
others are compared with. `question` is the title of the report. `measure` names what is measured of
the trained members: `noise` or `coverage` at checkpoints along their training, `posture` (of
HalfCheetah) at its end, or a `Measurement` of your own as `module:name`. An arm may name its own
`tasks`, `seeds` and `baseline`. The matched random control of `sauna 0.8` is another arm with its
settings and `arm = "sauna+random"`. With `design = "sequential"` an arm gets more seeds only while
it is open, `seeds` at most.
"""

from __future__ import annotations

import json
import os
import string
import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from sauna.config.checks import is_read
from sauna.config.presets import (
    RunConfig,
    arm_config,
    arm_settings,
    fixed_by,
    parse_all,
    resolve_run,
)
from sauna.config.settings import FIELDS, Config, fields_with, parse
from sauna.experiments.measure.measurement import (
    Measurement,
    check_measurement,
    current_name,
    find_measurement,
)
from sauna.experiments.sequential import Look, capped
from sauna.system.errors import BadInput, nearest
from sauna.system.safe_read import JSON_BYTES, Untrusted, read_file

_OWN = (*fields_with("decided_by_study"), "seeds")
_NAME = set(string.ascii_letters + string.digits + "-_.+")
_TOP = ("name", "question", "tasks", "seeds", "baseline", "arms", "measure", "design")
FORMER_STUDIES = {"dial": "threshold-sweep"}  # names in 0.1.0
_ARM = ("label", "arm", "tasks", "seeds", "baseline")


class Arm(NamedTuple):
    """One line of a comparison: a method with its settings, on some tasks and seeds."""

    label: str
    arm: str
    settings: dict[str, Any]  # as a user would give them, without env and seeds
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    baseline: str | None  # the label it is compared with

    def overrides(self, task: str, seeds: tuple[int, ...]) -> dict[str, Any]:
        """Gives the settings of a run of some seeds on one task."""
        return {**self.settings, "env": task, "arm": self.arm, "seeds": list(seeds)}


class Spec(NamedTuple):
    """A whole study; `text` is what it was read from, as JSON values."""

    name: str
    baseline: str
    arms: list[Arm]
    text: dict[str, Any]
    measure: str | None = None  # names the measurement of the trained members
    looks: tuple[Look, ...] = ()  # of a sequential design

    @property
    def measurement(self) -> Measurement | None:
        return find_measurement(self.measure) if self.measure else None

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(task for arm in self.arms for task in arm.tasks))


def read_spec(values: Mapping[str, Any]) -> Spec:
    """Reads the study that `values` describe.

    Raises:
      BadInput: an unknown key, a label twice or unknown, or settings that cannot be used.
    """
    for key in values:
        if key not in _TOP and (key not in FIELDS or key in (*_OWN, "arm")):
            known = [*_TOP, *(name for name in FIELDS if name not in (*_OWN, "arm"))]
            raise BadInput(f"study: unknown key {key!r}{nearest(key, known)}")
    common = {key: value for key, value in values.items() if key not in _TOP}
    parse_all(common)
    name = _text(values.get("name", "study"), "name")
    if name in ("units", "") or not set(name) <= _NAME or not name.strip("."):
        raise BadInput(f"study: name {name!r} cannot be a folder of its own under --out")
    entries = values.get("arms") or []
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise BadInput("study: arms must be a list of tables")
    if not entries:
        raise BadInput("study: no arms")
    for key in ("tasks", "seeds"):
        if key in values and all(key in entry for entry in entries):
            raise BadInput(f"study: {key} is read by none of the arms, which have their own")
    arms = [_read_arm(dict(entry), values, common) for entry in entries]
    _check_common(common, arms)
    labels = [arm.label for arm in arms]
    for label in labels:
        if labels.count(label) > 1:
            raise BadInput(f"study: the label {label!r} is given twice")
    baseline = _text(values.get("baseline", labels[0]), "baseline")
    arms = [_settle(arm, arms, baseline) for arm in arms]
    if "question" in values:
        _text(values["question"], "question")
    measure = values.get("measure")
    if isinstance(measure, str):
        measure = current_name(measure)
    spec = Spec(name, baseline, arms, _plain(values), measure, _design(values, arms, baseline))
    configs = [check(arm, task) for arm in arms for task in arm.tasks]
    if measure is not None:
        _check_measure(spec, find_measurement(measure), configs)
    return spec


def _design(values: Mapping[str, Any], arms: list[Arm], baseline: str) -> tuple[Look, ...]:
    """Reads whether seeds come in looks; the looks, none for a fixed number of seeds."""
    design = values.get("design", "fixed")
    if design not in ("fixed", "sequential"):
        raise BadInput(f"study: design must be fixed or sequential, not {design!r}")
    if design == "fixed":
        return ()
    if "measure" in values:
        raise BadInput("study: measure needs a fixed design")
    for arm in arms:
        if arm.seeds != arms[0].seeds or arm.baseline not in (None, baseline):
            raise BadInput(
                "study: a sequential design has the same seeds and baseline for all arms"
            )
        if arm.arm == "random-drop":
            raise BadInput("study: random-drop is no arm of a sequential design; use sauna+random")
    try:
        return capped(len(arms[0].seeds))
    except ValueError as error:
        raise BadInput(f"seeds: {error}; `--arms` with a list trains more") from None


def _check_measure(spec: Spec, measurement: Measurement, configs: list[Config]) -> None:
    """Refuses a study that cannot be measured, or whose scale would be missing."""
    check_measurement(measurement, configs)
    if measurement.scaled:
        scaled = next(arm.tasks for arm in spec.arms if arm.label == spec.baseline)
        if missing := set(spec.tasks) - set(scaled):
            raise BadInput(
                f"study: {measurement.name} needs {spec.baseline!r} on "
                f"{', '.join(sorted(missing))}, too"
            )


def _read_arm(entry: dict[str, Any], top: Mapping[str, Any], common: dict[str, Any]) -> Arm:
    for key in entry:
        if key not in _ARM and (key not in FIELDS or key in _OWN):
            known = [*_ARM, *(name for name in FIELDS if name not in _OWN)]
            raise BadInput(f"study: unknown key {key!r} in an arm{nearest(key, known)}")
    arm = _text(entry.get("arm", entry.get("label")), "arm")
    arm_settings(arm)
    tasks = entry.get("tasks", top.get("tasks"))
    if not isinstance(tasks, list) or not tasks or len(set(map(str, tasks))) < len(tasks):
        raise BadInput("study: tasks must be a list of environments, each of them once")
    seeds = parse("seeds", entry.get("seeds", top.get("seeds", 6)))
    own = {key: value for key, value in entry.items() if key not in _ARM}
    return Arm(
        _text(entry.get("label", arm), "label"),
        arm,
        {
            **{key: value for key, value in common.items() if reads(arm, {**common, **own}, key)},
            **own,
        },
        tuple(_text(task, "tasks") for task in tasks),
        seeds,
        _text(entry["baseline"], "baseline") if "baseline" in entry else None,
    )


def reads(arm: str, settings: Mapping[str, Any], key: str) -> bool:
    """Returns whether a run of `arm` with these settings takes the setting `key` at all."""
    config = arm_config(arm, parse_all(settings))
    return is_read(key, config) and key not in fixed_by(arm)


def _check_common(common: Mapping[str, Any], arms: list[Arm]) -> None:
    """Refuses a setting for all arms that none of them takes."""
    for key in common:
        if not any(key in arm.settings for arm in arms):
            raise BadInput(
                f"study: {key} is read by none of the arms {', '.join(arm.label for arm in arms)}"
            )


def _text(value: Any, key: str) -> str:
    if not isinstance(value, str) or not value:
        raise BadInput(f"study: {key} must be a name, not {value!r}")
    return value


def _settle(arm: Arm, arms: list[Arm], baseline: str) -> Arm:
    """Fills in the baseline of an arm that names none."""
    known = {other.label: other for other in arms}
    own = arm.baseline or (None if arm.label == baseline else baseline)
    for name in (own, baseline):
        if name is not None and name not in known:
            raise BadInput(f"study: there is no arm {name!r}{nearest(name, known)}")
    if own == arm.label:
        raise BadInput(f"study: {own!r} cannot be its own baseline")
    if own is not None and (missing := set(arm.tasks) - set(known[own].tasks)):
        raise BadInput(
            f"study: {own!r}, the baseline of {arm.label!r}, is not trained on "
            f"{', '.join(sorted(missing))}"
        )
    return arm._replace(baseline=own)


def check(arm: Arm, task: str) -> Config:
    """Resolves the config of a run of `arm`; see `resolved`."""
    return resolved(arm, task).config


def resolved(arm: Arm, task: str) -> RunConfig:
    """Resolves a run of all seeds of `arm`.

    Raises:
      BadInput: the settings cannot be used; the label is named.
    """
    try:
        return resolve_run(arm.overrides(task, arm.seeds))
    except BadInput as error:
        raise BadInput(f"study, arm {arm.label!r}: {error}") from None


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return dict(json.loads(json.dumps(values)))
    except TypeError as error:
        raise BadInput(f"study: {error}") from None


def load_spec(name: str, check: Callable[[Mapping[str, Any]], None] = lambda text: None) -> Spec:
    """Loads a study of this package by name, or one in a TOML file.

    Args:
      check: refuses what a file says, before anything of it is imported.

    Raises:
      BadInput: there is no such study or file, or it cannot be read.
    """
    known = built_in()
    current = FORMER_STUDIES.get(name, name)
    if current in known:  # under a former name it goes on in the folder of that name
        return read_spec({**tomllib.loads(known[current]), "name": name})
    path = Path(name)
    if not os.path.lexists(path):
        listed = ", ".join(known)
        raise BadInput(f"study: no study or file {name!r} (known: {listed}){nearest(name, known)}")
    try:
        values = tomllib.loads(read_file(Path(os.path.realpath(path)), JSON_BYTES).decode())
    except (Untrusted, ValueError, RecursionError) as error:
        raise BadInput(f"study: cannot read {path}: {error}") from error
    check({"name": path.stem, **values})
    return read_spec({"name": path.stem, **values})


def built_in() -> dict[str, str]:
    """Returns the studies of this package: `{name: text}`."""
    folder = resources.files("sauna.experiments.study") / "studies"
    return {
        entry.name.removesuffix(".toml"): entry.read_text()
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name)
        if entry.name.endswith(".toml")
    }
