"""Iterations that learn from nothing: said at the first one, and an end to the run at the tenth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from sauna.system.errors import SaunaError

MAX_EMPTY = 10  # iterations in a row


class EmptyUpdates:
    """Counts, for each member, the iterations in a row whose update had no sample."""

    def __init__(self) -> None:
        self._empty: Counter[str] = Counter()
        self._said: set[str] = set()

    def see(self, rows: Iterable[Mapping[str, Any]]) -> list[str]:
        """Takes in an iteration's rows; returns a warning for each member's first empty update.

        Raises:
          SaunaError: a member has had `MAX_EMPTY` of them in a row.
        """
        warnings = []
        for row in rows:
            member = row["member"]
            if row["keep_rate"] > 0 and row.get("gradient_steps", 1) > 0:
                self._empty[member] = 0
                continue
            self._empty[member] += 1
            if member not in self._said:
                self._said.add(member)
                warnings.append(
                    f"warning: {member}: the rule kept no sample of iteration {row['iteration']}, "
                    f"or stopped its update at once, so nothing was learned from it"
                )
            if self._empty[member] == MAX_EMPTY:
                raise SaunaError(
                    f"{member}: the rule kept no sample in {MAX_EMPTY} iterations in a row, or "
                    f"stopped their updates at once; change its threshold, or leave it out"
                )
        return warnings
