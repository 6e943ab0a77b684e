"""A run that is stopped again and again, each time compared with one that was left alone."""

from __future__ import annotations

import os
import random
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from faults.nursery import Nursery, Process, Started
from faults.result import Tally
from sauna.system import checkpoint, run_directory

SETTINGS = {
    "rollout-steps": 32,
    "minibatches": 4,
    "epochs": 2,
    "hidden": "8,8",
    "seeds": 2,
    "arm": "sauna",
    "threshold": 0.9,
    "checkpoint-every": 2,
    "processes": 1,
    "eval-every": 640,
    "eval-episodes": 2,
    "clip-range-schedule": "cosine",
    "entropy-coef": 0.01,
    "entropy-coef-schedule": "linear",
}
# Where a run's environments are stepped: the environment, and what else differs.
BACKENDS: dict[str, tuple[str, dict[str, object]]] = {
    "host": ("small_envs:Scripted", {}),
    "device": ("jax_envs:walk", {"checkpoint-every": 5}),  # several iterations per call
}
PATIENCE = 180.0  # seconds after which a process that should have ended counts as hung
Start = Callable[[list[str], Path], Process]


class Reference:
    """The run that was left alone: every checkpoint's bytes, and the whole log."""

    def __init__(self, start: Start, run: Path, iterations: int, backend: str) -> None:
        self.backend, self._steps = backend, 32 * iterations
        every = {"checkpoint-every": 1, "keep-checkpoints": 100_000}
        arguments = self.arguments(run, every)
        process = start(arguments, run.with_suffix(".log"))
        assert process.wait(PATIENCE) == 0, process.said()
        self.metrics = (run / "metrics.jsonl").read_bytes()
        self.states = {
            int(path.name): (path / "state.safetensors").read_bytes()
            for path in checkpoint.numbered(run / "checkpoints")
        }

    def arguments(self, run: Path, more: Mapping[str, object] | None = None) -> list[str]:
        """Of `sauna`, for a run that is the same."""
        env, own = BACKENDS[self.backend]
        settings = {**SETTINGS, "steps": self._steps, **own, **(more or {})}
        flags = [f"--{name}={value}" for name, value in settings.items()]
        return ["train", env, "--out", str(run), *flags]


class Stage:
    """A nursery, and the reference that all runs of it are compared with."""

    def __init__(self, place: Path, backend: str = "host", iterations: int = 400) -> None:
        self.nursery = Nursery()
        whole = place / f"whole-{backend}"
        self.reference = Reference(self.nursery.start, whole, iterations, backend)

    def chain(self, run: Path, tally: Tally) -> Chain:
        return Chain(run, self.reference, self.nursery.start, tally)

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *error: object) -> None:
        self.nursery.close()


def on_each_backend(place: Path, tally: Tally, iterations: int = 400) -> Iterator[Stage]:
    """A stage on the host, then one on the device; the trials on each are counted."""
    for backend in BACKENDS:
        before = tally.tried
        with Stage(place, backend, iterations) as stage:
            yield stage
        tally.count(f"on the {backend}", tally.tried - before)


class Chain:
    """One run, started, stopped and resumed until it is complete."""

    def __init__(self, run: Path, reference: Reference, start: Start, tally: Tally) -> None:
        shutil.rmtree(run, ignore_errors=True)
        self.run, self._reference, self._tally = run, reference, tally
        self._start_one, self._floor = start, 0
        self.links = 0

    def start(self, fresh: bool) -> Process:
        """Starts or resumes it; `fresh`: as a user does, with an interpreter of its own."""
        start: Start = Started if fresh else self._start_one
        if (self.run / "config.json").exists():
            more = random.Random(self.links).choice([1, 2])  # files do not depend on it
            arguments = ["resume", str(self.run), f"--processes={more}"]
        else:
            arguments = self._reference.arguments(self.run)
        self.links += 1
        return start(arguments, self.run.with_suffix(".log"))

    def rows(self) -> int:
        path = self.run / "metrics.jsonl"
        return path.stat().st_size if path.exists() else 0

    def judge(self, what: str) -> None:
        """What is on disk now, against the reference. A resume goes on from exactly this."""
        said: list[str] = []
        try:
            found = checkpoint.load_newest(self.run / "checkpoints", said.append)
        except checkpoint.BadCheckpoint as error:
            self._tally.lose(f"{what}: no checkpoint can be used: {error}")
            return
        iteration = found.manifest["iteration"] if found else 0
        if iteration < self._floor or said:
            self._tally.lose(f"{what}: back at iteration {iteration}, was {self._floor}; {said}")
        self._floor = max(self._floor, iteration)
        if found:
            state = (found.path / "state.safetensors").read_bytes()
            size = found.manifest["logs"]["metrics.jsonl"]
            rows = (self.run / "metrics.jsonl").read_bytes()[:size]
            if state != self._reference.states[iteration]:
                self._tally.miss(f"{what}: other bytes in the state of iteration {iteration}")
            if rows != self._reference.metrics[:size] or len(rows) != size:
                self._tally.miss(f"{what}: other rows up to iteration {iteration}")

    def is_complete(self) -> bool:
        return run_directory.is_complete(self.run)

    def finish(self) -> None:
        """Lets it end; everything must have the reference's bytes."""
        process = self.start(fresh=False)
        code = process.wait(PATIENCE)
        if code != 0:
            self._tally.lose(f"the last resume ended with {code}: {process.said()[-300:]}")
            process.kill()
            return
        last = checkpoint.numbered(self.run / "checkpoints")[-1]
        same = (last / "state.safetensors").read_bytes() == self._reference.states[int(last.name)]
        if not same or int(last.name) != max(self._reference.states):
            self._tally.miss("the final state differs from that of the run left alone")
        if (self.run / "metrics.jsonl").read_bytes() != self._reference.metrics:
            self._tally.miss("metrics.jsonl differs from that of the run left alone")


def is_saving(run: Path) -> bool:
    try:
        return any(entry.name.startswith(".writing-") for entry in os.scandir(run / "checkpoints"))
    except FileNotFoundError:
        return False


def wait_until(true: Callable[[], bool], process: Process, seconds: float, pause: float) -> bool:
    """Whether it became true before the process ended or the time was over."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        if not Path(f"/proc/{process.pid}/exe").exists() and process.wait(0.0) is not None:
            return False
        time.sleep(pause)
    return False


def wait_for_rows(chain: Chain, process: Process, more: int) -> bool:
    """Until `more` bytes of rows were added to what is there now."""
    before = chain.rows()
    wait_until(lambda: chain.rows() != before, process, PATIENCE, 0.002)  # a resume cuts it first
    least = chain.rows() + more
    return wait_until(lambda: chain.rows() >= least, process, PATIENCE, 0.002)


def children(pid: int) -> list[int]:
    """Processes that `pid` has started and that still run, with theirs."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return []
    own = [int(word) for word in text.split()]
    return own + [other for child in own for other in children(child)]


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def orphans(pids: list[int], seconds: float) -> list[int]:
    """Those of `pids` that are still there after some time."""
    end = time.monotonic() + seconds
    while any(map(is_alive, pids)) and time.monotonic() < end:
        time.sleep(0.01)
    return [pid for pid in pids if is_alive(pid)]


def send(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        pass
