"""A run on disk: checked before anything is created, reopened only as what it was.

Nothing here imports JAX (unless the user brings plug-ins of their own): bad input is answered at
once, and the training itself happens in the workers that `coordinator.py` starts.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from sauna.config.code import changed_code, code_of
from sauna.config.presets import (
    RESUMABLE,
    Member,
    _check_arms,
    as_began,
    members,
    plain,
    resolve,
    stored_config,
)
from sauna.config.settings import Config, check_consistent, local_parts, to_json
from sauna.config.trust import check_trusted, seal
from sauna.envs.probe import Probe
from sauna.envs.spaces import difference, read_spaces
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.system.jax_setup import configure_jax
from sauna.system.working_folder import kept_folder
from sauna.training.display import Display
from sauna.training.loop.multihost import Follower, join, read_place
from sauna.training.prepare import (
    _check_placement,
    check_own_parts,
    check_writes,
    drop_rates_of,
    look_at,
    looked_at,
    placed,
    settle,
)
from sauna.training.tensorboard import TensorBoard


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
        self.code = code_of(to_json(config))
        self.held: IO[str] = run_directory.lock(path)

    def manifest(self) -> dict[str, Any]:
        return {
            "config": to_json(self.config),
            "given": self.given,
            "spaces": list(self.spaces),
            "members": [member.name for member in self.members],
            "versions": run_directory.versions(),
            "code": self.code,
        }


@kept_folder()
def start(given: Mapping[str, Any], display: Display) -> Run:
    """A new run: everything is checked before anything is created.

    Raises:
      BadInput: the settings, the environment or the place of the run are not usable.
    """
    here = Path.cwd()  # an environment may go elsewhere
    given = plain(given)
    config = placed(resolve(given))
    check_writes(config)
    config, found = looked_at(config, given)
    drop_rates = drop_rates_of(members(config, given))
    TensorBoard.check(config)
    check_own_parts(config, found.spaces)
    path = Path(config.out) if config.out else run_directory.default_path(config.env, config.arm)
    config, path = dataclasses.replace(config, out=str(path)), here / path
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
    stored["seal"] = seal(stored)
    made = not path.exists()
    with disk_errors(path):
        run_directory.create(path)
        run = Run(path, given, config, found, drop_rates, made)
        try:
            run_directory.create(path)  # again, now that it is ours: another may have been faster
            run_directory.write_config(path, {**stored, "code": run.code})
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
    config, found = looked_at(config, given)
    everyone = members(config, given)
    from sauna.training.loop.job import Job

    kwargs = json.loads(config.env_kwargs)
    job = Job(config, found.spaces, kwargs, everyone, drop_rates_of(everyone), None, 0, True)
    from sauna.training.worker import train_members

    train_members(job, Follower(display.say))


@kept_folder()
def reopen(
    path: Path,
    changes: Mapping[str, Any],
    display: Display,
    trust: bool = False,
    accept_changed_code: bool = False,
) -> Run:
    """An existing run, to be continued; from then on it counts as this user's.

    Args:
      trust: the code that it names may run, even if another user named it.
      accept_changed_code: go on with that code even if it is not what it was.

    Raises:
      BadInput: it is not a run, is in use, names code of somebody else's, or `changes` would change
        what is computed.
    """
    path = Path.cwd() / path  # an environment may go elsewhere
    stored = run_directory.read_config(path)
    check_trusted(stored, str(path), stored.get("seal"), trust)
    for name in changes:
        if name not in RESUMABLE:
            raise BadInput(f"{name}: cannot be changed on resume (can: {', '.join(RESUMABLE)})")
    given = {**stored.get("given", {}), **changes}
    resolved = resolve(given)
    config = stored_config(stored.get("config", {}))
    config = dataclasses.replace(config, **{name: getattr(resolved, name) for name in changes})
    _check_arms(config.arm, {})
    check_consistent(config)
    TensorBoard.check(config)
    config = placed(config)
    check_writes(config)
    if (config.backend == "device") != (stored["config"].get("backend") == "device"):
        raise BadInput("backend: a run on the device stays there, and one on the host there")
    _check_placement(config, changes)
    found = look_at(config)
    config = settle(config, found.spaces)
    try:
        differs = difference(found.spaces, read_spaces(stored["spaces"]))
    except (TypeError, ValueError) as error:
        raise BadInput(f"config: {path}: its spaces cannot be read: {error}") from error
    if differs:
        raise BadInput(f"{config.env} has other spaces than when the run started: {differs}")
    before = stored.get("given", {})
    began = as_began(stored["config"], before)
    kept = [f"{name} {value}" for name, value in began.items() if before.get(name) != value]
    if kept:
        display.say(f"note: this version has other values; kept from the start: {', '.join(kept)}")
    with disk_errors(path):
        run = Run(path, {**began, **changes}, config, found, stored.get("drop_rates", []))
    changed = changed_code(stored.get("code", run.code), run.code)
    if changed and not accept_changed_code:
        run.held.close()
        raise BadInput(
            f"{path} was trained with other code: {changed}; --accept-changed-code (in Python "
            f"accept_changed_code=True) goes on with today's"
        )
    with disk_errors(path):
        if trust or changed:
            stored = run_directory.with_code(stored, run.code) if changed else stored
            run_directory.write_config(path, {**stored, "seal": seal(stored)})
    return run


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
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
