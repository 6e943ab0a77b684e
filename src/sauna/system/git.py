"""What git says of a folder."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

EDITED = "+changes"  # ends a revision whose files are not as committed
FAILURES = (OSError, subprocess.SubprocessError)  # no git, no repository, or no answer in time


def ask(folder: str | Path, *arguments: str) -> str:
    """Asks git, without a lock in the way of the user's commands, or a hook's variables.

    Raises:
      OSError, SubprocessError: git is missing, refuses, or takes too long.
    """
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=5, env=env)
    return done.stdout.strip()
