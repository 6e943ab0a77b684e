"""Messages between this project's own processes: a JSON header and named arrays, no pickle.

A message is one safetensors blob whose metadata carries the header. Workers are started as
`python -m MODULE` with a pair of pipes, so a user's script needs no `__main__` guard and a thread
or lock of the parent is never inherited.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np
from safetensors.numpy import load, save

from sauna.system.spawn import spawn


class Message(NamedTuple):
    """`header["kind"]` says what it is."""

    header: dict[str, Any]
    arrays: dict[str, np.ndarray]


def send(
    connection: Connection | Shared,
    header: dict[str, Any],
    arrays: dict[str, np.ndarray] | None = None,
) -> None:
    """Sends a message; blocks while the pipe is full.

    Raises:
      OSError: the other side is gone.
    """
    contiguous = {name: np.asarray(a, order="C") for name, a in (arrays or {}).items()}
    connection.send_bytes(save(contiguous, {"header": json.dumps(header)}))


def receive(connection: Connection) -> Message:
    """Waits for the next message.

    Raises:
      EOFError: the other side is gone.
    """
    return decode(connection.recv_bytes())


def decode(blob: bytes) -> Message:
    """Reads a message's bytes."""
    size = int.from_bytes(blob[:8], "little")
    metadata = json.loads(blob[8 : 8 + size])["__metadata__"]
    return Message(json.loads(metadata["header"]), load(blob))


class Layout:
    """Arrays of known types and shapes as plain bytes, for a message that is sent very often.

    Both sides make it of the arrays of a whole message.
    """

    RAW = b"\xff" * 8  # what a whole message begins with is the size of its header

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        self._kinds = {name: (a.dtype, a.shape, a.nbytes) for name, a in sorted(arrays.items())}

    def pack(self, arrays: Mapping[str, np.ndarray]) -> bytes | None:
        """The arrays as bytes; None if one is of another type or shape than they were."""
        if any(
            (arrays[name].dtype, arrays[name].shape) != kind[:2]
            for name, kind in self._kinds.items()
        ):
            return None
        return b"".join([self.RAW, *(arrays[name].tobytes() for name in self._kinds)])

    def unpack(self, blob: bytes) -> dict[str, np.ndarray]:
        """The inverse of `pack`; the arrays may be written to."""
        own, start, found = bytearray(blob), len(self.RAW), {}
        for name, (dtype, shape, size) in self._kinds.items():
            found[name] = np.frombuffer(own, dtype, size // dtype.itemsize, start).reshape(shape)
            start += size
        return found


class Shared:
    """A connection that several threads may write to."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._lock = connection, threading.Lock()

    def send_bytes(self, blob: bytes) -> None:
        with self._lock:
            self._connection.send_bytes(blob)


class ThreadProcess:
    """A thread with as much of a process's interface as `Worker` needs."""

    pid = os.getpid()

    def __init__(self, thread: threading.Thread) -> None:
        self._thread = thread

    def poll(self) -> int | None:
        return None if self._thread.is_alive() else 0

    def wait(self, timeout: float | None = None) -> int:
        self._thread.join(timeout)
        return 0

    def kill(self) -> None:
        """Does nothing: its closed inbox ends a thread at its next iteration."""


class Worker(NamedTuple):
    """A child process and the two ends of its pipes."""

    process: subprocess.Popen[bytes] | ThreadProcess
    inbox: Connection  # messages from the worker
    outbox: Connection  # messages to it

    def send(self, header: dict[str, Any], arrays: dict[str, np.ndarray] | None = None) -> None:
        send(self.outbox, header, arrays)

    def stop(self, seconds: float = 5.0) -> None:
        """Closes its inbox, which ends it; kills it if that is not enough."""
        self.outbox.close()
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.inbox.close()


def start_worker(module: str, environment: dict[str, str]) -> Worker:
    """Starts a process that runs the module; see `spawn`."""
    process, inbox, outbox = spawn(module, environment)
    return Worker(process, Connection(inbox, writable=False), Connection(outbox, readable=False))


def start_thread(serve: Callable[[Connection, Connection], None]) -> Worker:
    """Starts a worker as a thread of this process, for objects that another could not import."""
    to_thread_read, to_thread_write = os.pipe()
    to_us_read, to_us_write = os.pipe()
    inbox = Connection(to_thread_read, writable=False)
    outbox = Connection(to_us_write, readable=False)

    def target() -> None:
        serve(inbox, outbox)
        outbox.close()

    thread = threading.Thread(target=target, daemon=True)
    thread.start()
    ends = Connection(to_us_read, writable=False), Connection(to_thread_write, readable=False)
    return Worker(ThreadProcess(thread), *ends)


def child_ends(arguments: list[str]) -> tuple[Connection, Connection]:
    """Opens `(inbox, outbox)` in the child, from its command line.

    Signals are the parent's business (schedulers send them to every process): a child ends when
    its inbox closes, and is killed with its parent if it cannot notice that.
    """
    _die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return (
        Connection(int(arguments[0]), writable=False),
        Connection(int(arguments[1]), readable=False),
    )


def _die_with_parent() -> None:
    """Lets Linux kill this process when its parent ends, even while an environment hangs."""
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG
    except (OSError, AttributeError):
        pass  # another system: the closed inbox has to do
