"""Several settings as the arms of one run: its members are trained in lockstep."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sauna.config.presets import RunConfig, resolve_run
from sauna.config.settings import Config, fields_with
from sauna.experiments.tune.plan import Plan
from sauna.system.errors import BadInput
from sauna.training import run as runs
from sauna.training.coordinator import Callback
from sauna.training.display import Display
from sauna.training.prepare import Prepared, examine, place
from sauna.training.train import train_run

CHECKPOINTS = 10  # of a trial, if nobody says how often


class Tuning(NamedTuple):
    """What a search or a population works on.

    Attributes:
      plan: what is searched.
      start: what every trial or member starts from, prepared.
      folder: of the tuning.
      display: makes what shows a training.
      accept_changed_code: continue runs whose code is not what it was.
    """

    plan: Plan
    start: Prepared
    folder: Path
    display: Callable[[], Display]
    accept_changed_code: bool = False


def joined(settings: Mapping[str, Mapping[str, Any]], seeds: Sequence[int]) -> RunConfig:
    """Resolves settings as the arms of one run.

    Args:
      settings: by the name of the arm, as a user would give them.
      seeds: of each arm.

    Raises:
      BadInput: some cannot be used, or they differ in what shapes the program.
    """
    names, found = tuple(settings), {}
    for name, own in settings.items():
        config = _only(resolve_run({**own, "seeds": list(seeds)}))
        found[name] = dataclasses.replace(config, arm=names)
    first = next(iter(found.values()))
    for name, config in found.items():
        for field in fields_with("shapes_program"):
            if getattr(config, field) != getattr(first, field):
                raise BadInput(f"{name} differs from {names[0]} in {field}")
    return RunConfig(first, found)


def _only(run: RunConfig) -> Config:
    (config,) = run.arms.values()
    return config


def prepared_batch(
    settings: Mapping[str, Mapping[str, Any]], seeds: Sequence[int], start: Prepared, out: Path
) -> Prepared:
    """Prepares a run of several settings; its environment is `start`'s.

    Raises:
      BadInput: as `joined`.
    """
    first = next(iter(settings.values()))
    run = place(joined(settings, seeds))
    changes: dict[str, Any] = {"out": str(out)}
    if "checkpoint_every" not in first:
        config = run.config
        iterations = config.steps // (config.rollout_steps * config.envs)
        changes["checkpoint_every"] = max(iterations // CHECKPOINTS, 1)
    return examine(run.replace(**changes), {**first, "seeds": list(seeds)}, start.found)


def train(
    prepared: Prepared,
    display: Display,
    callback: Callback | None,
    accept_changed_code: bool = False,
    until: int | None = None,
) -> None:
    """Trains a batch to its end, or to iteration `until`; one that was begun is continued.

    Raises:
      BadInput: the folder cannot be used.
      Interrupted: a signal came; the state is saved.
      SaunaError: the training failed.
    """
    path = Path(prepared.config.out)
    resume = (path / "config.json").exists()
    if resume:
        run = runs.reopen(path, {}, display, accept_changed_code=accept_changed_code)
    else:
        run = runs.create(prepared, display)
    train_run(run, display, resume=resume, callback=callback, until=until)
