"""What a row's experiment found."""

from __future__ import annotations

from typing import Any, NamedTuple


class Result(NamedTuple):
    """Counts of one row.

    Attributes:
      tried: faults that were made.
      lost: after which something that had been saved was gone, or did not end as it must.
      silent: after which something was wrong without a message.
      worst: seconds that the slowest took; each row says of what.
      notes: further counts, by their names.
      failures: of the first few that went wrong, a line each.
    """

    tried: int
    lost: int
    silent: int
    worst: float
    notes: dict[str, Any]
    failures: list[str]


class Tally:
    """Counts up to a `Result`."""

    def __init__(self) -> None:
        self.tried, self.lost, self.silent, self.worst = 0, 0, 0, 0.0
        self.notes: dict[str, Any] = {}
        self.failures: list[str] = []

    def took(self, seconds: float) -> None:
        self.worst = max(self.worst, seconds)

    def count(self, name: str, number: int = 1) -> None:
        self.notes[name] = self.notes.get(name, 0) + number

    def lose(self, why: str) -> None:
        self.lost += 1
        self.failures.append(f"lost: {why}")

    def miss(self, why: str) -> None:
        self.silent += 1
        self.failures.append(f"silent: {why}")

    def result(self) -> Result:
        notes, few = dict(sorted(self.notes.items())), self.failures[:10]
        return Result(self.tried, self.lost, self.silent, round(self.worst, 3), notes, few)


def assert_held(result: Result, least: int) -> None:
    """What every row's test ends with."""
    assert result.tried >= least
    assert (result.lost, result.silent) == (0, 0), result.failures
