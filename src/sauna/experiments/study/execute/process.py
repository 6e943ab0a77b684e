"""A unit's process, seen from outside: started, listened to, asked to stop."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sauna.system.safe_write import open_grown

Message = dict[str, Any]


class UnitProcess:
    """A unit's process (`unit_process.py`), or another module that speaks the same protocol.

    Args:
      overrides: the settings of the unit.
      log: what it prints besides its messages is appended there.
      receive: is called, in a thread of its own, with each message, and with None at the end.
      environment: of the process; by default ours.
      module: what it runs.
    """

    def __init__(
        self,
        overrides: Mapping[str, Any],
        log: Path,
        receive: Callable[[Message | None], None],
        environment: Mapping[str, str] | None = None,
        module: str = "sauna.experiments.study.execute.unit_process",
    ) -> None:
        with open_grown(log) as file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
                env=environment,
                start_new_session=True,  # a terminal's Ctrl-C is the study's to handle
            )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(overrides) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # its end is noticed when its output ends
        threading.Thread(target=self._listen, args=(receive,), daemon=True).start()

    def _listen(self, receive: Callable[[Message | None], None]) -> None:
        assert self._process.stdout is not None
        try:
            for line in self._process.stdout:
                try:
                    receive(json.loads(line))
                except ValueError:
                    continue  # printed by something else, before the unit took its output over
        finally:
            receive(None)

    def stop(self) -> None:
        """Lets it finish its iteration and save; may be called again."""
        stdin = self._process.stdin
        if stdin is not None and not stdin.closed:
            try:
                stdin.close()
            except BrokenPipeError:
                pass

    def kill(self) -> None:
        """Ends it at once; what it saved last stays."""
        self._process.kill()

    def end(self) -> str:
        """Waits for its end and returns how it ended."""
        return f"its process ended with exit code {self._process.wait()}"
