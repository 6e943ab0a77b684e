"""One episode with a frozen policy and a frozen normaliser."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from sauna.envs.host.answers import one_number, reset_with
from sauna.experiments.evaluate import MAX_STEPS

QUIET = 10.0  # seconds without a word, after which an evaluation says how far it is


class Episode(NamedTuple):
    """One episode as it was played."""

    return_: float  # of raw rewards
    length: int  # env steps
    cut: bool  # whether it had not ended


def play(
    policy: Callable[..., Any],
    env: Any,
    deterministic: bool,
    seed: int,
    watch: Callable[[], None] = lambda: None,
    max_steps: int = MAX_STEPS,
) -> Episode:
    """One episode, cut after `max_steps` env steps.

    Args:
      policy: `policy(observation, deterministic=..., key=...)` gives what the environment takes.
      watch: called after the reset and after each env step.
    """
    import jax

    key = jax.random.key(seed)
    observation = reset_with(env, seed)
    watch()
    return_, length, ended = 0.0, 0, False
    while not ended and length < max_steps:
        step_key = None if deterministic else jax.random.fold_in(key, length)
        action = policy(observation, deterministic=deterministic, key=step_key)
        observation, reward, terminated, truncated, _ = env.step(action)
        return_, length = return_ + one_number(reward), length + 1
        ended = bool(terminated or truncated)
        watch()
    return Episode(return_, length, not ended)


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
