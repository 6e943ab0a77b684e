"""Where a policy is that somebody names, and where what is made of it goes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class Located(NamedTuple):
    """Folders of a policy.

    Attributes:
      folder: what is read.
      written: where evaluations and videos of it go.
    """

    folder: Path
    written: Path


def locate(run: str | Path) -> Located:
    """Finds a run or an exported policy.

    Args:
      run: its folder.
    """
    folder = Path.cwd() / run  # an environment may go elsewhere
    return Located(folder, folder)
