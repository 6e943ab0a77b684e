"""Tracebacks of a user's own code: kept whole, carried between processes, shown in part.

A message to a user is one line. What led to it is the exception's cause, in this process or, as
text, from another one.
"""

from __future__ import annotations

import itertools
import site
import sysconfig
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.system.errors import SaunaError

_PACKAGE = str(Path(__file__).resolve().parent.parent)
_NUMBERS = itertools.count()
_HELD: dict[int, BaseException] = {}  # exceptions of workers that are threads of this process


class WorkerTraceback(Exception):
    """The traceback of an exception in another process, as text.

    Attributes:
      frames: the part of it that is the user's own code.
    """

    def __init__(self, text: str, frames: str) -> None:
        super().__init__("\n" + text)
        self.frames = frames


def describe_failure(error: BaseException, in_process: bool) -> dict[str, Any]:
    """What a message says of an exception beside its one line; `cause_of` reads it.

    Args:
      in_process: the reader is a thread of this process, which gets the exception itself.
    """
    described: dict[str, Any] = {
        "traceback": "".join(traceback.format_exception(error)),
        "frames": user_frames(error),
    }
    if in_process:
        described["held"] = next(_NUMBERS)
        _HELD[described["held"]] = error
    return described


def cause_of(failure: Mapping[str, Any]) -> BaseException | None:
    """The exception behind a failure that was described, or its traceback; None: neither."""
    kept_error = _HELD.pop(failure.get("held", -1), None)
    if kept_error is not None:
        return kept_error.__cause__ if isinstance(kept_error, SaunaError) else kept_error
    if not failure.get("traceback"):
        return None
    return WorkerTraceback(failure["traceback"], failure.get("frames", ""))


def user_frames(error: BaseException) -> str:
    """The frames of an exception and its causes that are the user's code, as Python prints them.

    Empty where no code of a user's has part in it.
    """
    parts: list[str] = []
    now: BaseException | None = error
    while now is not None:
        if isinstance(now, WorkerTraceback):
            parts.insert(0, now.frames)
        elif not isinstance(now, SaunaError):
            parts.insert(0, _own_frames(now))
        now = now.__cause__ or (None if now.__suppress_context__ else now.__context__)
    return "\n".join(part.rstrip("\n") for part in parts if part)


def _own_frames(error: BaseException) -> str:
    frames = [f for f in traceback.extract_tb(error.__traceback__) if is_users(f.filename)]
    if not frames:
        return ""
    return "".join(traceback.format_list(frames)) + f"{type(error).__qualname__}: {error}"


def is_users(file: str) -> bool:
    """Whether a source file is a user's: neither ours, nor Python's, nor an installed package's."""
    return not file.startswith(("<", _PACKAGE, *_installed_places()))


def _installed_places() -> list[str]:
    paths = sysconfig.get_paths()
    return [
        *(paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")),
        *site.getsitepackages(),
        site.getusersitepackages(),
    ]
