"""A run: checks the input, shares the members over processes, writes everything that is written.

This process never imports JAX. It starts workers, grants them iterations, puts their rows into
`metrics.jsonl` in a fixed order, and saves a checkpoint once every member has sent its state.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import IO, Any

import numpy as np

from sauna import checkpoint, rundir
from sauna.config import Config, to_json
from sauna.envs.probe import Probe, probe
from sauna.errors import BadInput, Interrupted, SaunaError
from sauna.metrics.curve import draw_curve
from sauna.metrics.display import Display
from sauna.metrics.tensorboard import TensorBoard
from sauna.presets import Member, members, resolve, stored_config
from sauna.spaces import Spaces
from sauna.wire import Message, Worker, receive, start_thread, start_worker
from sauna.worker import serve, write_job

LEAD = 2  # iterations that a process may be ahead of the slowest one

# Fields that `resume` may change: they do not touch what is computed.
RESUMABLE = ("processes", "env_processes", "env_timeout", "checkpoint_every", "keep_checkpoints",
             "tensorboard")  # fmt: skip


class Run:
    """One run on disk, ready to be trained further."""

    def __init__(
        self, path: Path, given: dict[str, Any], config: Config, found: Probe, held: IO[str]
    ) -> None:
        self.path, self.given, self.config, self.held = path, given, config, held
        self.spaces, self.differs = found
        self.members: list[Member] = members(config, given)
        self.drop_rates = _drop_rates(self.members)

    def manifest(self) -> dict[str, Any]:
        return {
            "config": to_json(self.config),
            "given": self.given,
            "spaces": list(self.spaces),
            "members": [member.name for member in self.members],
            "versions": rundir.versions(),
        }


def start(given: Mapping[str, Any], display: Display) -> Run:
    """A new run: everything is checked before anything is created.

    Raises:
      BadInput: the settings, the environment or the place of the run are not usable.
    """
    given = dict(given)
    config = resolve(given)
    found = probe(config.env, json.loads(config.env_kwargs))
    config = settle(config, found.spaces)
    _drop_rates(members(config, given))
    TensorBoard.check(config)
    _check_plugins(config, found.spaces)
    path = Path(config.out) if config.out else rundir.default_path(config.env, config.arm)
    config = dataclasses.replace(config, out=str(path))
    rundir.create(path)
    run = Run(path, given, config, found, rundir.lock(path))
    rundir.write_json(
        path / "config.json",
        {
            "given": given,
            "config": to_json(config),
            "spaces": list(found.spaces),
            "exact_resume": found.differs is None,
            "versions": rundir.versions(),
            "git": rundir.git_revision(),
            "machine": rundir.machine(),
        },
    )
    if found.differs:
        display.say(
            f"warning: {config.env} does not repeat itself ({found.differs}): this run can be "
            f"continued, but not resumed exactly"
        )
    return run


def _check_plugins(config: Config, spaces: Spaces) -> None:
    """Builds the program here where the user brought parts of it: a mistake is bad input then."""
    if any(":" in name for name in (config.network, config.filter, config.vex_target)):
        from sauna.core.population import make_program

        make_program(config, spaces)


def settle(config: Config, spaces: Spaces) -> Config:
    """Replaces what depends on the environment or the machine by what it comes to.

    Raises:
      BadInput: the network does not fit the observations.
    """
    image = spaces.observation_kind == "image"
    network = config.network
    if network == "auto":
        network = "nature-cnn" if image else "mlp"
    if (network == "nature-cnn") != image and ":" not in network:
        raise BadInput(
            f"network: {network} does not fit {spaces.observation_kind} observations of shape "
            f"{spaces.observation_shape}"
        )
    number = len(config.arm) * len(config.seeds)
    processes = config.processes or os.cpu_count() or 1
    return dataclasses.replace(
        config,
        network=network,
        normalize_observations=config.normalize_observations
        and spaces.observation_kind == "vector",
        processes=min(processes, number),
    )


def reopen(path: Path, changes: Mapping[str, Any], display: Display) -> Run:
    """An existing run, to be continued.

    Raises:
      BadInput: it is not a run, is in use, or `changes` would change what is computed.
    """
    stored = rundir.read_config(path)
    for name in changes:
        if name not in RESUMABLE:
            raise BadInput(f"{name}: cannot be changed on resume (can: {', '.join(RESUMABLE)})")
    given = {**stored.get("given", {}), **changes}
    resolved = resolve(given)
    config = stored_config(stored.get("config", {}))
    config = dataclasses.replace(config, **{name: getattr(resolved, name) for name in changes})
    found = probe(config.env, json.loads(config.env_kwargs))
    config = settle(config, found.spaces)
    if stored["spaces"] != json.loads(json.dumps(found.spaces)):
        raise BadInput(f"{config.env} has other spaces than when the run started: "
                       f"{found.spaces} instead of {stored['spaces']}")  # fmt: skip
    return Run(path, dict(given), config, found, rundir.lock(path))


def _drop_rates(everyone: list[Member]) -> list[list[float]]:
    """Per member, the drop rate of every iteration of the run it is to repeat."""
    source = everyone[0].config.drop_rate_from
    if not source:
        return []
    rates: dict[int, list[float]] = {}
    rundir.read_config(Path(source))
    for row in rundir.rows(Path(source)):
        rates.setdefault(row["seed"], []).append(1.0 - row["keep_rate"])
    for member in everyone:
        if member.seed not in rates:
            raise BadInput(f"drop_rate_from: {source} has no rows of seed {member.seed}")
    return [rates[member.seed] for member in everyone]


def train(run: Run, display: Display, *, resume: bool, inexact: bool = False) -> None:
    """Trains a run to its end; returns when everything is written.

    Raises:
      Interrupted: a signal came; the state is saved.
      SaunaError: something failed; the last good checkpoint is on disk.
    """
    loaded = None
    if resume:
        if rundir.is_complete(run.path):
            display.say(f"{run.path} is complete; nothing to do")
            return
        loaded = checkpoint.load_newest(run.path / "checkpoints", display.say)
        _check_same(run, loaded)
        rundir.cut_logs(run.path, loaded.manifest["logs"] if loaded else {})
    with _Coordinator(run, display, loaded, inexact) as coordinator:
        coordinator.run()


def _check_same(run: Run, loaded: checkpoint.Checkpoint | None) -> None:
    """Refuses a checkpoint that another config or environment wrote.

    Raises:
      BadInput: with the first field that differs.
    """
    if loaded is None:
        return
    own = run.manifest()
    for name, value in own["config"].items():
        stored = loaded.manifest["config"].get(name)
        if name not in (*RESUMABLE, "out") and stored != value:
            raise BadInput(f"{loaded.path} is of another run: {name} is {stored!r}, not {value!r}")
    for name in ("spaces", "members"):
        if loaded.manifest[name] != json.loads(json.dumps(own[name])):
            raise BadInput(f"{loaded.path} is of another environment or run: {name} differ")


class _Coordinator:
    """The workers of one run and what they have sent but is not yet written."""

    def __init__(
        self,
        run: Run,
        display: Display,
        loaded: checkpoint.Checkpoint | None,
        inexact: bool,
    ) -> None:
        self._run, self._display = run, display
        self._iteration = loaded.manifest["iteration"] if loaded else 0
        self._parts = np.array_split(np.arange(len(run.members)), run.config.processes)
        self._rows: dict[int, dict[int, Message]] = {}
        self._states: list[dict[int, dict[str, np.ndarray]]] = [{} for _ in self._parts]
        self._reached = [self._iteration] * len(self._parts)
        self._ended: list[int | None] = [None] * len(self._parts)
        self._due: list[tuple[int, dict[str, int]]] = []  # checkpoints waiting for their states
        self._granted = 0
        self._signal: int | None = None
        self._tensorboard = TensorBoard(run.path, run.config)
        replay = not inexact and run.differs is None
        if loaded and not replay:
            display.say("warning: not an exact resume: every environment starts a new episode")
        self._workers = [self._start(part, loaded, replay) for part in self._parts]

    def _start(
        self, part: np.ndarray, loaded: checkpoint.Checkpoint | None, replay: bool
    ) -> Worker:
        run = self._run
        if any(str(v).startswith("sauna.local:") for v in to_json(run.config).values()):
            worker = start_thread(partial(serve, dies_alone=False))
        else:
            worker = start_worker("sauna.worker", {"PJRT_NPROC": "1", "OMP_NUM_THREADS": "1",
                                                   "JAX_PLATFORMS": "cpu"})  # fmt: skip
        names = [run.members[index].name for index in part]
        arrays = {
            key: value
            for key, value in (loaded.arrays if loaded else {}).items()
            if any(key.startswith(name + "/") for name in names)
        }
        header = write_job(
            to_json(run.config),
            run.given,
            run.spaces,
            [int(index) for index in part],
            [run.drop_rates[index] for index in part] if run.drop_rates else [],
            self._iteration,
            replay,
        )
        worker.say(header, arrays)
        return worker

    def __enter__(self) -> _Coordinator:
        return self

    def __exit__(self, *error: Any) -> None:
        for worker in self._workers:
            worker.stop(0.0 if error[0] else 5.0)
        self._tensorboard.close()
        self._display.close()
        self._run.held.close()

    def run(self) -> None:
        self._display.open(self._run.config, self._run.members, self._run.path)
        with _signals(self._on_signal):
            self._grant()
            while any(end is None for end in self._ended):
                self._pump()
        self._save(self._last_iteration(), rundir.log_sizes(self._run.path))
        complete = self._signal is None
        self._write_summary(complete)
        if not complete:
            raise Interrupted(
                self._signal or 0,
                f"stopped by {signal.Signals(self._signal or 0).name} after iteration "
                f"{self._last_iteration()}; continue with: sauna resume {self._run.path}",
            )
        draw_curve(self._run.path)

    def _last_iteration(self) -> int:
        return max(end for end in self._ended if end is not None)

    def _on_signal(self, number: int) -> None:
        if self._signal is not None:
            raise Interrupted(
                number, f"stopped at once; continue with: sauna resume {self._run.path}"
            )
        self._signal = number
        self._display.say(f"{signal.Signals(number).name}: finishing the iteration, then saving "
                          f"(again to stop at once)")  # fmt: skip
        self._tell()

    def _grant(self) -> None:
        """Lets every worker run at most `LEAD` iterations ahead of the slowest."""
        running = [r for r, end in zip(self._reached, self._ended, strict=True) if end is None]
        if running and self._signal is None and min(running) + LEAD > self._granted:
            self._granted = min(running) + LEAD
            self._tell()

    def _tell(self) -> None:
        for worker, end in zip(self._workers, self._ended, strict=True):
            if end is None:
                try:
                    worker.say({"granted": self._granted, "stop": self._signal is not None})
                except BrokenPipeError:
                    pass  # its end is noticed, and named, when its inbox is read

    def _pump(self) -> None:
        """Handles whatever has arrived within a moment, and shows it."""
        inboxes = {
            worker.inbox: number
            for number, worker in enumerate(self._workers)
            if self._ended[number] is None
        }
        for inbox in wait(list(inboxes), timeout=0.1):
            number = inboxes[inbox]  # type: ignore[index]
            try:
                message = receive(inbox)  # type: ignore[arg-type]
            except EOFError:
                code = self._workers[number].process.wait()
                pid = self._workers[number].process.pid
                raise SaunaError(
                    f"training process {number} ({pid}) ended with exit code {code}"
                ) from None
            self._handle(number, message)
        self._display.refresh()

    def _handle(self, number: int, message: Message) -> None:
        header = message.header
        match header["kind"]:
            case "phase":
                self._display.phase(number, header["text"])
            case "iteration":
                self._rows.setdefault(header["iteration"], {})[number] = message
                self._reached[number] = header["iteration"] + 1
                self._display.rows(header["rows"], header["timing"]["seconds"])
                self._grant()
                self._flush()
            case "state":
                self._states[number][header["iteration"]] = message.arrays
                self._flush()
            case "failure":
                raise SaunaError(header["message"])
            case "done":
                self._ended[number] = self._reached[number]
                self._grant()
                self._flush()

    def _flush(self) -> None:
        """Writes the iterations that are complete, in order, and the checkpoints among them."""
        while self._complete(self._iteration, self._rows.get(self._iteration, {})):
            messages = self._rows.pop(self._iteration)
            rows = [row for number in sorted(messages) for row in messages[number].header["rows"]]
            self._write_rows(rows, [m.header["timing"] for m in messages.values()])
            self._iteration += 1
            if self._iteration % self._run.config.checkpoint_every == 0:
                self._due.append((self._iteration, rundir.log_sizes(self._run.path)))
        while self._due and self._all_states_of(self._due[0][0]):
            self._save(*self._due.pop(0))

    def _complete(self, iteration: int, messages: Mapping[int, Message]) -> bool:
        """Whether every process that runs this iteration has reported it."""
        return bool(messages) and all(
            number in messages or (end is not None and end <= iteration)
            for number, end in enumerate(self._ended)
        )

    def _all_states_of(self, iteration: int) -> bool:
        return all(
            iteration in states or end is not None
            for states, end in zip(self._states, self._ended, strict=True)
        )

    def _save(self, iteration: int, logs: dict[str, int]) -> None:
        """A checkpoint of all members at (the start of) an iteration, or at their end before it."""
        arrays: dict[str, np.ndarray] = {}
        for states in self._states:
            arrays |= states[iteration if iteration in states else max(states)]
            for old in [key for key in states if key < iteration and key != max(states)]:
                del states[old]
        checkpoint.save_checkpoint(
            self._run.path / "checkpoints",
            iteration,
            arrays,
            {**self._run.manifest(), "logs": logs},
            self._run.config.keep_checkpoints,
        )

    def _write_rows(self, rows: list[dict[str, Any]], timings: list[dict[str, float]]) -> None:
        seconds = max(timing["seconds"] for timing in timings)
        steps = sum(timing["env_steps"] for timing in timings)
        timing = {
            "iteration": self._iteration,
            "env_steps": steps,
            "seconds": seconds,
            "collect_seconds": max(timing["collect_seconds"] for timing in timings),
            "steps_per_second": steps / seconds,
        }
        _append(self._run.path / "metrics.jsonl", rows)
        _append(self._run.path / "timing.jsonl", [timing])
        self._tensorboard.write(rows, timing)

    def _write_summary(self, complete: bool) -> None:
        last: dict[str, dict[str, Any]] = {}
        for row in rundir.rows(self._run.path):
            last[row["member"]] = row
        kept = ("arm", "seed", "env_steps", "kept_steps", "episodes", "return_mean",
                "return_mean_reported", "explained_variance")  # fmt: skip
        summary = {
            name: {key: row[key] for key in kept if key in row} for name, row in last.items()
        }
        text = "return_mean: mean training return (sampled actions) of the last 100 episodes"
        rundir.write_json(self._run.path / "summary.json", {"complete": complete, "metric": text, "members": summary})
        self._display.summary(summary)


def _append(path: Path, rows: list[dict[str, Any]]) -> None:
    with path.open("a") as file:
        file.writelines(json.dumps(row, allow_nan=False) + "\n" for row in rows)


@contextmanager
def _signals(handle: Callable[[int], None]) -> Iterator[None]:
    """SIGINT and SIGTERM go to `handle`; in another thread than the main one nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda n, frame: handle(n)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
