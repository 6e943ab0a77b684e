"""A program's working folder, whatever a user's environment makes of it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def kept_folder() -> Iterator[None]:
    """Leaves the working folder as it was; also a decorator."""
    before = os.getcwd()
    try:
        yield
    finally:
        os.chdir(before)
