"""A unit's files in two places: what changed where it is trained, and the same where it is kept.

Logs are sent from where they ended before; a checkpoint appears whole or not at all, and after the
logs that it counts on. So whatever has arrived can be continued, at any moment.
"""

from __future__ import annotations

import os
import shutil
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from sauna.system import metrics_csv, run_directory, safe_write

LOGS = ("stderr.txt", *(f"run/{name}" for name in run_directory.LOGS))
CHECKPOINTS = "run/checkpoints"
LAST = "run/summary.json"  # says that everything else is there
TABLE = f"run/{metrics_csv.NAME}"  # rewritten while it grows: sent when all is done


class Changes(NamedTuple):
    """What changed: logs as `(name, start, bytes)`, other files, and all checkpoints there are."""

    logs: list[tuple[str, int, bytes]]
    files: dict[str, bytes]
    checkpoints: list[str]


def names(place: Path) -> list[str]:
    """Returns the files of the unit in `place`, without those that are being written."""
    found = [place / "stderr.txt", *sorted((place / "run").rglob("*"))]
    relative = [path.relative_to(place) for path in found if path.is_file()]
    own = [str(r) for r in relative if not any(part.startswith(".") for part in r.parts)]
    return [name for name in own if name != TABLE or LAST in own]


def read(place: Path, chosen: list[str]) -> dict[str, bytes]:
    return {name: (place / name).read_bytes() for name in chosen}


def write(place: Path, files: dict[str, bytes]) -> None:
    """Writes files into a folder that nobody reads yet."""
    for name, data in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)


def checkpoints(place: Path) -> list[str]:
    """Returns the finished checkpoints of the unit in `place`, oldest first."""
    return sorted(p.name for p in (place / CHECKPOINTS).glob("[0-9]" * 8))


class Tracker:
    """Finds what changed in `place`; what is there at first is known already, except for logs."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._sent: dict[str, int] = {}  # bytes of each log
        self._stamps = {name: self._stamp(name) for name in names(place)}

    def _stamp(self, name: str) -> tuple[int, int]:
        found = (self._place / name).stat()
        return found.st_mtime_ns, found.st_size

    def changes(self) -> Changes:
        """Returns everything that changed since the last call; the run may go on meanwhile."""
        while True:
            try:
                return self._changes()
            except FileNotFoundError:
                continue  # a checkpoint was pruned between being listed and being read

    def _changes(self) -> Changes:
        kept = checkpoints(self._place)
        stamps = {name: self._stamp(name) for name in names(self._place)}
        changed = [n for n, stamp in stamps.items() if self._stamps.get(n) != stamp]
        files = read(self._place, [name for name in changed if name not in LOGS])
        # Last, so that they are not shorter than what a checkpoint among the files counts on.
        logs = [self._grown(name) for name in LOGS if name in stamps]
        self._stamps = stamps
        return Changes(logs, files, kept)

    def _grown(self, name: str) -> tuple[str, int, bytes]:
        with (self._place / name).open("rb") as file:
            start = self._sent.get(name, 0)
            file.seek(start)
            data = file.read()
        self._sent[name] = start + len(data)
        return name, start, data


def apply(place: Path, changes: Changes) -> None:
    """Makes the same changes in `place`."""
    for name, start, data in changes.logs:
        _grow(place / name, start, data)
    ordered = sorted(changes.files, key=lambda name: (name == LAST, name))
    for parent, group in groupby(ordered, key=lambda name: str(Path(name).parent)):
        files = {Path(name).name: changes.files[name] for name in group}
        if parent.startswith(CHECKPOINTS + "/"):
            _replace_folder(place / parent, files)
        else:
            for name, data in files.items():
                _replace_file(place / parent / name, data)
    for name in checkpoints(place):
        if name not in changes.checkpoints:
            shutil.rmtree(place / CHECKPOINTS / name)


def _grow(path: Path, start: int, data: bytes) -> None:
    if start == 0:
        _replace_file(path, data)
    elif data:
        with safe_write.open_grown(path, "r+b") as file:
            file.truncate(start)
            file.seek(start)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())


def _replace_file(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    safe_write.replace_file(path, data)


def _replace_folder(path: Path, files: dict[str, bytes]) -> None:
    temporary = path.with_name(f".writing-{path.name}")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    for name, data in files.items():
        safe_write.write_durably(temporary / name, data)
    safe_write.sync_folder(temporary)
    if path.exists():
        shutil.rmtree(path)
    temporary.rename(path)
    safe_write.sync_folder(path.parent)
