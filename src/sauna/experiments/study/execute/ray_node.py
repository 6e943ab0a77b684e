"""What runs inside a Ray cluster: one task per unit, and the hub through which it talks.

A task trains its unit in a temporary directory of its node, and sends rows of progress and changed
files to the hub, from where the study takes them. When Ray starts a task again, because its node or
process was lost, it begins by asking for the files that had arrived. Nothing here imports JAX, and
no disk is shared.
"""

from __future__ import annotations

import asyncio
import os
import platform
import queue
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sauna import __version__
from sauna.experiments.study.execute.process import Message, UnitProcess
from sauna.experiments.study.execute.ray_files import Changes, Tracker, checkpoints, write

SECONDS = 0.5  # between what a task says
BACKLOG = 1000  # what the hub holds before tasks have to wait for the study


class Said(NamedTuple):
    """What the task of the unit `name` said."""

    name: str
    begins: bool
    messages: list[Message]
    changes: Changes | None


class Hub:
    """An actor between tasks and the study: only the study knows the files, only tasks change them.

    A unit's task may be started again while the old one, cut off, still runs: what the old one says
    is dropped, and it is asked to stop.
    """

    def __init__(self) -> None:
        self._said: asyncio.Queue[Said] = asyncio.Queue(BACKLOG)
        self._attempts: dict[str, int] = {}
        self._answers: dict[str, asyncio.Future[dict[str, bytes] | None]] = {}
        self._stopping = False
        self._enough: set[str] = set()

    async def begin(self, name: str) -> tuple[int, dict[str, bytes] | None]:
        """Returns to a task its attempt and the files to begin with; None if it should not
        begin."""
        self._attempts[name] = attempt = self._attempts.get(name, 0) + 1
        answer = self._answers[name] = asyncio.get_running_loop().create_future()
        await self._said.put(Said(name, True, [], None))
        return attempt, await answer

    async def say(
        self, name: str, attempt: int, messages: list[Message], changes: Changes | None
    ) -> bool:
        """Returns to a task whether to stop."""
        if attempt != self._attempts[name]:
            return True
        if messages or changes is not None:
            await self._said.put(Said(name, False, messages, changes))
        return self._stopping or name in self._enough

    async def take(self, seconds: float) -> list[Said]:
        """Returns to the study every message, after `seconds` at the latest."""
        try:
            taken = [await asyncio.wait_for(self._said.get(), seconds)]
        except TimeoutError:
            return []
        while not self._said.empty():
            taken.append(self._said.get_nowait())
        return taken

    async def answer(self, name: str, files: dict[str, bytes] | None) -> None:
        """Sets for the study what a task begins with."""
        answer = self._answers.pop(name, None)
        if answer is not None and not answer.done():
            answer.set_result(files)

    async def stop(self) -> None:
        """Asks every task to finish its iteration and save."""
        self._stopping = True

    async def stop_one(self, name: str) -> None:
        """Asks the task of one unit to finish its iteration and save."""
        self._enough.add(name)


def run_unit(hub: Any, name: str, overrides: dict[str, Any], recorded: dict[str, Any]) -> str:
    """Trains or continues a unit.

    Args:
      hub: the actor.
      name: of the unit.
      overrides: the settings of its run on the study's machine.
      recorded: what its config says of the study's machine: `out`, `git` and `seal`.

    Returns:
      how it ended: a reason only if its run is not complete.
    """
    import ray

    attempt, files = ray.get(hub.begin.remote(name))
    if files is None:
        return "it is not to begin: all stops, or it has trained enough"
    with tempfile.TemporaryDirectory(prefix="sauna-", ignore_cleanup_errors=True) as folder:
        place = Path(folder)
        write(place, files)
        unit = overrides | {"out": str(place / "run")}
        unit["elsewhere"] = {"recorded": recorded, "folder": folder}
        return _train(place, unit, lambda *said: ray.get(hub.say.remote(name, attempt, *said)))


def _train(place: Path, overrides: dict[str, Any], say: Callable[..., bool]) -> str:
    """Runs the unit's process to its end; `say(messages, changes)` answers whether to stop."""
    tracker, newest = Tracker(place), checkpoints(place)[-1:]
    heard: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
    process = UnitProcess(overrides, place / "stderr.txt", heard.put, _environment())
    error: str | None = None
    how: str | None = None
    try:
        while how is None:
            messages, ended = _listen(heard)
            how = process.end() if ended else None
            changes = None
            if ended or checkpoints(place)[-1:] != newest:
                changes = tracker.changes()
                newest = changes.checkpoints[-1:]
            error = next((m["error"] for m in messages if "error" in m), error)
            if say(messages, changes):
                process.stop()
        return error or how
    finally:
        process.stop()
        process.end()


def _listen(heard: queue.SimpleQueue[Message | None]) -> tuple[list[Message], bool]:
    """What is heard within `SECONDS`, and whether that was the end."""
    messages: list[Message] = []
    until = time.monotonic() + SECONDS
    try:
        while (left := until - time.monotonic()) > 0:
            message = heard.get(timeout=left)
            if message is None:
                return messages, True
            messages.append(message)
    except queue.Empty:
        pass
    return messages, False


def _environment() -> dict[str, str]:
    """Ours; what can be imported here can be imported by the unit too, but for Ray's own parts."""
    import ray

    parts = (part or os.getcwd() for part in sys.path)
    path = [part for part in parts if not part.startswith(os.path.dirname(ray.__file__))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path)}


def version() -> tuple[str, str]:
    """Returns the machine's name and this package's version."""
    return platform.node(), __version__
