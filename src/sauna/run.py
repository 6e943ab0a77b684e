"""A run on disk: checked before anything is created, reopened only as what it was.

Nothing here imports JAX (unless the user brings plug-ins of their own): bad input is answered at
once, and the training itself happens in the workers that `coordinator.py` starts.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from sauna import checkpoint, rundir
from sauna.config import Config, check_read, to_json
from sauna.coordinator import Coordinator
from sauna.envs.probe import Probe, probe
from sauna.errors import BadInput
from sauna.metrics.display import Display
from sauna.metrics.tensorboard import TensorBoard
from sauna.presets import Member, members, resolve, stored_config
from sauna.spaces import Spaces

# Fields that `resume` may change: they do not touch what is computed.
RESUMABLE = ("processes", "env_processes", "env_timeout", "checkpoint_every", "keep_checkpoints",
             "tensorboard")  # fmt: skip


class Run:
    """One run on disk, ready to be trained further."""

    def __init__(
        self, path: Path, given: dict[str, Any], config: Config, found: Probe, held: IO[str]
    ) -> None:
        self.path, self.given, self.config, self.held = path, given, config, held
        self.spaces, self.differs = found
        self.members: list[Member] = members(config, given)
        self.drop_rates = _drop_rates(self.members)

    def manifest(self) -> dict[str, Any]:
        return {
            "config": to_json(self.config),
            "given": self.given,
            "spaces": list(self.spaces),
            "members": [member.name for member in self.members],
            "versions": rundir.versions(),
        }


def start(given: Mapping[str, Any], display: Display) -> Run:
    """A new run: everything is checked before anything is created.

    Raises:
      BadInput: the settings, the environment or the place of the run are not usable.
    """
    given = dict(given)
    config = resolve(given)
    found = probe(config.env, json.loads(config.env_kwargs))
    config = settle(config, found.spaces)
    _check_read_after_settling(config, given)
    _drop_rates(members(config, given))
    TensorBoard.check(config)
    _check_plugins(config, found.spaces)
    path = Path(config.out) if config.out else rundir.default_path(config.env, config.arm)
    config = dataclasses.replace(config, out=str(path))
    rundir.create(path)
    run = Run(path, given, config, found, rundir.lock(path))
    rundir.write_json(
        path / "config.json",
        {
            "given": given,
            "config": to_json(config),
            "spaces": list(found.spaces),
            "exact_resume": found.differs is None,
            "versions": rundir.versions(),
            "git": rundir.git_revision(),
            "machine": rundir.machine(),
        },
    )
    if found.differs:
        display.say(
            f"warning: {config.env} does not repeat itself ({found.differs}): this run can be "
            f"continued, but not resumed exactly"
        )
    return run


def _check_read_after_settling(config: Config, given: Mapping[str, Any]) -> None:
    """What the observations decided (images take no MLP, no moments) may leave a value unread."""
    names = ("hidden", "activation", "clip_observations")
    check_read([config], {name: given[name] for name in names if name in given})


def _check_plugins(config: Config, spaces: Spaces) -> None:
    """Builds the program here where the user brought parts of it: a mistake is bad input then."""
    if any(":" in name for name in (config.network, config.filter, config.vex_target)):
        from sauna.core.population import make_program

        make_program(config, spaces)


def settle(config: Config, spaces: Spaces) -> Config:
    """Replaces what depends on the environment or the machine by what it comes to.

    Raises:
      BadInput: the network does not fit the observations.
    """
    image = spaces.observation_kind == "image"
    network = config.network
    if network == "auto":
        network = "nature-cnn" if image else "mlp"
    if (network == "nature-cnn") != image and ":" not in network:
        raise BadInput(
            f"network: {network} does not fit {spaces.observation_kind} observations of shape "
            f"{spaces.observation_shape}"
        )
    number = len(config.arm) * len(config.seeds)
    processes = config.processes or os.cpu_count() or 1
    return dataclasses.replace(
        config,
        network=network,
        normalize_observations=config.normalize_observations
        and spaces.observation_kind == "vector",
        processes=min(processes, number),
    )


def reopen(path: Path, changes: Mapping[str, Any], display: Display) -> Run:
    """An existing run, to be continued.

    Raises:
      BadInput: it is not a run, is in use, or `changes` would change what is computed.
    """
    stored = rundir.read_config(path)
    for name in changes:
        if name not in RESUMABLE:
            raise BadInput(f"{name}: cannot be changed on resume (can: {', '.join(RESUMABLE)})")
    given = {**stored.get("given", {}), **changes}
    resolved = resolve(given)
    config = stored_config(stored.get("config", {}))
    config = dataclasses.replace(config, **{name: getattr(resolved, name) for name in changes})
    found = probe(config.env, json.loads(config.env_kwargs))
    config = settle(config, found.spaces)
    if stored["spaces"] != json.loads(json.dumps(found.spaces)):
        raise BadInput(f"{config.env} has other spaces than when the run started: "
                       f"{found.spaces} instead of {stored['spaces']}")  # fmt: skip
    return Run(path, dict(given), config, found, rundir.lock(path))


def _drop_rates(everyone: list[Member]) -> list[list[float]]:
    """Per member, the drop rate of every iteration of the run it is to repeat."""
    source = everyone[0].config.drop_rate_from
    if not source:
        return []
    rates: dict[int, list[float]] = {}
    rundir.read_config(Path(source))
    for row in rundir.rows(Path(source)):
        rates.setdefault(row["seed"], []).append(1.0 - row["keep_rate"])
    for member in everyone:
        if member.seed not in rates:
            raise BadInput(f"drop_rate_from: {source} has no rows of seed {member.seed}")
    return [rates[member.seed] for member in everyone]


def train(run: Run, display: Display, *, resume: bool, inexact: bool = False) -> None:
    """Trains a run to its end; returns when everything is written.

    Raises:
      Interrupted: a signal came; the state is saved.
      SaunaError: something failed; the last good checkpoint is on disk.
    """
    loaded = None
    if resume:
        if rundir.is_complete(run.path):
            display.say(f"{run.path} is complete; nothing to do")
            return
        loaded = checkpoint.load_newest(run.path / "checkpoints", display.say)
        _check_same(run, loaded)
        rundir.cut_logs(run.path, loaded.manifest["logs"] if loaded else {})
    with Coordinator(run, display, loaded, inexact) as coordinator:
        coordinator.run()


def _check_same(run: Run, loaded: checkpoint.Checkpoint | None) -> None:
    """Refuses a checkpoint that another config or environment wrote.

    Raises:
      BadInput: with the first field that differs.
    """
    if loaded is None:
        return
    own = run.manifest()
    for name, value in own["config"].items():
        stored = loaded.manifest["config"].get(name)
        if name not in (*RESUMABLE, "out") and stored != value:
            raise BadInput(f"{loaded.path} is of another run: {name} is {stored!r}, not {value!r}")
    for name in ("spaces", "members"):
        if loaded.manifest[name] != json.loads(json.dumps(own[name])):
            raise BadInput(f"{loaded.path} is of another environment or run: {name} differ")
