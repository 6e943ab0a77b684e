"""The command line as a test runs it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from helpers import SMALL, environment
from sauna.config.settings import flag


def sauna(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sauna", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=environment(),
    )


def small_flags(**changes: object) -> list[str]:
    return [f"{flag(k)}={v}" for k, v in {**SMALL, **changes}.items()]
