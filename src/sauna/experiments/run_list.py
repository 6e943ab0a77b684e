"""`sauna runs`: the runs in a folder, how far each is and how it went. Nothing of them is executed.

What somebody else's files say is read as text and numbers; a run that cannot be read is named.
"""

from __future__ import annotations

import fcntl
import math
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sauna.config.plugins import label_of
from sauna.experiments.report.numbers import aligned, digits_of, number
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError, printable
from sauna.system.logs import read_row
from sauna.system.safe_read import Untrusted, open_file

DEPTH = 6  # folders below the one that is searched
TAIL = 2**24  # bytes of metrics.jsonl that are read at most, from its end
WIDTH = 60  # letters of a text that a file gives
HEAD = ("run", "env", "arms", "seeds", "steps", "state", "return", "age")


class Listed(NamedTuple):
    """One run.

    Attributes:
      state: finished, running, failed, interrupted, or why it cannot be read.
      done: mean over members of what they used of their budget.
      returns: of each arm, the mean of its members' last `return_mean`.
      changed: when it was last written to, in seconds since 1970.
    """

    path: Path
    state: str
    env: str = ""
    arms: tuple[str, ...] = ()
    seeds: int = 0
    done: float = 0.0
    steps: int = 0
    returns: dict[str, float] = {}  # noqa: RUF012 - never changed
    changed: float = 0.0


def list_runs(folder: Path) -> list[str]:
    """The table of the runs in a folder, the latest first, as lines.

    Raises:
      BadInput: there is no such folder.
    """
    if not folder.is_dir():
        raise BadInput(f"runs: there is no folder {folder}")
    runs = sorted(map(examine, find_runs(folder)), key=lambda run: -run.changed)
    if not runs:
        return [f"no runs in {folder}"]
    now = time.time()
    return aligned([HEAD, *(_cells(run, folder, now) for run in runs)])


def find_runs(folder: Path) -> Iterator[Path]:
    """The run directories in `folder`, `DEPTH` folders deep at most; no link is followed."""
    for place, folders, files in os.walk(folder):
        path = Path(place)
        if "config.json" in files:
            yield path
        if "config.json" in files or len(path.relative_to(folder).parts) >= DEPTH:
            folders.clear()
        folders[:] = sorted(name for name in folders if not name.startswith("."))


def examine(run: Path) -> Listed:
    """What the files of a run say of it."""
    changed = max(_time_of(run / name) for name in ("config.json", "metrics.jsonl", "failure.txt"))
    try:
        stored = run_directory.read_config(run, needed=("config",))
        config, own = stored["config"], stored.get("arms", {})
        labels = {
            arm: label_of(arm, {**config, **own.get(arm, {})}) for arm in map(str, config["arm"])
        }
        seeds = len(config["seeds"])
        budget = f"{config.get('budget', 'env')}_steps"
        last = last_rows(run / "metrics.jsonl", len(labels) * seeds)
        used = [row.get(budget, 0) for row in last.values()]
        return Listed(
            run,
            _state(run),
            str(config["env"]),
            tuple(labels.values()),
            seeds,
            sum(used) / (len(labels) * seeds),
            int(config["steps"]),
            _returns(labels, last),
            changed,
        )
    except (SaunaError, OSError) as error:
        return Listed(run, f"cannot be read: {error}", changed=changed)
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return Listed(run, "cannot be read: config.json is not one of a run", changed=changed)


def last_rows(path: Path, members: int) -> dict[str, dict[str, Any]]:
    """The last row of each member; read from the end, until all members were seen."""
    found: dict[str, dict[str, Any]] = {}
    if not os.path.lexists(path):
        return found
    with open_file(path) as file:
        size = file.seek(0, os.SEEK_END)
        length = min(size, 2**16)
        while True:
            file.seek(size - length)
            lines = file.read(length).splitlines(keepends=True)
            found = _latest(lines if length == size else lines[1:])
            if len(found) >= members or length in (size, TAIL):
                return found
            length = min(4 * length, size, TAIL)


def _latest(lines: list[bytes]) -> dict[str, dict[str, Any]]:
    found = {}
    for line in lines:
        try:
            if line.endswith(b"\n"):
                row = read_row(line, "metrics.jsonl")
                found[row["member"]] = row
        except (ValueError, RecursionError):
            continue  # `sauna resume` names it
    return found


def _returns(labels: Mapping[str, str], last: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    found = {}
    for names in labels.items():  # rows of before hold the arm
        rows = [row for row in last.values() if row["arm"] in names and "return_mean" in row]
        if rows:
            found[names[1]] = math.fsum(row["return_mean"] for row in rows) / len(rows)
    return found


def _state(run: Path) -> str:
    if run_directory.is_complete(run):
        return _finished(run)
    if _is_locked(run / ".lock"):
        return "running"
    failed = _time_of(run / "failure.txt")
    return "failed" if failed and failed >= _time_of(run / "metrics.jsonl") else "interrupted"


def _finished(run: Path) -> str:
    """`finished`, and how many members did not use their budget because they were stopped."""
    members = run_directory.read_config_file(run / "summary.json").get("members")
    rows = members.values() if isinstance(members, dict) else ()
    stopped = sum(isinstance(row, dict) and bool(row.get("stopped_early")) for row in rows)
    return f"finished ({stopped} stopped early)" if stopped else "finished"


def _is_locked(path: Path) -> bool:
    """Whether a process holds a run.

    Trying the lock would refuse a training that begins at this very moment; so it is tried only
    if the process that the file names is alive.
    """
    try:
        with open_file(path) as file:
            if not _is_alive(file.read(20).strip()):
                return False
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (Untrusted, OSError):
        return False
    return False


def _is_alive(text: bytes) -> bool:
    if not text.isdigit():
        return False
    try:
        os.kill(int(text), 0)
    except PermissionError:  # of another user
        return True
    except (OSError, OverflowError):
        return False
    return True


def _time_of(path: Path) -> float:
    try:
        return os.lstat(path).st_mtime
    except OSError:
        return 0.0


def _cells(run: Listed, folder: Path, now: float) -> list[str]:
    name = _shown(str(run.path.relative_to(folder)) if run.path != folder else run.path.name)
    ago = age(now - run.changed)
    if not run.arms:
        return [name, "", "", "", "", _shown(run.state), "", ago]
    returns = [
        f"{arm} {text}" if len(run.arms) > 1 else text
        for arm, value in run.returns.items()
        for text in [number(value, digits_of([value]))]
    ]
    steps = f"{run.done:,.0f} of {run.steps:,}"
    cells = [run.env, ", ".join(run.arms), str(run.seeds), steps, run.state, ", ".join(returns)]
    return [name, *map(_shown, cells), ago]


def _shown(text: str) -> str:
    text = printable(text)
    return text if len(text) <= WIDTH else f"{text[: WIDTH - 3]}..."


def age(seconds: float) -> str:
    """Writes how long ago something was: `40 s`, `12 min`, `5 h`, `3 d`."""
    for size, unit in ((86_400, "d"), (3_600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds // size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
