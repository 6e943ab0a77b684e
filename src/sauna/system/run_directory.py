"""The run directory: what is in it, who may write to it, and how its logs are cut back.

config.json     the settings and what each arm differs in, versions, git revision, machine
failure.txt     the traceback of what ended it last, if something did
metrics.jsonl   one row per iteration and member; the same bytes for the same config and seeds
timing.jsonl    one row per iteration: seconds and steps/s (a clock's readings, so apart)
metrics.csv     both as one table; see metrics_csv.py
summary.json    how each member ended
checkpoints/    see checkpoint.py
tracking.json   how each tracker finds its run again
init/           a checkpoint of what the run started from, with init_from
figures/, videos/, tensorboard/, wandb/
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import importlib.metadata
import itertools
import json
import os
import platform
import shlex
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from sauna.system import git
from sauna.system.errors import BadInput
from sauna.system.logs import NAMES as LOGS
from sauna.system.logs import read_rows
from sauna.system.safe_read import JSON_BYTES, Untrusted, parse_object, read_file
from sauna.system.safe_write import is_unfinished, open_grown, replace_file, sync_folder

# What a run's config.json holds that is read again, by its type.
_PARTS: dict[str, type] = {
    "config": dict,
    "given": dict,
    "spaces": list,
    "drop_rates": list,
    "code": dict,
    "code_before": list,
    "extended": list,
}
INITIAL = "init"  # the folder of what a run starts from
EXPORTED = "policy.json"  # of a folder that holds an exported policy in place of a run
_PACKAGES = ("sauna-rl", "jax", "jaxlib", "flax", "optax", "gymnasium", "mujoco", "numpy")


def create_default(env: str, arms: tuple[str, ...], seeds: tuple[int, ...]) -> Path:
    """Makes `runs/ENV_ARMS_SEEDS_TIME`; two runs never get the same one.

    A folder that is there already, say of a run that began in the same second, is left alone:
    the name then ends in `-2`, `-3` and so on.

    Raises:
      BadInput: it cannot be made.
    """
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{env}_{'+'.join(arms)}_{_seeds_name(seeds)}_{now}"
    stem = name.replace("/", "-").replace(":", "-")
    for number in itertools.count(1):
        path = Path("runs") / (stem if number == 1 else f"{stem}-{number}")
        try:
            create(path, new=True)
            return path
        except FileExistsError:
            continue
    raise AssertionError("unreachable")


def _seeds_name(seeds: tuple[int, ...]) -> str:
    if len(seeds) == 1:
        return f"seed{seeds[0]}"
    if seeds == tuple(range(seeds[0], seeds[-1] + 1)):
        return f"seeds{seeds[0]}-{seeds[-1]}"
    return f"{len(seeds)}seeds"


def run_below(folder: Path) -> str:
    """Where the runs of a unit, or of a comparison, are; empty if there are none."""
    if (folder / "run" / "config.json").is_file():
        return f"; did you mean {folder / 'run'}?"
    units = folder.parent / "units"
    return f"; its runs are {units}/*/run" if (folder / "results.json").is_file() else ""


def create(path: Path, new: bool = False) -> None:
    """Makes an empty run directory.

    Raises:
      BadInput: it holds something already, or cannot be made.
      FileExistsError: with `new`, it is there.
    """
    if new and path.exists():
        raise FileExistsError(path)
    if path.exists() and (not path.is_dir() or any(map(_counts, path.iterdir()))):
        resume, hint = f"sauna resume {shlex.quote(str(path))}", ""
        if (path / "config.json").exists():
            hint = f"; `{resume}` continues it"
            if is_complete(path):
                hint = f"; `{resume} --steps N` trains this finished run further"
        raise BadInput(f"out: {path} is not empty{hint}")
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=not new)
    except FileExistsError:
        if new and path.is_dir():
            raise
        raise BadInput(f"out: cannot make {path}: {path.parent} is no folder") from None
    except OSError as error:
        raise BadInput(f"out: cannot make {path}: {error.strerror}") from error
    for folder in made:
        try:
            sync_folder(folder.parent)
        except PermissionError:  # of a folder that may be entered, but not read
            continue


def discard(path: Path, made: bool) -> None:
    """Empties the directory of a run that has no row yet, and removes it where the run made it.

    All that it holds is the run's and its trackers', as it was empty when the run began.
    """
    if any((path / name).exists() for name in LOGS):
        return
    with contextlib.suppress(OSError):  # the first error is reported already, and matters more
        for child in path.iterdir():
            if child.is_dir() and not child.is_symlink():
                shutil.rmtree(child, ignore_errors=True)
            else:
                child.unlink(missing_ok=True)
        if made:
            path.rmdir()


def _counts(path: Path) -> bool:
    """Whether a file makes a folder a used one; what a kill cut short does not."""
    return path.name != ".lock" and not is_unfinished(path)


class InUse(BadInput):
    """Another process holds a folder."""


def lock(path: Path) -> IO[str]:
    """Holds the run directory for this process until the returned file is closed or we die.

    Raises:
      InUse: another process holds it; its number is named.
      Untrusted: the lock is a link, or no regular file.
    """
    file: IO[str] = open_grown(path / ".lock", "a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
    except BlockingIOError:
        holder = _holder(file)
        file.close()
        raise InUse(f"{path} is in use by process {holder}") from None
    except OSError:
        file.close()
        raise
    return file


def _holder(file: IO[str]) -> str:
    """The number that the holder writes into the lock right after it has it.

    Until then the file is empty or names the holder before, which may have been killed.
    """
    number = ""
    for _ in range(100):
        file.seek(0)
        number = file.read().strip()
        if number.isdigit() and Path(f"/proc/{number}").exists():
            break
        time.sleep(0.005)
    return number or "unknown"


def write_json(path: Path, value: Any) -> None:
    """Atomically: a reader sees the old file or the new one."""
    replace_file(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_config(
    run: Path, needed: tuple[str, ...] = ("config", "spaces"), exported: bool = False
) -> dict[str, Any]:
    """`config.json` of a run: what is `needed` is there, and what is there is of its type.

    Args:
      exported: a policy that was exported will do; then it is `policy.json`.

    Raises:
      BadInput: there is no run, or its config is not one.
    """
    path = run / (EXPORTED if exported and is_exported(run) else "config.json")
    if not os.path.lexists(path):
        if is_exported(run):
            raise BadInput(
                f"{run} is an exported policy, and no run: it can be played (sauna eval) and "
                f"trained further (--init-from)"
            )
        raise BadInput(f"{run} is not a run directory (it has no config.json){run_below(run)}")
    stored = _read(path)
    for name, kind in _PARTS.items():
        missing = None if name in needed else kind()
        if type(stored.get(name, missing)) is not kind:
            noun = "a table" if kind is dict else "a list"
            raise BadInput(f"config: {path}: {name} is missing or is not {noun}")
    return stored


def is_exported(folder: Path) -> bool:
    """Whether a folder holds an exported policy, and no run."""
    return os.path.lexists(folder / EXPORTED) and not os.path.lexists(folder / "config.json")


def write_config(run: Path, stored: Mapping[str, Any]) -> None:
    """Writes `config.json`, atomically."""
    write_json(run / "config.json", stored)


def with_code(stored: Mapping[str, Any], code: Mapping[str, str]) -> dict[str, Any]:
    """A stored config whose run goes on with other code; what it was before is kept."""
    before = [*stored.get("code_before", []), stored["code"]] if "code" in stored else []
    return {**stored, "code": dict(code), "code_before": before}


def read_config_file(path: Path) -> dict[str, Any]:
    """Reads a file as `config.json` is: `config` and `arms`, or plain settings.

    Raises:
      BadInput: the file cannot be read as that.
    """
    return _read(path, Path(os.path.realpath(path)))


def _read(path: Path, place: Path | None = None) -> dict[str, Any]:
    try:
        return parse_object(read_file(place or path, JSON_BYTES))
    except Untrusted as error:
        raise BadInput(f"config: cannot read {path}: {error}") from error


def rows(run: Path, name: str = "metrics.jsonl") -> list[dict[str, Any]]:
    """All rows of a log; see `logs.read_rows`.

    Raises:
      SaunaError: a row of a complete run cannot be read; its line is named.
    """
    return read_rows(run / name, is_complete(run))


def is_complete(run: Path) -> bool:
    """Whether the run was trained to its end."""
    path = run / "summary.json"
    return os.path.lexists(path) and bool(_read(path).get("complete"))


def reopen_summary(run: Path) -> None:
    """Notes that a run is not complete any more, as it is to go further."""
    path = run / "summary.json"
    if os.path.lexists(path):
        write_json(path, {**_read(path), "complete": False})


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, Any]:
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    return {"system": platform.platform(), "processor": model, "cores": os.cpu_count()}


def git_revision() -> str | None:
    """Of the working directory, with `+changes` where it is not clean; None outside of git."""
    try:
        revision = git.ask(".", "rev-parse", "HEAD")
        return revision + (git.EDITED if git.ask(".", "status", "--porcelain") else "")
    except git.FAILURES:
        return None
