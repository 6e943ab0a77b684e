"""A run's logs: JSON rows in lines, of which a checkpoint counts on the first so many bytes.

Its manifest holds how many, and their SHA-256, which is carried along as rows are appended. So a
row that a disk or a hand has changed since is found before anything is built on it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sauna.system.checkpoint import BadCheckpoint, NewerFormat, numbered, read_manifest
from sauna.system.errors import SaunaError
from sauna.system.safe_read import Untrusted, open_file
from sauna.system.safe_write import check_own, open_grown, sync_folder

NAMES = ("metrics.jsonl", "timing.jsonl")
LINE_BYTES = 2**24  # a row has some thousand, but for very many episodes
# What every row of metrics.jsonl has.
ROW = {"member": str, "arm": str, "seed": int, "iteration": int, "env_steps": int}


class Logs:
    """The logs of one run, by the only process that writes them."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self._digests = {name: hashlib.sha256() for name in NAMES}
        self._sizes = dict.fromkeys(NAMES, 0)
        for name in NAMES:
            for line in lines(run / name):
                self._count(name, line)

    def _count(self, name: str, line: bytes) -> None:
        self._digests[name].update(line)
        self._sizes[name] += len(line)

    def append(self, name: str, rows: list[dict[str, Any]]) -> None:
        with open_grown(self._run / name) as file:
            for row in rows:
                line = (json.dumps(row, allow_nan=False) + "\n").encode()
                file.write(line)
                self._count(name, line)

    def counted(self) -> dict[str, dict[str, Any]]:
        """What a checkpoint's manifest says of the logs, all of them flushed to disk."""
        there = [name for name in NAMES if (self._run / name).exists()]
        for name in there:
            sync_folder(self._run / name)
        digests = {name: self._digests[name].hexdigest() for name in there}
        return {"logs": {name: self._sizes[name] for name in there}, "log_digests": digests}


def lines(path: Path, most: int | None = None) -> Iterator[bytes]:
    """The lines of a log, or of its first `most` bytes; none where there is no such file.

    Raises:
      Untrusted: it is not a regular file, or has a line that is no row's.
    """
    if not os.path.lexists(path):
        return
    left = most
    with open_file(path) as file:
        while line := file.readline(LINE_BYTES + 1 if left is None else min(left, LINE_BYTES + 1)):
            if len(line) > LINE_BYTES:
                raise Untrusted(f"{path.name} has a line of more than {LINE_BYTES} bytes")
            yield line
            if left is not None:
                left -= len(line)


def read_row(line: bytes, name: str) -> dict[str, Any]:
    """A line of the log `name` as its row.

    Raises:
      ValueError: it is not such a row; the message says why.
    """
    row = json.loads(line)
    if not isinstance(row, dict):
        raise ValueError("it is no JSON object")
    if name == NAMES[0]:
        for key, kind in ROW.items():
            if type(row.get(key)) is not kind:
                raise ValueError(f"{key} is missing or of another type")
        for key, value in row.items():
            if key not in ROW and not all(map(_is_number, value if _is_list(value) else [value])):
                raise ValueError(f"{key} is no number")
    return row


def _is_list(value: Any) -> bool:
    return isinstance(value, list)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def check_logs(run: Path, manifest: Mapping[str, Any]) -> None:
    """Whether the logs begin with the rows that a checkpoint counts on.

    Raises:
      BadCheckpoint: rows were lost or changed; the first line that is damaged is named.
    """
    for name in NAMES:
        path, size = run / name, manifest["logs"].get(name, 0)
        try:
            if (os.lstat(path).st_size if os.path.lexists(path) else 0) < size:
                raise Untrusted("is shorter than when the checkpoint was saved; rows are lost")
            digest = manifest["log_digests"].get(name)
            if digest is None:  # of a version that did not write it
                _check_rows(path, size, manifest["iteration"])
            elif _digest(path, size) != digest:
                _check_rows(path, size, manifest["iteration"])
                raise Untrusted("is not what was written (SHA-256 differs)")
        except Untrusted as error:
            text = str(error).removeprefix(f"{name} ")
            raise BadCheckpoint(f"{path} {text}") from error


def damage_of(run: Path) -> str | None:
    """What of a run's logs is not what its newest good checkpoint counts on; None: nothing.

    A run without a checkpoint has nothing that could say.
    """
    for path in reversed(numbered(run / "checkpoints")):
        try:
            manifest = read_manifest(path)
        except (BadCheckpoint, NewerFormat):
            continue
        try:
            check_logs(run, manifest)
        except BadCheckpoint as error:
            return str(error)
        return None
    return None


def _digest(path: Path, size: int) -> str:
    found = hashlib.sha256()
    for line in lines(path, size):
        found.update(line)
    return found.hexdigest()


def _check_rows(path: Path, size: int, end: int) -> None:
    """Whether the first `size` bytes are whole rows, of every iteration before `end`.

    Raises:
      Untrusted: naming the first line that is not as it must be.
    """
    number, before = 0, -1
    for number, line in enumerate(lines(path, size), 1):
        try:
            row = read_row(line, path.name)
        except (ValueError, RecursionError) as error:
            raise Untrusted(f"line {number} is damaged: {error}") from error
        if not line.endswith(b"\n"):
            raise Untrusted(f"line {number} is not where it was: rows are lost before it")
        if row.get("iteration") not in (before, before + 1):
            raise Untrusted(f"line {number} is not of iteration {before} or {before + 1}")
        before = row["iteration"]
    if size and before != end - 1:
        raise Untrusted(f"ends at line {number} with iteration {before}, not {end - 1}")


def cut_logs(run: Path, sizes: Mapping[str, int]) -> None:
    """Brings the logs back to a checkpoint: rows behind it will be written again.

    Raises:
      Untrusted: a log is a link, or no regular file.
    """
    for name in NAMES:
        path = run / name
        check_own(path)
        if path.exists():
            os.truncate(path, sizes.get(name, 0))


def read_rows(path: Path, is_complete: bool) -> list[dict[str, Any]]:
    """All rows of a log; an unfinished last line (of a run in progress) is left out.

    So is everything behind a line that a power cut has spoilt: a resume cuts that off.

    Raises:
      SaunaError: a row of a complete run cannot be read; its line is named.
    """
    found: list[dict[str, Any]] = []
    try:
        for number, line in enumerate(lines(path), 1):
            try:
                if line.endswith(b"\n"):
                    found.append(read_row(line, path.name))
            except (ValueError, RecursionError) as error:
                if is_complete:
                    raise SaunaError(f"{path}: line {number} is damaged: {error}") from error
                break
    except Untrusted as error:
        raise SaunaError(f"{path}: {error}") from error
    return found
