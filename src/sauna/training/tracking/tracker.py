"""What a tracker is: five calls, each of which does nothing unless it is overridden."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple


class TrackedRun(NamedTuple):
    """What a tracker gets to know of a run.

    Attributes:
      path: the run directory, absolute.
      project: of `--track-project`.
      members: the settings of each member, as JSON values, with its name, arm and seed.
      before: what `open` returned when the run began; empty for a run that is new to the tracker.
    """

    path: Path
    project: str
    members: dict[str, dict[str, Any]]
    before: dict[str, Any]

    @property
    def note(self) -> str:
        """Says where the run's own files are."""
        return f"run directory: {self.path}"


class Tracker:
    """Takes the numbers of one run elsewhere. Make a subclass, and name it as `module:Class`.

    It runs in the process that writes the run. An exception in it ends the tracking, and not the
    training: one line says so.
    """

    def open(self, run: TrackedRun) -> dict[str, Any]:
        """Opens the run, or opens it again if `run.before` is not empty.

        Returns:
          JSON values by which it finds the run again, kept in the run's `tracking.json`;
          `{"urls": {member: url}}` in it also go to `summary.json`.
        """
        return {}

    def row(self, row: Mapping[str, Any]) -> None:
        """Takes a row of `metrics.jsonl`, and `steps_per_second` and `wall_seconds` with it."""

    def picture(self, name: str, path: Path) -> None:
        """Takes a figure of the whole run, a PNG file."""

    def summary(self, members: Mapping[str, Mapping[str, Any]], complete: bool) -> None:
        """Takes the final numbers of each member, as in `summary.json`."""

    def close(self) -> None:
        """Ends the tracking; called last, and after a failure, too."""


def scalars(row: Mapping[str, Any]) -> dict[str, float]:
    """The numbers of a row that belong into a chart over `env_steps`."""
    found = {name: value for name, value in row.items() if isinstance(value, float)}
    found |= {name: row[name] for name in ("kept_steps", "episodes") if name in row}
    if returns := row.get("episode_returns"):
        found["episode_return"] = sum(returns) / len(returns)
    return found
