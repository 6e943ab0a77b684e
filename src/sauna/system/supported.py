"""The systems that SAUNA runs on."""

from __future__ import annotations

import os
import platform

from sauna.system.errors import SaunaError


def check_system() -> None:
    """Refuses a system without POSIX processes, pipes and locks.

    Raises:
      SaunaError: this is neither Linux nor macOS.
    """
    if os.name != "posix":
        raise SaunaError(
            f"{platform.system()} is not supported: SAUNA runs on Linux and macOS, and on Windows "
            "inside WSL"
        )
