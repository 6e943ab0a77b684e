"""A run whose training is played back: everything that touches the disk is the product's own.

What a worker sends (rows, timings, states) is recorded once from a real training; then a thread
sends it again over real pipes. A whole run takes a fraction of a second, so that every single file
operation of one can be made to fail.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from multiprocessing.connection import Connection
from pathlib import Path
from unittest.mock import patch

import sauna
from faults.disk import Crash, Hook, Op, watched
from helpers import SMALL, Recorder, equal, make_job, train_here
from sauna.system import checkpoint, run_directory
from sauna.system.processes import Shared, Worker, receive, send, start_thread
from sauna.training.worker import PipeReporter

ENV = "small_envs:Scripted"
BACKENDS = {"host": ENV, "device": "jax_envs:walk"}
SETTINGS = {**SMALL, "arm": "ppo", "steps": 192, "processes": 1}
SETTINGS |= {"eval_every": 64, "eval_episodes": 1}
SAVED = {"checkpoint_every": 2, "keep_checkpoints": 2}
ITERATIONS = 6


@cache
def record(env: str = ENV) -> Recorder:
    """Rows of every iteration and the state at the start of each."""
    return train_here(make_job(env, **SETTINGS, checkpoint_every=1))


def serve(recorder: Recorder, inbox: Connection, outlet: Connection) -> None:
    """A worker that sends what was recorded, from a given message on."""
    outbox = Shared(outlet)
    try:
        header, arrays = receive(inbox)
        start = header["start"]
        if start and not equal(arrays, recorder.states[start]):
            raise AssertionError("the worker was given another state than was saved")
        reporter, iteration = PipeReporter(inbox, outbox, dies_alone=False), start
        while iteration < ITERATIONS and reporter.allowance(iteration):
            timing = {"seconds": 1.0, "collect_seconds": 0.5, "env_steps": 32}
            timing |= {"collect_cpu_seconds": 0.5, "update_cpu_seconds": {}}
            reporter.iteration(iteration, [recorder.rows[iteration]], timing)
            iteration += 1
            if iteration % SAVED["checkpoint_every"] == 0:
                reporter.state(iteration, recorder.states[iteration])
        reporter.state(iteration, recorder.states[iteration])
        send(outbox, {"kind": "done"})
    except (EOFError, OSError):
        return
    except AssertionError as error:
        send(outbox, {"kind": "failure", "message": str(error)})


@contextmanager
def played_back(recorder: Recorder) -> Iterator[None]:
    """Runs of this process train by playing back; nothing is drawn or measured besides."""

    def start(module: str, environment: dict[str, str]) -> Worker:
        return start_thread(partial(serve, recorder))

    with (
        patch("sauna.training.coordinator.start_worker", start),
        patch("sauna.api.draw_curve", lambda path: None),
        patch("sauna.system.run_directory.git_revision", lambda: None),
        patch("sauna.system.run_directory.machine", dict),
        patch("os.fsync", lambda descriptor: None),
    ):
        yield


def go(run: Path, env: str = ENV) -> None:
    """Starts the run, or continues it where it is."""
    if (run / "config.json").exists():
        sauna.resume(run, quiet=True)
    else:
        sauna.train(env, out=run, quiet=True, **SAVED, **SETTINGS)


class Trap:
    """Counts operations, and from the `at`-th on something happens instead of them."""

    def __init__(self, at: int | None = None, error: OSError | None = None) -> None:
        self.ops: list[Op] = []
        self.saved: set[str] = set()
        self._at, self._error, self._main = at, error, threading.current_thread()

    def __call__(self, op: Op) -> None:
        if self._at is not None and len(self.ops) >= self._at:
            if self._error is None:
                raise Crash
            if len(self.ops) == self._at:
                self.ops.append(op)
                raise self._error
        self.ops.append(op)
        if op.kind == "rename" and op.data.rpartition("/")[2].isdigit():
            self.saved.add(op.data)


def until(run: Path, hook: Hook, env: str = ENV) -> BaseException | None:
    """Lets the run go on with `hook` at every file operation; how it ended."""
    run.mkdir(parents=True, exist_ok=True)
    try:
        with watched(run, hook):
            go(run, env)
    except (Crash, KeyboardInterrupt, Exception) as error:
        return error
    return None


class Ended:
    """The bytes of a finished run, to compare others with."""

    def __init__(self, run: Path) -> None:
        self.metrics = (run / "metrics.jsonl").read_bytes()
        self.state = _last_state(run)

    def differs(self, run: Path) -> str | None:
        """What of another finished run has other bytes."""
        if not run_directory.is_complete(run):
            return "the run is not complete"
        if (run / "metrics.jsonl").read_bytes() != self.metrics:
            return "metrics.jsonl has other rows"
        return None if _last_state(run) == self.state else "the final state differs"


def _last_state(run: Path) -> bytes:
    return (checkpoint.numbered(run / "checkpoints")[-1] / "state.safetensors").read_bytes()
