"""New interpreters that run a module of ours, also before there is work for them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple


class Spawned(NamedTuple):
    """A child process, and our ends of its two pipes."""

    process: subprocess.Popen[bytes]
    inbox: int  # file descriptor of what it sends
    outbox: int  # of what is sent to it


class _Command(NamedTuple):
    """All that decides what a child process is."""

    module: str
    environment: dict[str, str]
    folder: str

    def still_holds(self, now: _Command) -> bool:
        """Whether a process started by it is one started by `now`.

        A variable that is new since then is a library's, which sets it in the child as well.
        """
        given = self.environment.items() <= now.environment.items()
        return given and (self.module, self.folder) == (now.module, now.folder)


_ahead: dict[str, tuple[_Command, Spawned]] = {}  # by module; at most one of each


def spawn(module: str, environment: dict[str, str]) -> Spawned:
    """Starts `python -m module READ_FD WRITE_FD` in its own process group (Ctrl-C is ours).

    One that was `spawned_ahead` is taken instead, if it is what would be started now.
    """
    command = _command(module, environment)
    if module in _ahead:
        before, spawned = _ahead.pop(module)
        if before.still_holds(command):
            return spawned
        _end(spawned)
    return _start(command)


@contextmanager
def spawned_ahead(module: str, environment: dict[str, str]) -> Iterator[None]:
    """Starts a process that `spawn` may take within the block; it ends if that takes none.

    It imports what it needs while this process finds out what it has to do.
    """
    command = _command(module, environment)
    _ahead[module] = command, _start(command)
    try:
        yield
    finally:
        if module in _ahead:
            _end(_ahead.pop(module)[1])


def _command(module: str, environment: dict[str, str]) -> _Command:
    here = os.getcwd()
    found_anyway = () if sys.flags.safe_path else ("", here)  # `-m` looks there first
    path = os.pathsep.join(part or here for part in sys.path if part not in found_anyway)
    return _Command(module, {**os.environ, "PYTHONPATH": path, **environment}, here)


def _start(command: _Command) -> Spawned:
    to_child_read, to_child_write = os.pipe()
    to_parent_read, to_parent_write = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-m", command.module, str(to_child_read), str(to_parent_write)],
        pass_fds=(to_child_read, to_parent_write),
        env=command.environment,
        stdin=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(to_child_read)
    os.close(to_parent_write)
    return Spawned(process, to_parent_read, to_child_write)


def _end(spawned: Spawned) -> None:
    os.close(spawned.inbox)
    os.close(spawned.outbox)
    spawned.process.kill()
    spawned.process.wait()
