"""Signals that ask to stop, for as long as something runs that can be stopped in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sauna.system.errors import Interrupted


@contextmanager
def handled(handle: Callable[[int], None]) -> Iterator[None]:
    """SIGINT and SIGTERM go to `handle`; in another thread than the main one nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda n, frame: handle(n)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def noted() -> Iterator[list[int]]:
    """Notes the first signal, for what then stops in order; a second one stops it at once.

    Yields:
      the signal's number in a list, which is empty until it comes.

    Raises:
      Interrupted: a second signal came.
    """
    numbers: list[int] = []

    def note(number: int) -> None:
        if numbers:
            raise Interrupted(number, "stopped at once; running again continues")
        numbers.append(number)

    with handled(note):
        yield numbers
