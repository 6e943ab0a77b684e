"""The run directory: what is in it, who may write to it, and how its logs are cut back.

config.json     the settings and what each arm differs in, versions, git revision, machine
metrics.jsonl   one row per iteration and member; the same bytes for the same config and seeds
timing.jsonl    one row per iteration: seconds and steps/s (a clock's readings, so apart)
summary.json    how each member ended
checkpoints/    see checkpoint.py
figures/, videos/, tensorboard/
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
import subprocess
import time
from pathlib import Path
from typing import IO, Any

from sauna.system.checkpoint import BadCheckpoint, sync_folder, write_durably
from sauna.system.errors import BadInput, SaunaError
from sauna.system.safe_read import JSON_BYTES, Untrusted, parse_object, read_file

LOGS = ("metrics.jsonl", "timing.jsonl")
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


def create(path: Path, new: bool = False) -> None:
    """Makes an empty run directory.

    Raises:
      BadInput: it holds something already, or cannot be made.
      FileExistsError: with `new`, it is there.
    """
    if new and path.exists():
        raise FileExistsError(path)
    if path.exists() and (not path.is_dir() or any(map(_counts, path.iterdir()))):
        again = f"; `sauna resume {shlex.quote(str(path))}` continues it"
        hint = again if (path / "config.json").exists() else ""
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
    """Empties the directory of a run that has no row yet, and removes it where the run made it."""
    if any((path / name).exists() for name in LOGS):
        return
    with contextlib.suppress(OSError):  # what went wrong is told already, and matters more
        (path / "config.json").unlink(missing_ok=True)
        (path / ".lock").unlink(missing_ok=True)
        if made:
            path.rmdir()


def _counts(path: Path) -> bool:
    """Whether a file makes a folder a used one; what a kill cut short does not."""
    return path.name != ".lock" and not path.name.endswith(".writing")


class InUse(BadInput):
    """Another process holds a folder."""


def lock(path: Path) -> IO[str]:
    """Holds the run directory for this process until the returned file is closed or we die.

    Raises:
      InUse: another process holds it; its number is named.
    """
    file = (path / ".lock").open("a+")
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
    temporary = path.with_name(f".{path.name}.writing")
    write_durably(temporary, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())
    temporary.replace(path)
    sync_folder(path.parent)


def read_config(run: Path) -> dict[str, Any]:
    """`config.json` of a run.

    Raises:
      BadInput: there is no run, or its config cannot be read.
    """
    path = run / "config.json"
    if not path.is_file():
        raise BadInput(f"{run} is not a run directory (it has no config.json)")
    return read_config_file(path)


def read_config_file(path: Path) -> dict[str, Any]:
    """Reads a file as `config.json` is: `config` and `arms`, or plain settings.

    Raises:
      BadInput: the file cannot be read as that.
    """
    try:
        return parse_object(read_file(path.resolve(), JSON_BYTES))
    except Untrusted as error:
        raise BadInput(f"config: cannot read {path}: {error}") from error


def rows(run: Path, name: str = "metrics.jsonl") -> list[dict[str, Any]]:
    """All rows of a log; an unfinished last line (of a run in progress) is left out.

    So is everything behind a line that a power cut has spoilt: a resume cuts that off.

    Raises:
      SaunaError: a row of a complete run cannot be read; its line is named.
    """
    path = run / name
    found: list[dict[str, Any]] = []
    if not path.is_file():
        return found
    for number, line in enumerate(path.read_bytes().splitlines(True), 1):
        try:
            if line.endswith(b"\n"):
                found.append(json.loads(line))
        except ValueError as error:
            if is_complete(run):
                raise SaunaError(f"{path}: line {number} is damaged: {error}") from error
            break
    return found


def is_complete(run: Path) -> bool:
    """Whether the run was trained to its end."""
    path = run / "summary.json"
    return path.is_file() and bool(read_config_file(path).get("complete"))


def log_sizes(run: Path) -> dict[str, int]:
    """Bytes of each log, all of them flushed to disk: a checkpoint counts on them."""
    for name in LOGS:
        if (run / name).exists():
            descriptor = os.open(run / name, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)
    return {name: (run / name).stat().st_size for name in LOGS if (run / name).exists()}


def check_logs(run: Path, sizes: dict[str, int]) -> None:
    """Whether the logs still hold the rows that a checkpoint counts on.

    Raises:
      BadCheckpoint: a log is shorter than the checkpoint says; rows were lost.
    """
    for name in LOGS:
        path, size = run / name, sizes.get(name, 0)
        if (path.stat().st_size if path.exists() else 0) < size:
            raise BadCheckpoint(
                f"{path} is shorter than when the checkpoint was saved; rows are lost"
            )


def cut_logs(run: Path, sizes: dict[str, int]) -> None:
    """Brings the logs back to a checkpoint: rows behind it will be written again."""
    for name in LOGS:
        path = run / name
        if path.exists():
            os.truncate(path, sizes.get(name, 0))


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
        revision = _git("rev-parse", "HEAD")
        return revision + ("+changes" if _git("status", "--porcelain") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], capture_output=True, text=True, check=True, timeout=5
    )
    return done.stdout.strip()
