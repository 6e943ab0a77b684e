"""Whether training processes still send heartbeats.

A process that was stopped, or hangs so badly that none of its threads runs, sends nothing: not even
that it has ended. It is killed after `MAX_SILENCE`, so that a read which waits for it ends, too. An
environment that hangs in the training process itself is no such case (its other threads go on);
with `env_processes` it has a deadline of its own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from sauna.system.processes import ThreadProcess, Worker

MAX_SILENCE = 300.0  # seconds without a message; a library may well hold the GIL for a minute
INTERVAL = 0.5  # seconds between two looks at the clock


class Watchdog:
    """Counts each process's silence, but only while we listen.

    Time is counted in intervals of our own thread: if the whole machine was suspended, or this
    process was stopped together with its workers, none has passed.
    """

    def __init__(self, workers: list[Worker]) -> None:
        self._workers = workers
        self._silent = [0.0] * len(workers)
        self._listening = False
        self._closed = threading.Event()
        self.hung: set[int] = set()
        threading.Thread(target=self._run, daemon=True).start()

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Counts silence while the caller waits for messages."""
        self._listening = True
        try:
            yield
        finally:
            self._listening = False

    def heartbeat(self, number: int) -> None:
        """Notes a message of process `number`."""
        self._silent[number] = 0.0

    def close(self) -> None:
        """Ends the thread."""
        self._closed.set()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._closed.wait(INTERVAL):
            now = time.monotonic()
            if self._listening:
                self._count(min(now - before, 2 * INTERVAL))
            before = now

    def _count(self, seconds: float) -> None:
        for number, worker in enumerate(self._workers):
            if isinstance(worker.process, ThreadProcess) or worker.process.poll() is not None:
                continue
            self._silent[number] += seconds
            if self._silent[number] > MAX_SILENCE:
                self.hung.add(number)
                worker.process.kill()
