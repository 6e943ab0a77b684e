"""The workers of a run: granting iterations, and writing what they send in a fixed order.

Workers run freely, but at most `LEAD` iterations ahead of the slowest, so that all can be stopped
at the same iteration. Rows go to `metrics.jsonl` iteration by iteration and member by member, and
a checkpoint is saved once every member has sent its state: the files do not depend on how members
are shared over processes.
"""

from __future__ import annotations

import contextlib
import copy
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.checks import has_room, local_parts
from sauna.config.settings import Config
from sauna.system import checkpoint, run_directory, watchdog
from sauna.system.errors import BadInput, Interrupted, SaunaError, one_line, warn
from sauna.system.jax_setup import ON_CPU
from sauna.system.logs import Logs, check_logs
from sauna.system.metrics_csv import MetricsCsv, trained_seconds
from sauna.system.processes import Message, Worker, receive, start_thread, start_worker
from sauna.system.safe_write import replace_file
from sauna.system.signals import handled
from sauna.system.tracebacks import cause_of
from sauna.system.watchdog import Watchdog
from sauna.training.display import Display
from sauna.training.empty_updates import EmptyUpdates
from sauna.training.info_names import InfoNames
from sauna.training.run import Run, resume_command
from sauna.training.summary import METRIC, STOPS, summarize
from sauna.training.tracking.trackers import Trackers
from sauna.training.worker import serve, write_job

# Sees a row of `metrics.jsonl`; its member stops if it returns True.
Callback = Callable[[dict[str, Any]], bool | None]


class CallbackRaised(Exception):
    """Carries what the user's callback raised past those who would take it for an error of ours."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


LEAD = 2  # iterations that a process may be ahead of the slowest one
SECONDS_AHEAD = 2.0  # on the device, where a call runs several: what a signal may have to wait
MAX_LEAD = 64


class Coordinator:
    """The workers of one run and what they have sent but is not yet written.

    Args:
      initial: what a new run starts from, with `init_from`.
      tracked: for each member the env steps up to which its rows were tracked before.
      callback: see `Callback`.
      draw: draws a figure of the run at its end; None if there is nothing to draw.
      until: the iteration at whose start the run pauses; None: it goes on to its end.
    """

    def __init__(
        self,
        run: Run,
        display: Display,
        loaded: checkpoint.Checkpoint | None,
        initial: Mapping[str, np.ndarray],
        inexact: bool,
        tracked: Mapping[str, int],
        callback: Callback | None,
        draw: Callable[[Path], Path | None] | None,
        until: int | None = None,
    ) -> None:
        self._run, self._display = run, display
        self._callback, self._draw, self._until = callback, draw, until
        self._stopped: dict[str, int] = {}  # by the callback: member, the iteration after its last
        self._iteration = loaded.manifest["iteration"] if loaded else 0
        self._parts = np.array_split(np.arange(len(run.members)), run.config.processes)
        self._rows: dict[int, dict[int, Message]] = {}
        self._states: list[dict[int, dict[str, np.ndarray]]] = [{} for _ in self._parts]
        self._reached = [self._iteration] * len(self._parts)
        self._ended: list[int | None] = [None] * len(self._parts)
        self._logs, self._csv = Logs(run.path), MetricsCsv(run.path, display.say)
        self._clock = time.monotonic() - trained_seconds(run.path)
        self._due: list[tuple[int, dict[str, Any]]] = []  # checkpoints waiting for their states
        self._lead, self._granted = LEAD, 0
        self._signal: int | None = None
        self._stopping = False
        self._empty_updates = EmptyUpdates()
        self._info_names = InfoNames(run_directory.rows(run.path))
        replay = not inexact and run.differs is None
        if loaded and not replay:
            display.say("warning: not an exact resume: every environment starts a new episode")
        given = loaded.arrays if loaded else initial
        self._workers = [self._start(p, given, loaded is not None, replay) for p in self._parts]
        self._watchdog = Watchdog(self._workers)
        done = tracked if replay else {}
        self._trackers = Trackers(run.path, run.config, run.members, display.say, done)

    def _start(
        self, part: np.ndarray, given: Mapping[str, np.ndarray], is_restored: bool, replay: bool
    ) -> Worker:
        run = self._run
        if local_parts(run.config):
            worker = start_thread(partial(serve, dies_alone=False))
        else:
            worker = start_worker("sauna.training.worker", _environment(run.config))
        names = [run.members[index].name for index in part]
        arrays = {
            key: value
            for key, value in given.items()
            if any(key.startswith(name + "/") for name in names)
        }
        header = write_job(
            run.prepared.run,
            run.spaces,
            [int(index) for index in part],
            self._iteration,
            replay,
            is_restored,
        )
        try:
            worker.send(header, arrays)
        except BrokenPipeError:
            pass  # its end is noticed, and named, when its inbox is read
        return worker

    def __enter__(self) -> Coordinator:
        return self

    def __exit__(self, *error: Any) -> None:
        """Ends all that was started; what fails in that hides neither an error nor a result."""
        seconds = 0.0 if error[0] else 5.0
        stops = [partial(worker.stop, seconds) for worker in self._workers]
        ends: list[Callable[[], None]] = [self._watchdog.close, *stops]
        for end in (*ends, self._trackers.close, self._display.close):
            try:
                end()
            except Exception as failure:
                warn(f"the training has ended, but not all of it cleanly: {one_line(failure)}")

    def run(self) -> None:
        """Trains to the end, or to where a signal stops it.

        Raises:
          Interrupted: a signal came; the state is saved.
          SaunaError: something failed; the last good checkpoint is on disk.
        """
        run = self._run
        self._display.open(run.config, run.members, run.path, run_directory.rows(run.path))
        with handled(self._on_signal):
            self._grant()
            self._trackers.open()  # while the workers compile
            while any(end is None for end in self._ended):
                self._pump()
            complete = self._signal is None and self._until is None
            arrays = self._save(self._last_iteration(), self._logs.counted())
            self._write_summary(complete, arrays)
        if self._draw is not None and (figure := self._draw(run.path)) is not None:
            self._trackers.picture(figure.stem, figure)
        if self._signal is not None:
            raise Interrupted(
                self._signal,
                f"stopped by {signal.Signals(self._signal).name} after iteration "
                f"{self._last_iteration()}; continue with: {resume_command(self._run.path)}",
            )

    def _last_iteration(self) -> int:
        return max(end for end in self._ended if end is not None)

    def _on_signal(self, number: int) -> None:
        """Notes the first signal, and no more: it may come in the middle of anything."""
        if self._signal is not None:
            raise Interrupted(
                number, f"stopped at once; continue with: {resume_command(self._run.path)}"
            )
        self._signal = number

    def _stop(self, number: int) -> None:
        """Lets every worker end at the iteration that is granted, which is the same for all."""
        self._stopping = True
        name = signal.Signals(number).name
        self._display.say(f"{name}: finishing the iteration, then saving (again to stop at once)")
        self._send_grant()

    def _grant(self) -> None:
        """Lets every worker run at most `self._lead` iterations ahead of the slowest."""
        running = [r for r, end in zip(self._reached, self._ended, strict=True) if end is None]
        if not running or self._stopping:
            return
        # With a callback, an iteration begins when it has seen all rows before.
        granted = self._iteration + 1 if self._callback else min(running) + self._lead
        if self._until is not None and granted >= self._until:
            granted, self._stopping = self._until, True
        if granted > self._granted or self._stopping:
            self._granted = granted
            self._send_grant()

    def _send_grant(self) -> None:
        for worker, end in zip(self._workers, self._ended, strict=True):
            if end is None:
                try:
                    stopped = sorted(self._stopped)
                    message = {"granted": self._granted, "stop": self._stopping}
                    worker.send(message | ({"stopped": stopped} if stopped else {}))
                except BrokenPipeError:
                    pass  # its end is noticed, and named, when its inbox is read

    def _pump(self) -> None:
        """Handles whatever has arrived within a moment, and shows it."""
        if self._signal is not None and not self._stopping:
            self._stop(self._signal)
        inboxes = {
            worker.inbox: number
            for number, worker in enumerate(self._workers)
            if self._ended[number] is None
        }
        with self._watchdog.listening():
            ready = wait(list(inboxes), timeout=0.1)
        for inbox in ready:
            number = inboxes[inbox]  # type: ignore[index]
            self._handle(number, self._receive(number))
        self._display.refresh()

    def _receive(self, number: int) -> Message:
        worker = self._workers[number]
        try:
            with self._watchdog.listening():
                message = receive(worker.inbox)
        except (EOFError, ConnectionResetError):
            code = worker.process.wait()
            how = f"ended with exit code {code}"
            if number in self._watchdog.hung:
                how = f"sent no heartbeat for {watchdog.MAX_SILENCE:g} s and was killed"
            raise SaunaError(
                f"training process {number} ({worker.process.pid}) {how}; the last good "
                f"checkpoint is kept, continue with: {resume_command(self._run.path)}"
            ) from None
        self._watchdog.heartbeat(number)
        return message

    def _handle(self, number: int, message: Message) -> None:
        header = message.header
        match header["kind"]:
            case "phase":
                self._display.phase(number, header["text"])
            case "iteration":
                self._rows.setdefault(header["iteration"], {})[number] = message
                self._reached[number] = header["iteration"] + 1
                if self._run.config.backend == "device":
                    self._lead = lead_for(header["timing"]["seconds"])
                self._display.rows(header["rows"])
                self._grant()
                self._flush()
            case "state":
                self._states[number][header["iteration"]] = message.arrays
                self._flush()
            case "failure":
                raise _failure(self._run.path, header)
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
                self._due.append((self._iteration, self._logs.counted()))
        while self._due and self._all_states_of(self._due[0][0]):
            self._save(*self._due.pop(0))
        if self._callback is not None:  # which has seen the rows that the next iteration waits for
            self._grant()

    def _complete(self, iteration: int, messages: Mapping[int, Message]) -> bool:
        """Returns whether every process that runs this iteration has reported it."""
        return bool(messages) and all(
            number in messages or (end is not None and end <= iteration)
            for number, end in enumerate(self._ended)
        )

    def _all_states_of(self, iteration: int) -> bool:
        return all(
            iteration in states or end is not None
            for states, end in zip(self._states, self._ended, strict=True)
        )

    def _save(self, iteration: int, logs: dict[str, Any]) -> dict[str, np.ndarray]:
        """Saves all members at (the start of) an iteration, or at their end before it."""
        arrays: dict[str, np.ndarray] = {}
        for states in self._states:
            arrays |= states[iteration if iteration in states else max(states)]
            for old in [key for key in states if key < iteration and key != max(states)]:
                del states[old]
        for name, end in self._stopped.items():
            if end <= iteration:
                arrays[f"{name}/counters/stopped"] = np.asarray(STOPS.index("callback"))
        checkpoint.save_checkpoint(
            self._run.path / "checkpoints",
            iteration,
            arrays,
            {**self._run.manifest(), **logs},
            self._run.config.keep_checkpoints,
        )
        return arrays

    def _write_rows(self, rows: list[dict[str, Any]], timings: list[dict[str, Any]]) -> None:
        seconds = max(timing["seconds"] for timing in timings)
        steps = sum(timing["env_steps"] for timing in timings)
        timing: dict[str, Any] = {
            "iteration": self._iteration,
            "env_steps": steps,
            "seconds": seconds,
            "steps_per_second": steps / seconds,
            "wall_seconds": round(time.monotonic() - self._clock, 3),
        }
        if all("collect_seconds" in timing for timing in timings):  # unknown on the device
            timing["collect_seconds"] = max(timing["collect_seconds"] for timing in timings)
            timing["collect_cpu_seconds"] = sum(t["collect_cpu_seconds"] for t in timings)
            timing["update_cpu_seconds"] = {
                member: seconds
                for t in timings
                for member, seconds in t["update_cpu_seconds"].items()
            }
        if all("cpu_seconds" in timing for timing in timings):  # on the device, by a CPU
            timing["cpu_seconds"] = {m: s for t in timings for m, s in t["cpu_seconds"].items()}
        if any("evaluation_seconds" in timing for timing in timings):
            timing["evaluation_seconds"] = max(t.get("evaluation_seconds", 0.0) for t in timings)
        warnings = [*self._empty_updates.see(rows), *map(self._info_names.admit, rows)]
        for warning in filter(None, warnings):
            self._display.say(warning)
        self._logs.append("metrics.jsonl", rows)
        self._logs.append("timing.jsonl", [timing])
        self._csv.append(rows, timing["wall_seconds"])
        clock = {name: timing[name] for name in ("steps_per_second", "wall_seconds")}
        self._trackers.rows(rows, clock)
        if self._callback is not None:
            self._call(self._callback, rows)

    def _call(self, callback: Callback, rows: list[dict[str, Any]]) -> None:
        """Shows each row to the user's callback, which may stop its member."""
        for row in rows:
            try:
                stops = callback(copy.deepcopy(row))
                if not isinstance(stops, bool | np.bool_ | None):
                    raise TypeError(
                        f"the callback returned a {type(stops).__name__}; True stops the member, "
                        f"False or None does not"
                    )
            except Exception as error:
                with contextlib.suppress(OSError):  # the exception counts more than its copy
                    replace_file(self._run.path / "failure.txt", traceback.format_exc().encode())
                error.add_note(
                    f"raised by the callback, at iteration {row['iteration']} of {row['member']}; "
                    f"continue from the last checkpoint with: {resume_command(self._run.path)}"
                )
                raise CallbackRaised(error) from error
            if stops and has_room(self._run.config, row["env_steps"], row["kept_steps"]):
                self._stopped.setdefault(row["member"], self._iteration + 1)

    def _write_summary(self, complete: bool, arrays: Mapping[str, np.ndarray]) -> None:
        check_logs(self._run.path, {"iteration": self._iteration, **self._logs.counted()})
        members = summarize(run_directory.rows(self._run.path), arrays)
        whole: dict[str, Any] = {"complete": complete, "metric": METRIC, "members": members}
        if self._trackers.urls:
            whole["tracking"] = self._trackers.urls
        run_directory.write_json(self._run.path / "summary.json", whole)
        self._csv.finish()
        self._trackers.summary(members, complete)
        self._display.summary(members)


def lead_for(seconds: float) -> int:
    """Counts the iterations to grant if one takes `seconds`: the device runs many in a call."""
    return int(min(max(SECONDS_AHEAD / max(seconds, 1e-6), LEAD), MAX_LEAD))


def _failure(run: Path, header: dict[str, Any]) -> SaunaError:
    """The error of a worker's last message; its whole traceback is kept in `failure.txt`."""
    cause = cause_of(header)
    if header.get("bad_input"):
        error: SaunaError = BadInput(header["message"])
    else:
        replace_file(run / "failure.txt", header.get("traceback", header["message"]).encode())
        where = f" (the whole traceback: {run / 'failure.txt'})" if header.get("frames") else ""
        error = SaunaError(header["message"] + where)
    error.__cause__ = cause
    return error


def _environment(config: Config) -> dict[str, str]:
    """Lists what a worker's JAX has to know before it is imported."""
    if config.device == "gpu":
        return {"JAX_PLATFORMS": "cuda"}
    return ON_CPU
