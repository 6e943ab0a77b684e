"""Writing into folders that somebody else may have prepared.

Nothing is written through a link, and nothing is waited for: a file that is replaced gets a new
one, written under a name that cannot be guessed; a file that grows has to be a regular one that
nothing else names. A link that the user gave as the folder itself is followed.
"""

from __future__ import annotations

import io
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from sauna.system.safe_read import Untrusted


def check_own(path: Path) -> None:
    """Refuses a file that is there and is not a regular one with this name alone.

    Raises:
      Untrusted: it is a link, a folder, a FIFO or a device, or has another name elsewhere.
    """
    try:
        status = os.lstat(path)
    except FileNotFoundError:
        return
    if stat.S_ISLNK(status.st_mode):
        raise Untrusted(f"{path} is a link; nothing is written through links")
    if not stat.S_ISREG(status.st_mode):
        raise Untrusted(f"{path} is not a regular file; nothing is written to it")
    if status.st_nlink > 1:
        raise Untrusted(f"{path} is also the file of another name (a hard link); copy it first")


def own_folder(path: Path) -> Path:
    """Makes a folder unless it is there.

    Raises:
      Untrusted: it is a link.
    """
    if path.is_symlink():
        raise Untrusted(f"{path} is a link; nothing is written through links")
    path.mkdir(parents=True, exist_ok=True)
    return path


def open_new(path: Path) -> IO[bytes]:
    """Opens a file that must not be there yet, not even as a link."""
    return io.open(path, "xb", opener=_open)  # noqa: UP020 - the tests' disk watches this name


def open_grown(path: Path, mode: str = "ab") -> Any:
    """Opens a file for appending (`ab`, `a+`), or one that is there for changing (`r+b`).

    Raises:
      Untrusted: as `check_own`.
    """
    check_own(path)
    return io.open(path, mode, opener=_open)  # noqa: UP020


def _open(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new empty file beside `path`, of the same suffix, which takes its place at the end.

    The place is taken atomically: a reader sees the old file or the new one. Where the body
    raises, the old file stays.
    """
    with _taking_place_of(path, path.suffix) as temporary:
        open_new(temporary).close()
        yield temporary
        sync_folder(temporary)


def replace_file(path: Path, data: bytes) -> None:
    """Writes `data` in the place of a file, atomically and durably."""
    with _taking_place_of(path) as temporary:
        write_durably(temporary, data)


@contextmanager
def _taking_place_of(path: Path, suffix: str = "") -> Iterator[Path]:
    """A name beside `path` for a file that the body writes, and that then takes its place.

    Where the body raises, the old file stays and the new one goes.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.writing{suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except Exception:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A new folder beside `path`, which takes its place at the end.

    None is left if the body raises. The place may be an empty folder; the folders above are made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.writing")
    temporary.mkdir()
    try:
        yield temporary
        sync_folder(temporary)
        temporary.replace(path)
        sync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_durably(path: Path, data: bytes) -> None:
    """Writes a file that is not there yet; it is on the disk when this returns."""
    with open_new(path) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Flushes a folder's entries, or a file's bytes, to the disk; waits for no FIFO."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_unfinished(path: Path) -> bool:
    """Whether a file is one that a kill kept from taking its place."""
    return path.name.startswith(".") and ".writing" in path.name
