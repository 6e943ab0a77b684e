"""One arm on one task, as the summary of a study sees it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sauna.config.controls import rule_of
from sauna.experiments.statistics import MAX_FAILED

__all__ = ["MAX_FAILED", "Cell", "is_control_among"]


class Cell(NamedTuple):
    """One arm on one task: its members that are complete, and how many are not."""

    task: str
    label: str
    arm: str
    baseline: str | None  # the label that it is compared with
    complete: list[dict[str, Any]]
    failed: int
    running: int
    waiting: int
    rates_of: str | None = None  # of a control of 0.1.0: the label whose drop rates it repeated
    config: Mapping[str, Any] = MappingProxyType({})  # empty where only numbers were stored
    command: str = ""  # that trains it

    def values(self, name: str) -> np.ndarray:
        """Returns the finite values of a member's entry `name`, over complete members."""
        found = np.array([member.get(name) for member in self.complete], float)
        return found[np.isfinite(found)]

    def scores(self) -> np.ndarray:
        """Returns final returns as the tests take them: a failed member has the worst outcome,
        -inf."""
        return np.concatenate([self.values("final_return"), np.full(self.failed, -np.inf)])

    @property
    def too_many_failed(self) -> bool:
        """Returns whether more than `MAX_FAILED` of the members that ended have failed."""
        return self.failed > MAX_FAILED * (self.failed + len(self.complete))

    def mean(self, name: str) -> float | None:
        values = self.values(name)
        return float(values.mean()) if len(values) else None


def is_control_among(cell: Cell, cells: Sequence[Cell]) -> bool:
    """Returns whether a cell is the matched control of another one's rule: `gigaflow+random`."""
    return rule_of(cell.arm) in {other.arm for other in cells}
