"""A run on disk: checked before anything is created, reopened only as what it was.

Nothing here imports JAX (unless the user brings plug-ins of their own): bad input is answered at
once, and the training itself happens in the workers that `coordinator.py` starts.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from sauna.config.presets import (
    ARMS,
    RESUMABLE,
    Member,
    as_began,
    members,
    parse_all,
    plain,
    resolve,
    stored_config,
)
from sauna.config.settings import ON_DEVICE, Config, check_read, local_parts, to_json
from sauna.coordinator import Coordinator
from sauna.envs.probe import Probe
from sauna.envs.spaces import Spaces
from sauna.machines import Follower, check_shared, join, read_place
from sauna.metrics.display import Display
from sauna.metrics.tensorboard import TensorBoard
from sauna.placement import look_at, placed
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.system.jax_setup import configure_jax
from sauna.system.safe_read import JSON_BYTES


class Run:
    """One run on disk, ready to be trained further."""

    def __init__(
        self,
        path: Path,
        given: dict[str, Any],
        config: Config,
        found: Probe,
        drop_rates: list[list[float]],
        made: bool = False,
    ) -> None:
        self.path, self.given, self.config = path, given, config
        self.made = made  # the directory, by us
        self.spaces, self.differs = found
        self.members: list[Member] = members(config, given)
        self.drop_rates = drop_rates
        self.held: IO[str] = run_directory.lock(path)

    def manifest(self) -> dict[str, Any]:
        return {
            "config": to_json(self.config),
            "given": self.given,
            "spaces": list(self.spaces),
            "members": [member.name for member in self.members],
            "versions": run_directory.versions(),
        }


def start(given: Mapping[str, Any], display: Display) -> Run:
    """A new run: everything is checked before anything is created.

    Raises:
      BadInput: the settings, the environment or the place of the run are not usable.
    """
    given = plain(given)
    config = placed(resolve(given))
    _check_writes(config)
    config, found = _looked_at(config, given)
    drop_rates = _drop_rates(members(config, given))
    TensorBoard.check(config)
    _check_plugins(config, found.spaces)
    path = Path(config.out) if config.out else run_directory.default_path(config.env, config.arm)
    config = dataclasses.replace(config, out=str(path))
    stored = {
        "given": given,
        "config": to_json(config),
        "spaces": list(found.spaces),
        "drop_rates": drop_rates,
        "exact_resume": found.differs is None,
        "versions": run_directory.versions(),
        "git": run_directory.git_revision(),
        "machine": run_directory.machine(),
    }
    made = not path.exists()
    with _disk_errors(path):
        run_directory.create(path)
        run = Run(path, given, config, found, drop_rates, made)
        try:
            run_directory.create(path)  # again, now that it is ours: another may have been faster
            run_directory.write_json(path / "config.json", stored)
        except BaseException:
            run.held.close()
            raise
    if found.differs:
        display.say(
            f"warning: {config.env} does not repeat itself ({found.differs}): this run can be "
            f"continued, but not resumed exactly"
        )
    if local_parts(config):
        display.say(
            f"note: {', '.join(local_parts(config))} cannot be imported by name: this run trains "
            f"in this process, and can be resumed only from Python, passing the same again"
        )
    return run


def _looked_at(config: Config, given: Mapping[str, Any]) -> tuple[Config, Probe]:
    """The config with what depends on the environment; and what was found there.

    Raises:
      BadInput: the environment cannot be used, or leaves a given field unread.
    """
    found = look_at(config)
    config = settle(config, found.spaces)
    check_read_after_settling(found.spaces, config, given)
    return config, found


def _check_writes(config: Config) -> None:
    """Refuses to write the run of another machine.

    Raises:
      BadInput: this is not machine 0.
    """
    if read_place(config.distributed).number:
        raise BadInput("distributed: machine 0 writes the run; the others follow it with "
                       "`sauna train`, on the command line")  # fmt: skip


def follows(given: Mapping[str, Any]) -> bool:
    """Whether another machine writes this run.

    Raises:
      BadInput: `distributed` cannot be read.
    """
    return read_place(str(given.get("distributed", ""))).number > 0


def follow(given: Mapping[str, Any], display: Display) -> None:
    """Trains together with the machine that writes the run, until that has finished.

    Raises:
      BadInput: as `start`.
    """
    given = plain(given)
    config = placed(resolve(given))
    configure_jax(config.devices if config.device == "cpu" else 0, config.device)
    join(read_place(config.distributed))  # before an environment makes its first array
    config, found = _looked_at(config, given)
    everyone = members(config, given)
    from sauna.training import Job, train_members

    kwargs = json.loads(config.env_kwargs)
    job = Job(config, found.spaces, kwargs, everyone, _drop_rates(everyone), None, 0, True)
    train_members(job, Follower(display.say))


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """What the system says of a file becomes one line, with what to do next."""
    try:
        yield
    except BrokenPipeError:  # of our own output: nobody reads it any more
        raise
    except OSError as error:
        again = "; the last good checkpoint is kept, continue with: sauna resume "
        hint = f"{again}{path}" if (path / "config.json").exists() else ""
        place = error.filename or path
        raise SaunaError(f"cannot read or write {place}: {error.strerror}{hint}") from error


def check_read_after_settling(spaces: Spaces, config: Config, given: Mapping[str, Any]) -> None:
    """Refuses what the environment's spaces leave unread.

    Raises:
      BadInput: naming the field.
    """
    _check_placement(config, given)
    names = ("hidden", "activation", "clip_observations")
    check_read([config], {name: given[name] for name in names if name in given})
    if "log_std_init" in given and spaces.action_kind != "continuous":
        raise BadInput(f"log_std_init: not read with {spaces.action_kind} actions")
    wanted = "normalize_observations" in given and resolve(given).normalize_observations
    if wanted and not config.normalize_observations:
        raise BadInput(f"normalize_observations: {spaces.observation_kind} observations have "
                           f"no running moments")  # fmt: skip


def _check_placement(config: Config, given: Mapping[str, Any]) -> None:
    """Refuses what the place of the environments leaves unread.

    Raises:
      BadInput: naming the field.
    """
    for name in given:
        if name in ON_DEVICE and config.backend != "device":
            raise BadInput(f"{name}: only read with backend device")
    asked = parse_all(given).get("processes", 0)
    if _together(config) and asked > 1:
        raise BadInput(f"processes: {asked} asked for, but all members and devices are one program")


def _together(config: Config) -> bool:
    """Whether one program trains all members, on a GPU or on several devices."""
    several = config.device == "gpu" or config.devices > 1 or bool(config.distributed)
    return config.backend == "device" and several


def _check_plugins(config: Config, spaces: Spaces) -> None:
    """Looks at what of a run is the user's own: a mistake there is bad input.

    Raises:
      BadInput: a part cannot be used.
    """
    if any(":" in name for name in (config.network, config.filter, config.vex_target)):
        configure_jax()
        from sauna.plugins import check_plugins

        check_plugins(config, spaces)


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
    if config.backend == "device" and config.devices > 1:
        check_shared("devices", number, config.envs, config.devices)
    if _together(config):
        processes = 1
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
    stored = run_directory.read_config(path)
    for name in changes:
        if name not in RESUMABLE:
            raise BadInput(f"{name}: cannot be changed on resume (can: {', '.join(RESUMABLE)})")
    given = {**stored.get("given", {}), **changes}
    resolved = resolve(given)
    config = stored_config(stored.get("config", {}))
    config = dataclasses.replace(config, **{name: getattr(resolved, name) for name in changes})
    TensorBoard.check(config)
    config = placed(config)
    _check_writes(config)
    if (config.backend == "device") != (stored["config"].get("backend") == "device"):
        raise BadInput("backend: a run on the device stays there, and one on the host there")
    _check_placement(config, changes)
    found = look_at(config)
    config = settle(config, found.spaces)
    if stored["spaces"] != json.loads(json.dumps(found.spaces)):
        raise BadInput(f"{config.env} has other spaces than when the run started: "
                       f"{found.spaces} instead of {stored['spaces']}")  # fmt: skip
    before = stored.get("given", {})
    began = as_began(stored["config"], before)
    kept = [f"{name} {value}" for name, value in began.items() if before.get(name) != value]
    if kept:
        display.say(f"note: this version has other values; kept from the start: {', '.join(kept)}")
    with _disk_errors(path):
        return Run(path, {**began, **changes}, config, found, stored["drop_rates"])


def _drop_rates(everyone: list[Member]) -> list[list[float]]:
    """Per member, the drop rate that the run it repeats had in every iteration.

    Raises:
      BadInput: that run is not complete, lacks a seed, is not of exactly one filtered arm, or has
        more rates than `config.json` can hold.
    """
    source = everyone[0].config.drop_rate_from
    if not source:
        return []
    arms = run_directory.read_config(Path(source))["config"]["arm"]
    filtered = [arm for arm in arms if ARMS[arm]["filter"] != "none"]
    if len(filtered) != 1:
        raise BadInput(f"drop_rate_from: {source} has {len(filtered)} filtered arms; it needs one")
    if not run_directory.is_complete(Path(source)):
        raise BadInput(f"drop_rate_from: {source} is not complete")
    rates: dict[int, list[float]] = {}
    for row in run_directory.rows(Path(source)):
        if row["arm"] == filtered[0]:
            rates.setdefault(row["seed"], []).append(1.0 - row["keep_rate"])
    for member in everyone:
        if member.seed not in rates:
            raise BadInput(f"drop_rate_from: {source} has no rows of seed {member.seed}")
    found = [rates[member.seed] for member in everyone]
    if len(json.dumps(found)) > JSON_BYTES // 2:  # what cannot be read again is not begun
        raise BadInput(f"drop_rate_from: {source} has {max(map(len, found))} iterations, too many "
                       f"to repeat for {len(found)} seeds in one run")  # fmt: skip
    return found


def train(run: Run, display: Display, *, resume: bool, inexact: bool = False) -> None:
    """Trains a run to its end; returns when everything is written.

    Raises:
      BadInput: a setting cannot be used after all, as a worker found; a new run is removed again.
      Interrupted: a signal came; the state is saved.
      SaunaError: something failed; the last good checkpoint is on disk.
    """
    try:
        if inexact and run.config.backend == "device":
            raise BadInput("inexact: a run on the device brings its environments back exactly")
        with _disk_errors(run.path):
            _train(run, display, resume, inexact)
    except BadInput:
        if not resume:  # what a worker found to be one before the first row: nothing is created
            run_directory.discard(run.path, run.made)
        raise
    finally:
        run.held.close()


def _train(run: Run, display: Display, resume: bool, inexact: bool) -> None:
    loaded = None
    if resume:
        if run_directory.is_complete(run.path):
            display.say(f"{run.path} is complete; nothing to do")
            return
        loaded = _load(run, display)
        run_directory.cut_logs(run.path, loaded.manifest["logs"] if loaded else {})
    with Coordinator(run, display, loaded, inexact) as coordinator:
        coordinator.run()


def _load(run: Run, display: Display) -> checkpoint.Checkpoint | None:
    """The newest checkpoint that is good, of this run, and whose rows are all there.

    Raises:
      BadInput: a checkpoint is of another run or environment; each field that differs is named.
      BadCheckpoint: there are checkpoints, but none can be used.
    """
    own = run.manifest()

    def check(manifest: dict[str, Any]) -> None:
        _check_same(run.path, own, manifest)
        run_directory.check_logs(run.path, manifest["logs"])

    loaded = checkpoint.load_newest(run.path / "checkpoints", display.say, check)
    before = loaded.manifest.get("versions", {}) if loaded else {}
    changed = [f"{name} {before[name]} -> {own['versions'].get(name)}" for name in before
               if before[name] != own["versions"].get(name)]  # fmt: skip
    if changed:
        display.say(f"warning: other versions than when the checkpoint was saved "
                    f"({', '.join(changed)}): the rest may differ in its last bits")  # fmt: skip
    return loaded


def _check_same(path: Path, own: dict[str, Any], manifest: dict[str, Any]) -> None:
    """Refuses a checkpoint that another config or environment wrote.

    Raises:
      BadInput: with every field that differs.
    """
    stored = {**to_json(Config()), **manifest["config"]}  # a field added since had its default
    differing = [
        f"{name} is {stored[name]!r}, not {value!r}"
        for name, value in own["config"].items()
        if name not in (*RESUMABLE, "out") and stored[name] != value
    ]
    for name in ("spaces", "members"):
        if manifest[name] != json.loads(json.dumps(own[name])):
            differing.append(f"{name} differ")
    if differing:
        raise BadInput(f"{path}: its checkpoint is of another run or environment: "
                       f"{'; '.join(differing)}")  # fmt: skip
