"""What one member collected in one iteration, whoever collected it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from sauna.algorithm.types import Rollout
from sauna.config.settings import Config


class Episode(NamedTuple):
    """One finished episode of a member."""

    env: int
    return_: float
    length: int
    truncated: bool
    kept: bool  # whether its last step was kept (the released code reports only such episodes)


class Collected(NamedTuple):
    """What one member collected in one iteration."""

    rollout: Rollout | None  # None: it never left the accelerator
    env_steps: int
    kept_steps: int
    ended: int  # episodes that ended
    return_mean: float  # over all of them; NaN if there are none
    length_mean: float
    episodes: list[Episode]  # the latest of them; on the host all
    info: Mapping[str, float]  # means over all that gave the number in their last `info`


def capacity(config: Config) -> int:
    """Env steps per env (S) that one rollout can hold."""
    if config.filter == "none" or config.dropped == "mask":
        return config.rollout_steps
    return config.rollout_steps * config.max_env_steps_factor


def chunk_sizes(rollout_steps: int) -> list[int]:
    """Lengths that segments are padded to, rising: T, and T over powers of 4 down to 32."""
    sizes = [rollout_steps]
    while sizes[0] >= 128:
        sizes.insert(0, -(-sizes[0] // 4))
    return sizes
