"""Threads of this process in place of the processes that train, and of those that run units.

A process imports JAX and compiles anew what this one has compiled: seconds, of which a training of
these tests takes a tenth. The messages and their pipes are the same.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from sauna.experiments.study.execute import unit_process
from sauna.system.errors import SaunaError
from sauna.system.processes import start_thread
from sauna.training import worker

ONE_AT_A_TIME = threading.Lock()


class _Lines:
    """A stream that hands on each line as a message."""

    def __init__(self, receive: Callable[[Any], None]) -> None:
        self._receive = receive

    def write(self, line: str) -> None:
        self._receive(json.loads(line))

    def flush(self) -> None:
        pass


class UnitThread:
    """A unit of a study as `UnitProcess` shows it; it cannot be stopped."""

    def __init__(
        self, overrides: Mapping[str, Any], log: Path, receive: Callable[[Any], None]
    ) -> None:
        settings = json.loads(json.dumps(overrides))
        self._thread = threading.Thread(target=self._run, args=(settings, receive), daemon=True)
        self._thread.start()

    def _run(self, settings: dict[str, Any], receive: Callable[[Any], None]) -> None:
        try:
            with ONE_AT_A_TIME:  # Python 3.11 cannot parse code in two threads at once
                unit_process.train(settings, {}, unit_process.LineDisplay(_Lines(receive)))  # type: ignore[arg-type]
        except SaunaError as error:
            receive({"error": str(error)})
        finally:
            receive(None)

    def stop(self) -> None:
        pass

    def kill(self) -> None:
        pass

    def end(self) -> str:
        self._thread.join()
        return "its thread ended"


@contextmanager
def trained_here() -> Iterator[None]:
    """Runs and studies train in threads of this process."""
    target = partial(worker.serve, dies_alone=False)
    with (
        patch("sauna.training.coordinator.start_worker", lambda *given: start_thread(target)),
        patch("sauna.cli.spawned_ahead", lambda *given: nullcontext()),
        patch("sauna.experiments.study.execute.local.UnitProcess", UnitThread),
    ):
        yield
