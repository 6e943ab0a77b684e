"""How far an evaluation is."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sauna.algorithm.rollout.play import Episode

QUIET = 10.0  # seconds without a word, after which an evaluation says how far it is


class Progress:
    """Says how far an evaluation is, if nothing was said for a while; counts cut episodes."""

    def __init__(self, name: str, episodes: int, say: Callable[[str], None]) -> None:
        self._name, self._episodes, self._say = name, episodes, say
        self._episode, self._steps, self.cut = 0, -1, 0
        self._last = time.monotonic()

    def step(self) -> None:
        """After a reset, and after each env step."""
        self._steps += 1
        if time.monotonic() - self._last > QUIET:
            self._last = time.monotonic()
            self._say(
                f"{self._name}: episode {self._episode + 1} of {self._episodes}, "
                f"{self._steps} env steps"
            )

    def played(self, episode: Episode) -> Episode:
        self._episode, self._steps, self.cut = self._episode + 1, -1, self.cut + episode.cut
        return episode

    def say_cut(self, max_steps: int) -> None:
        """At the end: says how many episodes had not ended."""
        if self.cut:
            how_many = f"{self.cut} of {self._episodes} episodes"
            self._say(f"{self._name}: {how_many} were cut after {max_steps} steps")
