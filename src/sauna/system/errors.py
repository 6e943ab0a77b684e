"""What can go wrong, as types that the command line turns into exit codes."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SaunaError(Exception):
    """Something failed for a reason that can be named in one line (exit code 1)."""


class BadInput(SaunaError):
    """The user asked for something that cannot be done (exit code 2, nothing created)."""


class Interrupted(KeyboardInterrupt):
    """A signal stopped the run after its state was saved (exit code 128 + signal).

    It is no `Exception`: a loop over runs that goes on after one failed stops here.
    """

    def __init__(self, signal_number: int, message: str) -> None:
        super().__init__(message)
        self.signal_number = signal_number


def nearest(word: str, known: Iterable[str]) -> str:
    """`; did you mean X?` for the known word closest to `word`, or an empty string.

    Capitals are no difference; a word that shares little is not suggested.
    """
    spelled = {name.lower(): name for name in known}
    found = difflib.get_close_matches(word.lower(), list(spelled), n=1, cutoff=0.6)
    return f"; did you mean {spelled[found[0]]!r}?" if found else ""


def one_line(error: BaseException) -> str:
    """Type and message of somebody else's exception, in one line of bounded length."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def printable(text: str) -> str:
    """A text in one line, without characters that a terminal would act on."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
