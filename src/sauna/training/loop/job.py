"""What one process trains, and where it reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from sauna.algorithm.learner.metrics import UpdateMetrics
from sauna.algorithm.types import Array, Hypers, Keys
from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.system.errors import SaunaError

Arrays = dict[str, np.ndarray]


class NonFinite(SaunaError):
    """A loss or a parameter is not finite any more."""


class Reporter(Protocol):
    """Where the loop's messages go, and where its permissions come from."""

    def phase(self, text: str) -> None:
        """Reports what is done now."""

    def allowance(self, iteration: int) -> int:
        """Waits until `iteration` may start; returns how many may from there on. 0: stop."""

    def stopped(self) -> set[str]:
        """Names the members that a callback has stopped; right after `allowance`."""

    def iteration(self, iteration: int, rows: list[dict[str, Any]], timing: dict[str, Any]) -> None:
        """Reports a finished iteration."""

    def state(self, iteration: int, arrays: Arrays) -> None:
        """Reports the state of all members at the start of an iteration."""


class Job(NamedTuple):
    """What one process trains; `Prepared.job` makes it."""

    config: Config
    spaces: Spaces
    env_kwargs: dict[str, Any]
    members: list[Member]
    restored: Mapping[str, np.ndarray] | None = None  # a checkpoint's arrays; None: start afresh
    initial: Mapping[str, np.ndarray] | None = None  # of trained members, to start afresh from
    start: int = 0  # the first iteration to run
    replay: bool = True  # whether environments can be brought back by replaying


def check_finite(member: Member, iteration: int, metrics: UpdateMetrics) -> None:
    """Refuses an update that gave a number which is not finite.

    Raises:
      NonFinite: naming the member and the iteration.
    """
    if not metrics.finite:
        raise NonFinite(f"{member.name}: the update of iteration {iteration} is not finite")


class Setting(NamedTuple):
    """What stays constant for a member on the device."""

    keys: Keys
    hypers: Hypers  # with the learning rate before its schedule
    steps: Array  # [] int32, the budget
