"""Reading files that somebody else may have written, or that a disk may have damaged.

Nothing is read but a regular file in its place: no link is followed, no FIFO is waited for. How
much is read is known before it is read. JSON and tensor headers are checked before anything is
made of them; neither can name code.
"""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import IO, Any, NoReturn

from sauna.system.errors import SaunaError

JSON_BYTES = 2**22  # a manifest has a few thousand
HEADER_BYTES = 2**26


class Untrusted(SaunaError):
    """A file is not what it has to be; the message says what is wrong with it."""


def open_file(path: Path) -> IO[bytes]:
    """Opens a regular file for reading.

    Raises:
      Untrusted: there is no such file, or it is a link or something else.
    """
    try:
        if not stat.S_ISREG(os.lstat(path).st_mode):  # opening a device may do something
            raise Untrusted(f"{path.name} is not a regular file")
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        why = getattr(error, "strerror", None) or error
        raise Untrusted(f"{path.name} cannot be read: {why}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise Untrusted(f"{path.name} is not a regular file")
    return os.fdopen(descriptor, "rb")


def read_file(path: Path, limit: int) -> bytes:
    """The bytes of a regular file of at most `limit` bytes.

    Raises:
      Untrusted: there is no such file, it is a link or something else, or it is larger.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise Untrusted(f"{path.name} has {size} bytes; at most {limit} are expected")
        try:
            return file.read(limit + 1)
        except OSError as error:
            raise Untrusted(f"{path.name} cannot be read: {error.strerror}") from error


def parse_object(data: bytes) -> dict[str, Any]:
    """A JSON object in which no key is given twice and every number is finite.

    Raises:
      Untrusted: it is something else.
    """
    try:
        value = json.loads(data, object_pairs_hook=_each_key_once, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise Untrusted(f"is not JSON that is expected here: {error}") from error
    if not isinstance(value, dict):
        raise Untrusted("does not hold a JSON object")
    return value


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key is given twice")
    return found


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def check_header(blob: bytes) -> None:
    """What safetensors does not check of its header: that each name is there once, and no more.

    Offsets, shapes and types it checks itself.

    Raises:
      Untrusted: the header is not one of a checkpoint.
    """
    size = int.from_bytes(blob[:8], "little")
    if len(blob) < 8 or size > min(HEADER_BYTES, len(blob) - 8):
        raise Untrusted("its header does not fit into it")
    for name, tensor in parse_object(blob[8 : 8 + size]).items():
        entries = set(tensor) if isinstance(tensor, dict) else set()
        if name != "__metadata__" and entries != {"dtype", "shape", "data_offsets"}:
            raise Untrusted(f"the header of {name!r} is not a tensor's")
