"""One unit of a study, as a process: trains or resumes a run and reports its progress.

    python -m sauna.experiments.study.execute.unit_process < settings

The first line of standard input holds the settings as JSON. Each line of standard output is a JSON
object: rows of progress, or an error. The end of standard input means that the study is gone: the
iteration is finished, the state saved, and the process ends.

Where the run is made elsewhere than it is kept, `elsewhere` among the settings holds `recorded`,
what its config has to name instead, and `folder`, which only we can remove if our parent is gone.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any, TextIO

from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.config.stored import to_stored
from sauna.config.trust import covers
from sauna.system import run_directory
from sauna.system.errors import Interrupted, SaunaError
from sauna.training import run as runs
from sauna.training.train import train_run

PATIENCE = 300.0  # seconds that a run may still be locked by a process that is ending
SHOWN = (
    "seed",
    "env_steps",
    "kept_steps",
    "return_mean",
    "eval_return_mean",
    "keep_rate",
    "sample_rate",
)


class LineDisplay:
    """A display whose reader is a program."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def say(self, text: str) -> None:
        if not text.startswith("note:"):  # the study says those once, before it trains
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


def train(overrides: dict[str, Any], elsewhere: dict[str, Any], display: LineDisplay) -> None:
    """Starts the run, or continues it where it is.

    With `until` among the overrides, it pauses at the start of that iteration.
    """
    overrides = dict(overrides)
    until = overrides.pop("until", None)
    path, deadline = Path(overrides["out"]), time.monotonic() + PATIENCE
    while True:
        resume = (path / "config.json").exists()
        try:
            if resume:  # also where it was begun on another machine, for this study
                trust = covers(overrides, run_directory.read_config(path))
                run = runs.reopen(path, {}, display, trust)
            else:
                run = runs.start(overrides, display)
            break
        except (
            run_directory.InUse
        ):  # by a unit of a study that was killed: it is about to save and end
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)
    if elsewhere:
        _record(run, elsewhere["recorded"], resume)
    train_run(run, display, resume=resume, until=until)


def _record(run: runs.Run, recorded: dict[str, Any], resume: bool) -> None:
    """Notes place, revision and seal of the study's machine, where the run is kept."""
    stored = run_directory.read_config(run.path)
    if not resume:
        run.prepared = run.prepared._replace(run=run.prepared.run.replace(out=recorded["out"]))
        stored |= {**to_stored(run.prepared.run), "git": recorded["git"]}
    run_directory.write_config(run.path, {**stored, "seal": recorded["seal"]})


def main() -> int:
    parent = os.getppid()
    overrides = json.loads(sys.stdin.readline())
    elsewhere = overrides.pop("elsewhere", {})
    threading.Thread(target=_stop_with_the_study, daemon=True).start()
    # What an environment or a library prints must not mix with our lines: it goes to the log.
    display = LineDisplay(os.fdopen(os.dup(1), "w"))
    os.dup2(2, 1)
    try:
        train(overrides, elsewhere, display)
    except Interrupted as error:
        return 128 + error.signal_number
    except SaunaError as error:
        traceback.print_exception(error)
        display.send({"error": str(error)})
        return 1
    finally:
        if elsewhere and os.getppid() != parent:
            shutil.rmtree(elsewhere["folder"], ignore_errors=True)
    return 0


def _stop_with_the_study() -> None:
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
