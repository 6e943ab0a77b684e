"""A study's work in units: each is an ordinary run of a few seeds of one arm on one task.

A unit's folder is named after its settings (those that differ from a run's defaults, however they
were written), so that studies which share settings share the work, and a study that is run again
finds what is done.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sauna.config.plugins import label_of
from sauna.config.presets import BEFORE
from sauna.config.settings import Config, to_json
from sauna.experiments.study.spec import Arm, Spec, check
from sauna.system import run_directory
from sauna.system.safe_write import own_folder

SEEDS = 3  # per unit: members of one process share the cost of each vector step
RULES = 1  # to be raised when a default changes, so that runs of before are not taken for new ones
# How often the numbers of a rule have changed since units got their names; see `revision`.
REVISIONS = {"kondo": 1, "prioritized": 1, "vex-oracle": 1, "pods": 1}


class Unit(NamedTuple):
    """A run to be made.

    Attributes:
      name: of its folder.
      settings: of the run, without the place.
    """

    name: str
    task: str
    label: str
    seeds: tuple[int, ...]
    settings: dict[str, Any]

    def run(self, folder: Path) -> Path:
        """Returns the run directory."""
        return folder / self.name / "run"

    def overrides(self, folder: Path) -> dict[str, Any]:
        """Gives all settings of the run."""
        return {**self.settings, "out": str(self.run(folder)), "processes": 1}

    def error(self, folder: Path) -> str | None:
        """Returns why it failed for good, or None."""
        path = folder / self.name / "failed.json"
        return str(run_directory.read_config_file(path).get("error")) if path.is_file() else None

    def is_complete(self, folder: Path) -> bool:
        return run_directory.is_complete(self.run(folder))


def seeds_per_unit(spec: Spec, cores: int) -> int:
    """Returns as many as share a process well, or fewer where cores would stay idle; as even as
    can be without another unit."""

    def units(size: int) -> int:
        return sum(-(-len(arm.seeds) // size) * len(arm.tasks) for arm in spec.arms)

    most = next((size for size in range(SEEDS, 1, -1) if units(size) >= cores), 1)
    return next(size for size in range(1, SEEDS + 1) if units(size) == units(most))


def most_seeds(spec: Spec) -> int:
    """Returns all seeds of an arm: a GPU trains them in little more time than one."""
    return max(len(arm.seeds) for arm in spec.arms)


def units_of(spec: Spec, size: int) -> list[Unit]:
    """Returns all units of `size` seeds at most, arm by arm."""
    return [
        _unit(arm, task, seeds)
        for arm in spec.arms
        for task in arm.tasks
        for seeds in _parts(arm, size)
    ]


def _parts(arm: Arm, size: int) -> Iterator[tuple[int, ...]]:
    for first in range(0, len(arm.seeds), size):
        yield arm.seeds[first : first + size]


def _unit(arm: Arm, task: str, seeds: tuple[int, ...]) -> Unit:
    digest = digest_of([RULES, identity(arm, task, seeds), None])  # None: as units were named
    place = "".join(c if c.isalnum() or c in "-." else "-" for c in task)
    label = label_of(arm.arm, arm.settings)
    name = f"{place}_{label}_{seeds[0]}-{seeds[-1]}_{digest}"
    return Unit(name, task, arm.label, seeds, arm.overrides(task, seeds))


def identity(arm: Arm, task: str, seeds: tuple[int, ...]) -> dict[str, Any]:
    """What of a run's config differs from the defaults: the same for the same training.

    The defaults are those of when units got their names. A rule whose numbers have changed since
    then adds its revision, so that its runs of before are not taken for new ones.
    """
    config = check(arm._replace(seeds=seeds), task)
    usual = {**to_json(Config()), **BEFORE, "arm": ["sauna"]}
    found = {name: value for name, value in to_json(config).items() if value != usual[name]}
    number = revision(config)
    return {**found, "rule_revision": number} if number else found


def revision(config: Config) -> int:
    """Returns how often the numbers of a run's sampler have changed; 0 where none has moved.

    Runs of before stay valid where a change moved nothing: of `pods` whose segments fit into a
    rollout, of controls of `prioritized` that are not weighted, of `kondo` for all losses.
    """
    unmoved = {
        "pods": config.rollout_steps >= json.loads(config.sampler_kwargs).get("length", 64),
        "prioritized": config.control not in ("none", "reversed"),
        "kondo": config.selection_losses == "all",
    }
    return 0 if unmoved.get(config.sampler) else REVISIONS.get(config.sampler, 0)


def study_identity(spec: Spec) -> list[Any]:
    """Returns everything that a study trains and compares: the same for the same study."""
    return [
        [arm.label, arm.baseline, None, identity(arm, task, arm.seeds)]
        for arm in spec.arms
        for task in arm.tasks
    ] + [spec.measure, *(["sequential"] if spec.looks else [])]


def digest_of(values: Any) -> str:
    """Returns a name for JSON values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:10]


def split(unit: Unit) -> list[Unit]:
    """Returns a unit of several seeds as units of one: so that the others go on where one
    failed."""
    return [
        unit._replace(
            name=f"{unit.name}/seed-{seed}",
            seeds=(seed,),
            settings={**unit.settings, "seeds": [seed]},
        )
        for seed in unit.seeds
    ]


def mark_split(unit: Unit, folder: Path) -> None:
    """Notes that the unit's seeds are trained one by one from now on."""
    own_folder(folder / unit.name)
    run_directory.write_json(folder / unit.name / "split.json", {"seeds": list(unit.seeds)})


def _is_split(place: Path) -> bool:
    return (place / "split.json").exists()


def parts(unit: Unit, folder: Path) -> list[Unit]:
    """Returns the units that hold the runs: the unit itself, or one per seed where it was split."""
    is_split = _is_split(folder / unit.name) and not unit.is_complete(folder)
    return split(unit) if is_split else [unit]
