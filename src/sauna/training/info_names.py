"""How many names of numbers in `info` a run's rows may have: a bound, so that none can flood it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sauna.envs.info import INFO_PREFIX

MAX_NAMES = 32


class InfoNames:
    """The names that came first, `MAX_NAMES` of them, in the order of a run's rows.

    So a resumed run, whose rows begin with the same ones, has the same names.

    Args:
      rows: that the run has already.
    """

    def __init__(self, rows: Iterable[dict[str, Any]]) -> None:
        self._known: dict[str, None] = {}
        self._said = False
        for row in rows:
            self.admit(row)

    def admit(self, row: dict[str, Any]) -> str | None:
        """Takes the keys beyond the bound out of a row; returns a warning, once."""
        dropped = []
        for key in [key for key in row if key.startswith(INFO_PREFIX)]:
            if key not in self._known and len(self._known) == MAX_NAMES:
                dropped.append(key.removeprefix(INFO_PREFIX))
                del row[key]
            else:
                self._known[key] = None
        if not dropped or self._said:
            return None
        self._said = True
        return (
            f"warning: the environments' info has more than {MAX_NAMES} numbers; "
            f"{dropped[0]!r} and other later ones are left out of the metrics"
        )
