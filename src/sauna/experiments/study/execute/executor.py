"""Which units of a study run when, how often, and what becomes of those that fail."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from sauna.experiments.study.units import Unit, mark_split, parts, split
from sauna.system import run_directory
from sauna.system.safe_write import own_folder

ATTEMPTS = 2  # a failed unit is continued once


class View(Protocol):
    """Where the progress of units is shown."""

    def started(self, unit: Unit) -> None: ...
    def progress(self, unit: Unit, message: dict[str, Any]) -> None: ...
    def stopped(self, unit: Unit) -> None: ...
    def ended(self, unit: Unit, error: str | None) -> None: ...
    def refresh(self) -> None: ...


def never(unit: Unit) -> bool:
    """Says of no unit that it has trained enough: each is trained to its end."""
    return False


class Executor(ABC):
    """Runs units, `jobs` at a time; a subclass says where.

    A unit that fails is continued once. If it fails again it is split into its seeds, each of which
    is trained once, as it is unknown which of them broke it; a seed alone that fails for good is
    noted in its `failed.json`.

    Args:
      folder: where the units' folders are.
      jobs: units at a time.
      view: receives the progress.
      stopping: whether to end; running units then finish their iteration and save.
      enough: whether a unit is over although it is not complete; one that runs then finishes its
        iteration and saves.
    """

    def __init__(
        self,
        folder: Path,
        jobs: int,
        view: View,
        stopping: Callable[[], bool],
        enough: Callable[[Unit], bool] = never,
    ) -> None:
        self._folder, self._jobs, self._view, self._stopping = folder, jobs, view, stopping
        self._enough = enough
        self._waiting: list[Unit] = []
        self._running: dict[str, Unit] = {}
        self._attempts: dict[str, int] = {}
        self._hurry = False  # something went wrong, or a second signal came: wait for no unit

    def run(self, units: list[Unit]) -> None:
        """Runs every unit that is neither complete nor failed; returns when all are, or stopped."""
        everything = [part for unit in units for part in parts(unit, self._folder)]
        self._waiting = [unit for unit in everything if not self._is_over(unit)]
        self._open()
        try:
            while self._waiting or self._running:
                if self._stopping():
                    self._waiting.clear()
                    self._stop_all()
                for name, unit in self._running.items():
                    if self._enough(unit):
                        self._stop_one(name)
                self._fill()
                self._pump()
                self._view.refresh()
        except BaseException:
            self._hurry = True
            raise
        finally:
            self._close()

    @abstractmethod
    def _open(self) -> None:
        """Makes what units are run with."""

    @abstractmethod
    def _start(self, unit: Unit) -> None:
        """Starts or continues the unit's run."""

    @abstractmethod
    def _pump(self) -> None:
        """Handles what has arrived within a moment; `_end` is called for each unit that ended."""

    @abstractmethod
    def _stop_all(self) -> None:
        """Lets every running unit finish its iteration and save; may be called again."""

    @abstractmethod
    def _stop_one(self, name: str) -> None:
        """Lets the running unit `name` finish its iteration and save; may be called again."""

    @abstractmethod
    def _close(self) -> None:
        """Leaves nothing behind that is still running."""

    def _is_over(self, unit: Unit) -> bool:
        failed = unit.error(self._folder) is not None
        return failed or unit.is_complete(self._folder) or self._enough(unit)

    def _fill(self) -> None:
        """Starts units until every job has one, or none waits."""
        waiting = self._waiting
        for unit in list(waiting):
            if len(self._running) >= self._jobs:
                return
            if unit.name in self._running:  # another label's, of the same settings
                continue
            if self._is_over(unit):
                waiting.remove(unit)
            else:
                waiting.remove(unit)
                self._running[unit.name] = unit
                self._view.started(unit)
                self._start(unit)

    def _end(self, name: str, error: str) -> None:
        """A unit is no longer running; `error` says why, if it is not complete."""
        unit = self._running.pop(name)
        self._view.stopped(unit)
        if unit.is_complete(self._folder):
            self._view.ended(unit, None)
        elif not self._stopping() and not self._enough(unit):
            self._attempts[name] = self._attempts.get(name, 0) + 1
            if self._attempts[name] < ATTEMPTS:
                self._waiting.insert(0, unit)
            elif len(unit.seeds) > 1:
                self._split(unit)
                self._attempts |= {single.name: ATTEMPTS - 1 for single in split(unit)}
            else:
                self._give_up(unit, error)

    def _split(self, unit: Unit) -> None:
        """Its seeds wait in its place; another label's unit of the same settings goes with it."""
        waiting = self._waiting
        mark_split(unit, self._folder)
        place = waiting.index(unit) if unit in waiting else 0
        waiting[place:place] = split(unit)
        waiting[:] = [other for other in waiting if other.name != unit.name]

    def _give_up(self, unit: Unit, error: str) -> None:
        own_folder(self._folder / unit.name)
        run_directory.write_json(self._folder / unit.name / "failed.json", {"error": error})
        self._view.ended(unit, error)
