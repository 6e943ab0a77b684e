"""A process (or thread) that trains some of a run's members and reports to the coordinator."""

from __future__ import annotations

import gc
import importlib
import os
import sys
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np

from sauna.config.presets import RunConfig
from sauna.config.stored import read_stored, to_stored
from sauna.envs.probe import Probe
from sauna.envs.spaces import Spaces, read_spaces
from sauna.system.errors import BadInput, SaunaError, one_line
from sauna.system.jax_setup import configure_jax
from sauna.system.processes import Shared, child_ends, receive, send
from sauna.system.tracebacks import describe_failure
from sauna.training.prepare import Prepared

if TYPE_CHECKING:
    from sauna.training.loop.job import Job, Reporter

HEARTBEAT = 2.0  # seconds between two
AHEAD = (  # what every training imports
    "sauna.algorithm.learner.program",
    "sauna.training.loop.evaluation",
    "sauna.training.loop.metrics",
    "scipy.linalg",  # by JAX, for the first orthogonal matrix
)


class PipeReporter:
    """Sends the loop's messages over a pipe; permissions come back over another.

    The coordinator grants iterations, so that no process runs far ahead of the others and all can
    stop at the same one. A coordinator that is gone ends the process.
    """

    def __init__(self, inbox: Connection, outbox: Shared, dies_alone: bool) -> None:
        self._inbox, self._outbox, self._dies_alone = inbox, outbox, dies_alone
        self._granted = 0
        self._stop = False
        self._stopped: set[str] = set()
        self._changed = threading.Condition()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        try:
            while True:
                header = receive(self._inbox).header
                with self._changed:
                    self._granted = header["granted"]
                    self._stop = header["stop"]
                    self._stopped |= set(header.get("stopped", ()))
                    self._changed.notify()
        except (EOFError, OSError):
            if self._dies_alone:
                os._exit(1)
            with self._changed:
                self._stop, self._granted = True, 0
                self._changed.notify()

    def phase(self, text: str) -> None:
        send(self._outbox, {"kind": "phase", "text": text})

    def allowance(self, iteration: int) -> int:
        if self._dies_alone:
            gc.enable()  # the first iteration begins
        with self._changed:
            self._changed.wait_for(lambda: self._stop or iteration < self._granted)
            return max(self._granted - iteration, 0)

    def stopped(self) -> set[str]:
        with self._changed:
            return set(self._stopped)

    def iteration(self, iteration: int, rows: list[dict[str, Any]], timing: dict[str, Any]) -> None:
        header = {"kind": "iteration", "iteration": iteration, "rows": rows, "timing": timing}
        send(self._outbox, header)

    def state(self, iteration: int, arrays: dict[str, np.ndarray]) -> None:
        send(self._outbox, {"kind": "state", "iteration": iteration}, arrays)


def _send_heartbeats(outbox: Shared) -> None:
    """Sends heartbeats, also while an environment or the compiler takes its time."""
    try:
        while True:
            send(outbox, {"kind": "alive"})
            time.sleep(HEARTBEAT)
    except OSError:
        return  # nobody listens any more


def serve(inbox: Connection, outlet: Connection, dies_alone: bool) -> None:
    """Receives a job, trains, and reports how it ended."""
    outbox = Shared(outlet)
    if dies_alone:
        threading.Thread(target=_send_heartbeats, args=(outbox,), daemon=True).start()
    try:
        send(outbox, {"kind": "phase", "text": "importing JAX"})
        if dies_alone:
            _import_ahead()
        header, arrays = receive(inbox)
        config = header["config"]
        configure_jax(config["devices"], "gpu" if config["device"] == "gpu" else "cpu")
        reporter = PipeReporter(inbox, outbox, dies_alone)
        train_members(read_job(header, arrays), reporter)
        send(outbox, {"kind": "done"})
    except (EOFError, BrokenPipeError):
        return
    except SaunaError as error:
        header = {"kind": "failure", "message": str(error)}
        bad = isinstance(error, BadInput)
        send(outbox, {**header, "bad_input": bad, **describe_failure(error, not dies_alone)})
    except Exception as error:
        header = {"kind": "failure", "message": f"training raised {one_line(error)}"}
        send(outbox, {**header, **describe_failure(error, not dies_alone)})


def _import_ahead() -> None:
    """Imports what a training needs, while the parent may still find out what this one is."""
    configure_jax()
    for name in AHEAD:
        importlib.import_module(name)


def train_members(job: Job, reporter: Reporter) -> None:
    """Runs every iteration of the job's members, on the host or on the device.

    Raises:
      NonFinite: an update gave a non-finite loss or parameter; nothing of it was reported.
      EnvironmentFailure: from the environments.
    """
    if job.config.backend == "device":
        from sauna.training.loop.device import train_on_device

        train_on_device(job, reporter)
    else:
        from sauna.training.loop.host import train_on_host

        train_on_host(job, reporter)


def write_job(
    run: RunConfig,
    spaces: Spaces,
    chosen: Sequence[int],
    start: int,
    replay: bool,
    is_restored: bool,
) -> dict[str, Any]:
    """Writes the header of the message that starts a worker; a checkpoint's arrays go beside it.

    Args:
      chosen: the indices of the worker's members among those of `run`.
      start, replay: see `Job`.
      is_restored: whether the arrays are those of this run, or what it starts from.
    """
    return {
        **to_stored(run),
        "spaces": list(spaces),
        "members": list(chosen),
        "start": start,
        "replay": replay,
        "is_restored": is_restored,
    }


def read_job(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Job:
    """Reads the `Job` of a `write_job` header."""
    prepared = Prepared(read_stored(header), Probe(read_spaces(header["spaces"]), None))
    return prepared.job(
        header["members"],
        **{"restored" if header["is_restored"] else "initial": arrays or None},
        start=header["start"],
        replay=header["replay"],
    )


def main() -> None:
    gc.disable()  # what is imported and compiled stays; see `PipeReporter.allowance`
    inbox, outbox = child_ends(sys.argv[1:])
    serve(inbox, outbox, dies_alone=True)


if __name__ == "__main__":
    main()
