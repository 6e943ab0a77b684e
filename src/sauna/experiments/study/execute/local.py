"""Running the units of a study on this machine: one process per core, until none is left."""

from __future__ import annotations

import queue

from sauna.experiments.study.execute.executor import Executor
from sauna.experiments.study.execute.process import Message, UnitProcess
from sauna.experiments.study.units import Unit
from sauna.system.safe_write import own_folder


class LocalExecutor(Executor):
    """Runs units in `jobs` processes at a time."""

    def _open(self) -> None:
        self._messages: queue.SimpleQueue[tuple[str, Message | None]] = queue.SimpleQueue()
        self._processes: dict[str, UnitProcess] = {}
        self._errors: dict[str, str] = {}

    def _start(self, unit: Unit) -> None:
        place, name = own_folder(self._folder / unit.name), unit.name
        self._processes[name] = UnitProcess(
            unit.overrides(self._folder),
            place / "stderr.txt",
            lambda message: self._messages.put((name, message)),
        )

    def _pump(self) -> None:
        try:
            name, message = self._messages.get(timeout=0.2)
            while True:
                if message is None:
                    how = self._processes.pop(name).end()
                    self._end(name, self._errors.pop(name, how))
                else:
                    if "error" in message:
                        self._errors[name] = message["error"]
                    self._view.progress(self._running[name], message)
                name, message = self._messages.get_nowait()
        except queue.Empty:
            return

    def _stop_all(self) -> None:
        for process in self._processes.values():
            process.stop()

    def _stop_one(self, name: str) -> None:
        self._processes[name].stop()

    def _close(self) -> None:
        self._stop_all()
        for process in self._processes.values():
            if self._hurry:
                process.kill()
            process.end()
