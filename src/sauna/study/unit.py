"""One unit of a study, as a process: trains or resumes a run and tells its progress.

    python -m sauna.study.unit < settings

The first line of standard input holds the settings as JSON. Each line of standard output is a JSON
object: rows of progress, or an error. The end of standard input means that the study is gone: the
iteration is finished, the state saved, and the process ends.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any, TextIO

from sauna import run as runs
from sauna.config import Config
from sauna.errors import Interrupted, SaunaError
from sauna.presets import Member

SHOWN = ("seed", "env_steps", "kept_steps", "return_mean", "keep_rate")


class LineDisplay:
    """A display whose reader is a program."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def say(self, text: str) -> None:
        self.send({"said": text})

    def open(
        self, config: Config, members: list[Member], path: Path, rows: list[dict[str, Any]]
    ) -> None:
        last = {row["member"]: row for row in rows}
        self.send({"resumed": [_shown(row) for row in last.values()]})

    def phase(self, process: int, text: str) -> None:
        self.send({"phase": text})

    def rows(self, rows: list[dict[str, Any]]) -> None:
        self.send({"rows": [_shown(row) for row in rows]})

    def refresh(self) -> None:
        pass

    def summary(self, members: dict[str, dict[str, Any]]) -> None:
        pass

    def close(self) -> None:
        pass

    def send(self, message: dict[str, Any]) -> None:
        try:
            self._out.write(json.dumps(message) + "\n")
            self._out.flush()
        except BrokenPipeError:
            pass  # the study is gone; the end of standard input stops us


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    return {key: row[key] for key in SHOWN if key in row}


def train(given: dict[str, Any], display: LineDisplay) -> None:
    """Starts the run, or continues it where it is."""
    path = Path(given["out"])
    resume = (path / "config.json").exists()
    run = runs.reopen(path, {}, display) if resume else runs.start(given, display)
    runs.train(run, display, resume=resume)


def main() -> int:
    given = json.loads(sys.stdin.readline())
    threading.Thread(target=_stop_with_the_study, daemon=True).start()
    # What an environment or a library prints must not mix with our lines: it goes to the log.
    display = LineDisplay(os.fdopen(os.dup(1), "w"))
    os.dup2(2, 1)
    try:
        train(given, display)
    except Interrupted as error:
        return 128 + error.signal_number
    except SaunaError as error:
        display.send({"error": str(error)})
        return 1
    return 0


def _stop_with_the_study() -> None:
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
