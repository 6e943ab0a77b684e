"""Runs of `sauna` that start at once: forked from a process that has imported everything.

Importing JAX takes seconds, and hundreds of trials need a fresh process each. A forked process
runs the command line's own `main`, and its training workers are forked from it instead of being
started as `python -m sauna.training.worker`; they are real processes with real pipes, which any
signal can hit. XLA is started in each of them after the fork, never before. Every row also starts
some of its trials as a user does, with an interpreter of their own. Runs on the host have a
callback.

    python -m faults.nursery        answers one JSON line per line of standard input
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parent.parent
SOURCE = TESTS.parent / "src"


def environment() -> dict[str, str]:
    path = os.pathsep.join([str(SOURCE), str(TESTS)])
    return {
        **os.environ,
        "PYTHONPATH": path,
        "JAX_PLATFORMS": "cpu",
        "PJRT_NPROC": "1",
        "OMP_NUM_THREADS": "1",
    }


class Process:
    """One run of the command line; its output goes to `log`."""

    pid: int

    def __init__(self, log: Path) -> None:
        self.log = log

    def wait(self, seconds: float) -> int | None:
        """The exit code as `subprocess` has it (negative: a signal), or None: still running."""
        raise NotImplementedError

    def said(self) -> str:
        return self.log.read_text(errors="replace")

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)


class Started(Process):
    """As a user starts it, in an interpreter of its own."""

    def __init__(self, arguments: list[str], log: Path) -> None:
        super().__init__(log)
        with log.open("w") as out:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "faults.called_back", *arguments],
                stdout=out,
                stderr=out,
                env=environment(),
                start_new_session=True,
            )
        self.pid = self._process.pid

    def wait(self, seconds: float) -> int | None:
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None


class Forked(Process):
    """The same, from a `Nursery`."""

    def __init__(self, nursery: Nursery, pid: int, log: Path) -> None:
        super().__init__(log)
        self.pid, self._nursery, self._code = pid, nursery, None

    def wait(self, seconds: float) -> int | None:
        if self._code is None:
            self._code = self._nursery.ask({"wait": self.pid, "seconds": seconds})["code"]
        return self._code


class Nursery:
    """The process that forks, seen from outside."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "faults.nursery"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment(),
        )

    def start(
        self, arguments: list[str], log: Path, at: float = 0.0, silence: float = 300.0
    ) -> Process:
        """Starts `sauna ARGUMENTS`; not before `time.monotonic()` is `at`.

        `silence` stands in for `watchdog.MAX_SILENCE`.
        """
        question = {"start": arguments, "log": str(log), "at": at, "silence": silence}
        return Forked(self, self.ask(question)["pid"], log)

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def __enter__(self) -> Nursery:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()


def _warm() -> None:
    """Imports what a run imports. No JAX array may be made here: XLA's threads do not fork."""
    import matplotlib.pyplot
    import rich.console
    import scipy.stats

    import jax_envs
    import sauna.experiments.evaluate.episodes
    import sauna.training.coordinator
    import sauna.training.loop.device
    import sauna.training.loop.host
    import sauna.training.run
    import small_envs
    from sauna.algorithm.rollout import moments

    numbers = moments.ObservationMoments(1, 1, 1.0)  # loads the compiled loops
    import numpy as np

    one = np.zeros((1, 1, 1))
    numbers.see(one, np.ones((1, 1), bool))
    numbers.see_and_normalize(one, np.ones((1, 1), bool), np.zeros((1, 1, 1), np.float32))
    numbers.normalize(one, np.zeros((1, 1, 1), np.float32))
    del jax_envs, matplotlib, rich, scipy, sauna, small_envs


class _ForkedWorker:
    """As much of `subprocess.Popen`'s interface as the coordinator needs."""

    def __init__(self, pid: int) -> None:
        self.pid, self.returncode = pid, None

    def poll(self) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        end = time.monotonic() + (1e9 if timeout is None else timeout)
        while self.poll() is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired("worker", timeout or 0.0)
            time.sleep(0.005)
        assert self.returncode is not None
        return self.returncode

    def kill(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)


def _fork_worker(module: str, environment: dict[str, str]) -> Any:
    """Stands in for `processes.start_worker`: the same pipes, no new interpreter."""
    from sauna.system.processes import Worker, child_ends
    from sauna.training import worker as served

    to_child_read, to_child_write = os.pipe()
    to_parent_read, to_parent_write = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.setsid()
        _close_all_but(to_child_read, to_parent_write)
        os.environ.update(environment)
        code = 1
        try:
            served.configure_jax = partial(_cache_everything, served.configure_jax)
            ends = child_ends([str(to_child_read), str(to_parent_write)])
            served.serve(*ends, dies_alone=True)
            code = 0
        finally:
            os._exit(code)
    os.close(to_child_read)
    os.close(to_parent_write)
    ends = Connection(to_parent_read, writable=False), Connection(to_child_write, readable=False)
    return Worker(_ForkedWorker(pid), *ends)  # type: ignore[arg-type]


def _cache_everything(configure: Callable[..., None], *where: Any) -> None:
    """Also the small programs are read from the cache on disk: the same ones, sooner."""
    import jax

    configure(*where)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _close_all_but(*kept: int) -> None:
    """As `subprocess` does: an inherited lock file would keep the run locked."""
    for name in os.listdir("/proc/self/fd"):
        if int(name) > 2 and int(name) not in kept:
            try:
                os.close(int(name))
            except OSError:
                pass


def _run(arguments: list[str], log: str, at: float, silence: float) -> None:
    """The forked process: `sauna ARGUMENTS`, then its end."""
    os.setsid()
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((nothing, 0), (out, 1), (out, 2)):
        os.dup2(source, target)
    _close_all_but()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    from faults.called_back import call_back
    from sauna import cli
    from sauna.system import watchdog
    from sauna.training import coordinator

    call_back()
    coordinator.start_worker, watchdog.MAX_SILENCE = _fork_worker, silence
    cli.spawned_ahead = lambda *given: nullcontext()
    time.sleep(max(0.0, at - time.monotonic()))
    code = 0
    try:
        cli.main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    except KeyboardInterrupt:
        code = 130
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _wait(pid: int, seconds: float) -> int | None:
    end = time.monotonic() + seconds
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            return None
        time.sleep(0.005)


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _warm()
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    for line in sys.stdin:
        question = json.loads(line)
        if "start" in question:
            pid = os.fork()
            if pid == 0:
                _run(question["start"], question["log"], question["at"], question["silence"])
            answers.write(json.dumps({"pid": pid}) + "\n")
        else:
            code = _wait(question["wait"], question["seconds"])
            answers.write(json.dumps({"code": code}) + "\n")


if __name__ == "__main__":
    main()
