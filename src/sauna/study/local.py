"""Running the units of a study on this machine: one process per core, until none is left."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from sauna import rundir
from sauna.rundir import write_json
from sauna.study.units import Unit, mark_split, needs_split, parts, split

ATTEMPTS = 2  # a failed unit is tried once more


class View(Protocol):
    """Where the progress of units is shown."""

    def progress(self, unit: Unit, message: dict[str, Any]) -> None: ...
    def ended(self, unit: Unit, error: str | None) -> None: ...
    def refresh(self) -> None: ...


class _Running(NamedTuple):
    unit: Unit
    process: subprocess.Popen[str]


class LocalExecutor:
    """Runs units in `jobs` processes at a time.

    Args:
      folder: where the units' folders are.
      jobs: processes at a time.
      view: is told of progress.
      stopping: whether to end; running units then finish their iteration and save.
    """

    def __init__(self, folder: Path, jobs: int, view: View, stopping: Callable[[], bool]) -> None:
        self._folder, self._jobs, self._view, self._stopping = folder, jobs, view, stopping
        self._messages: queue.SimpleQueue[tuple[str, dict[str, Any] | None]] = queue.SimpleQueue()
        self._running: dict[str, _Running] = {}
        self._errors: dict[str, str] = {}
        self._attempts: dict[str, int] = {}

    def run(self, units: list[Unit]) -> None:
        """Runs every unit that is neither complete nor failed; returns when all are, or stopped."""
        everything = [part for unit in units for part in parts(unit, self._folder)]
        waiting = [unit for unit in everything if not self._is_over(unit)]
        try:
            while waiting or self._running:
                if self._stopping():
                    waiting = []
                    self._tell_to_stop()
                self._fill(waiting)
                self._pump(waiting)
                self._view.refresh()
        finally:
            self._tell_to_stop()
            for running in self._running.values():
                running.process.wait()

    def _is_over(self, unit: Unit) -> bool:
        return unit.is_complete(self._folder) or unit.error(self._folder) is not None

    def _fill(self, waiting: list[Unit]) -> None:
        """Starts units until every job has one, or none is ready."""
        for unit in list(waiting):
            if len(self._running) >= self._jobs:
                return
            if unit.name in self._running:  # another label's, of the same settings
                continue
            if self._is_over(unit):
                waiting.remove(unit)
            elif needs_split(unit, self._folder):
                self._split(unit, waiting)
            elif self._source_failed(unit):
                waiting.remove(unit)
                self._give_up(unit, "the arm whose drop rates it repeats failed")
            elif unit.source is None or self._is_ready(unit.source):
                waiting.remove(unit)
                self._start(unit)

    def _is_ready(self, source: str) -> bool:
        return rundir.is_complete(self._folder / source / "run")

    def _source_failed(self, unit: Unit) -> bool:
        return unit.source is not None and (self._folder / unit.source / "failed.json").exists()

    def _start(self, unit: Unit) -> None:
        (self._folder / unit.name).mkdir(parents=True, exist_ok=True)
        log = (self._folder / unit.name / "stderr.txt").open("a")
        process = subprocess.Popen(
            [sys.executable, "-m", "sauna.study.unit"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,  # a terminal's Ctrl-C is the study's to handle
        )
        log.close()
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(unit.given(self._folder)) + "\n")
            process.stdin.flush()
        except BrokenPipeError:
            pass  # its end is noticed when its output ends
        self._running[unit.name] = _Running(unit, process)
        threading.Thread(target=self._listen, args=(unit.name, process), daemon=True).start()

    def _listen(self, name: str, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self._messages.put((name, json.loads(line)))
        self._messages.put((name, None))

    def _pump(self, waiting: list[Unit]) -> None:
        """Handles what has arrived within a moment."""
        try:
            name, message = self._messages.get(timeout=0.2)
            while True:
                if message is None:
                    self._end(self._running.pop(name), waiting)
                else:
                    if "error" in message:
                        self._errors[name] = message["error"]
                    self._view.progress(self._running[name].unit, message)
                name, message = self._messages.get_nowait()
        except queue.Empty:
            return

    def _end(self, running: _Running, waiting: list[Unit]) -> None:
        unit, code = running.unit, running.process.wait()
        if unit.is_complete(self._folder):
            self._view.ended(unit, None)
        elif not self._stopping():
            error = self._errors.pop(unit.name, f"its process ended with exit code {code}")
            self._attempts[unit.name] = self._attempts.get(unit.name, 0) + 1
            if self._attempts[unit.name] < ATTEMPTS:
                waiting.insert(0, unit)
            elif len(unit.seeds) > 1:
                self._split(unit, waiting)
            else:
                self._give_up(unit, error)

    def _split(self, unit: Unit, waiting: list[Unit]) -> None:
        mark_split(unit, self._folder)
        place = waiting.index(unit) if unit in waiting else 0
        waiting[place : place + (unit in waiting)] = split(unit, self._folder)

    def _give_up(self, unit: Unit, error: str) -> None:
        (self._folder / unit.name).mkdir(parents=True, exist_ok=True)
        write_json(self._folder / unit.name / "failed.json", {"error": error})
        self._view.ended(unit, error)

    def _tell_to_stop(self) -> None:
        for running in self._running.values():
            if running.process.stdin is not None and not running.process.stdin.closed:
                try:
                    running.process.stdin.close()
                except BrokenPipeError:
                    pass
