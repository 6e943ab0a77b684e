"""A run on disk: checked before anything is created, reopened only as what it was.

Nothing here imports JAX (unless the user brings plug-ins of their own): bad input is answered at
once, and the training itself happens in the workers that `coordinator.py` starts.
"""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from sauna.config.checks import budget_note, cautions, check_consistent, local_parts
from sauna.config.code import changed_code, code_of
from sauna.config.imported_from import KEY, folders_of, names_the_folder
from sauna.config.own_sources import newer_sources
from sauna.config.parsing import many_seeds
from sauna.config.presets import Member, RunConfig, parse_all, plain, resolve_run
from sauna.config.settings import Config, fields_with
from sauna.config.stored import read_stored, to_stored
from sauna.config.trust import check_trusted, seal
from sauna.envs.probe import Probe
from sauna.envs.spaces import Spaces, difference, read_spaces
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.system.jax_setup import configure_jax
from sauna.system.working_folder import kept_folder
from sauna.training.display import Display
from sauna.training.extension import (
    check_extension,
    check_restart,
    describe_extension,
    extended,
    extension,
    goes_further,
)
from sauna.training.initial import read_initial, save_initial
from sauna.training.loop.multihost import Follower, join, read_host_rank
from sauna.training.prepare import (
    Prepared,
    check_own_parts,
    check_writes,
    examine,
    place,
)
from sauna.training.tracking.trackers import check_trackers


class Run:
    """One run on disk, ready to be trained further.

    Attributes:
      path: its directory, which this process has locked until `lock` is closed.
      prepared: its settings and what is known of its environment.
      made: whether the directory was made by this object's maker.
    """

    def __init__(self, path: Path, prepared: Prepared, made: bool = False) -> None:
        self.path, self.prepared, self.made = path, prepared, made
        self.code = code_of(to_stored(prepared.run))
        self.extended: list[dict[str, Any]] = []  # what an earlier end of the run was
        self.lock: IO[str] = run_directory.lock(path)

    @property
    def config(self) -> Config:
        """What all members share."""
        return self.prepared.config

    @property
    def members(self) -> list[Member]:
        """What is trained, arm by arm and seed by seed."""
        return self.prepared.members

    @property
    def spaces(self) -> Spaces:
        """Of the environment."""
        return self.prepared.spaces

    @property
    def differs(self) -> str | None:
        """How two equal episodes differed; None if the environment repeats itself."""
        return self.prepared.differs

    def manifest(self) -> dict[str, Any]:
        """Says what a checkpoint of this run is of."""
        return {
            **to_stored(self.prepared.run),
            "spaces": list(self.spaces),
            "members": [member.name for member in self.members],
            "versions": run_directory.versions(),
            "code": self.code,
        }


def start(
    overrides: Mapping[str, Any],
    display: Display,
    found: Probe | None = None,
    trust: bool = False,
) -> Run:
    """Starts a new run: everything is checked before anything is created.

    Args:
      overrides: the settings that a user gives.
      display: prints the lines.
      found: what is known of the environment already.
      trust: the code that the run of `init_from` names may be another user's.

    Raises:
      BadInput: the settings, the environment or the place of the run are not usable.
    """
    with kept_folder():  # an environment may go elsewhere
        overrides = plain(overrides)
        placed = place(resolve_run(overrides))
        check_writes(placed.config)
        prepared = examine(placed, overrides, found)
        check_trackers(prepared.config)
        check_own_parts(prepared)
        initial = read_initial(prepared, display.say, trust)
    return create(prepared, display, initial)


def create(
    prepared: Prepared, display: Display, initial: tuple[Any, dict[str, Any]] | None = None
) -> Run:
    """Makes the directory of a run that is checked, and writes its `config.json`.

    Args:
      prepared: the run; its `out` names the directory.
      display: shows the messages.
      initial: what it starts from, of `read_initial`.

    Raises:
      BadInput: the directory holds something already, or cannot be made.
    """
    path, made = _make_directory(prepared.run)
    prepared = prepared._replace(run=prepared.run.replace(out=str(path)))
    path = Path.cwd() / path
    stored = {
        **to_stored(prepared.run),
        "spaces": list(prepared.spaces),
        "exact_resume": prepared.differs is None,
        "versions": run_directory.versions(),
        "git": run_directory.git_revision(),
        "machine": run_directory.machine(),
        **({"initial": initial[1]} if initial else {}),
    }
    if folders := folders_of(stored):
        stored[KEY] = folders
    stored["seal"] = seal(stored)
    with disk_errors(path):
        run = Run(path, prepared, made)
        try:
            run_directory.create(path)  # again, now that it is ours: another may have been faster
            if initial:
                save_initial(path, initial[0], run.manifest())
            run_directory.write_config(path, {**stored, "code": run.code})
        except BaseException:
            run.lock.close()
            raise
    _show_notes(prepared, display)
    return run


def _make_directory(run: RunConfig) -> tuple[Path, bool]:
    """Makes the run's directory; returns it and whether it is new.

    Raises:
      BadInput: it holds something already, or cannot be made.
    """
    config = run.config
    if not config.out:
        labels = tuple(run.labels.values())
        return run_directory.create_default(config.env, labels, config.seeds), True
    path = Path(config.out)
    made = not path.exists()
    with disk_errors(path):
        run_directory.create(path)
    return path, made


def _show_notes(prepared: Prepared, display: Display) -> None:
    """Says what a user may not expect of this run."""
    config = prepared.config
    if note := many_seeds(config.seeds):
        display.say(note)
    short = [note for own in prepared.run.arms.values() if (note := budget_note(own))]
    for caution in dict.fromkeys([*cautions(config), *short]):
        display.say(caution)
    if prepared.differs:
        display.say(
            f"warning: {config.env} does not repeat itself ({prepared.differs}): this run can be "
            f"continued, but not resumed exactly"
        )
    if local_parts(config):
        display.say(
            f"note: {', '.join(local_parts(config))} cannot be imported by name: this run trains "
            f"in this process, and can be resumed only from Python, passing the same again"
        )


def follows(overrides: Mapping[str, Any]) -> bool:
    """Returns whether another machine writes this run.

    Raises:
      BadInput: `distributed` cannot be read.
    """
    return read_host_rank(str(overrides.get("distributed", ""))).rank > 0


def follow(overrides: Mapping[str, Any], display: Display) -> None:
    """Trains together with the machine that writes the run, until that has finished.

    Raises:
      BadInput: as `start`.
    """
    overrides = plain(overrides)
    placed = place(resolve_run(overrides))
    config = placed.config
    configure_jax(config.devices if config.device == "cpu" else 0, config.device)
    join(read_host_rank(config.distributed))  # before an environment makes its first array
    prepared = examine(placed, overrides)
    from sauna.training.worker import train_members

    train_members(prepared.job(), Follower(display.say))


@names_the_folder
@kept_folder()
def reopen(
    path: str | Path,
    changes: Mapping[str, Any],
    display: Display,
    trust: bool = False,
    accept_changed_code: bool = False,
    restart_schedule: bool = False,
    inexact: bool = False,
    callback: Any = None,
) -> Run:
    """Opens an existing run, to be continued; from then on it counts as this user's.

    Args:
      changes: of fields that `resume` may change; what extends the run is stored.
      trust: the code that it names may run, even if another user named it.
      accept_changed_code: go on with that code even if it is not what it was.
      restart_schedule: schedules begin anew, over the steps that are added.
      inexact, callback: what `train_run` will be called with; they are only checked here.

    Raises:
      BadInput: it is not a run, is in use, names code of somebody else's, or `changes` would change
        what is computed.
    """
    path = Path.cwd() / path  # an environment may go elsewhere
    stored = run_directory.read_config(path)
    check_trusted(stored, str(path), stored.get("seal"), trust)
    resumable = (*fields_with("resumable"), *fields_with("extends_run"))
    for name in changes:
        if name not in resumable:
            raise BadInput(f"{name}: cannot be changed on resume (can: {', '.join(resumable)})")
    before = read_stored(stored)
    _check_source(path, stored)
    parsed = parse_all(changes)
    if restart_schedule:
        parsed["schedule_start"] = check_restart(path, before.config, parsed)
    changed = before.replace(**parsed)
    check_extension(before.config, changed.config)
    check_consistent(changed.config)
    check_trackers(changed.config)
    changed = place(changed)
    check_writes(changed.config)
    if (changed.config.backend == "device") != (before.config.backend == "device"):
        raise BadInput("backend: a run on the device stays there, and one on the host there")
    check_call(changed.config, inexact, callback)
    prepared = examine(changed, parsed)
    _check_spaces(prepared, path, stored["spaces"])
    with disk_errors(path):
        run = Run(path, prepared)
    differs = changed_code(stored.get("code", run.code), run.code)
    if differs and not accept_changed_code:
        run.lock.close()
        raise BadInput(
            f"{path} was trained with other code: {differs}; --accept-changed-code (in Python "
            f"accept_changed_code=True) goes on with today's"
        )
    if text := newer_sources(stored.get("code", {}), run.code):
        display.say(f"warning: {path} was trained with {text}: the rest may differ")
    after = extension(before, changed)
    with disk_errors(path):
        if goes_further(before.config, after.config):
            run_directory.reopen_summary(path)
        if after != before:
            stored = {**stored, **to_stored(after), "extended": extended(stored, before)}
        if trust or differs or after != before:
            stored = run_directory.with_code(stored, run.code) if differs else stored
            run_directory.write_config(path, {**stored, "seal": seal(stored)})
    run.extended = stored.get("extended", [])
    if text := describe_extension(before.config, after.config):
        display.say(text)
    return run


def check_call(config: Config, inexact: bool, callback: Any) -> None:
    """Checks what a training or a resume is called with, beside its settings.

    Raises:
      BadInput: the callback cannot be called here, or `inexact` means nothing.
    """
    if inexact and config.backend == "device":
        raise BadInput("inexact: a run on the device brings its environments back exactly")
    _check_callback(callback)
    if callback is not None and config.distributed:
        raise BadInput("callback: not called with distributed")


def _check_callback(callback: Any) -> None:
    """Refuses what cannot be called with a row.

    Raises:
      BadInput: saying what it must be.
    """
    if callback is None:
        return
    if not callable(callback):
        raise BadInput(f"callback: must be a function of a row, not {type(callback).__name__}")
    try:
        inspect.signature(callback).bind({})
    except TypeError as error:
        raise BadInput(f"callback: cannot be called with a row: {error}") from None
    except ValueError:  # a function of C, which does not say what it takes
        pass


def _check_source(path: Path, stored: Mapping[str, Any]) -> None:
    """Refuses a run of 0.1.0 that takes its drop rates from another run.

    Raises:
      BadInput: it is one.
    """
    if stored["config"].get("drop_rate_from") or stored.get("drop_rates"):
        raise BadInput(
            f"drop_rate_from: {path} repeats the drop rates of another run, which only 0.1.0 can "
            f"continue; train arm sauna+random instead, whose control needs no other run"
        )


def _check_spaces(prepared: Prepared, path: Path, stored: list[Any]) -> None:
    """Refuses an environment whose spaces a learner sees as other than the stored ones.

    Raises:
      BadInput: naming the part that differs.
    """
    try:
        differs = difference(prepared.spaces, read_spaces(stored))
    except (TypeError, ValueError) as error:
        raise BadInput(f"config: {path}: its spaces cannot be read: {error}") from error
    if differs:
        env = prepared.config.env
        raise BadInput(f"{env} has other spaces than when the run started: {differs}")


def resume_command(path: Path) -> str:
    """Spells the command that continues a run, for a shell."""
    return f"sauna resume {shlex.quote(str(path))}"


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turns what the system says of a file into one line, with what to do next."""
    try:
        yield
    except BrokenPipeError:  # of our own output: nobody reads it any more
        raise
    except OSError as error:
        again = f"; the last good checkpoint is kept, continue with: {resume_command(path)}"
        hint = again if (path / "config.json").exists() else ""
        where = error.filename or path
        raise SaunaError(f"cannot read or write {where}: {error.strerror}{hint}") from error
