"""Dropping at random: a control."""

from __future__ import annotations

import jax

from sauna.algorithm.types import Array, Filter, Hypers


def random_drop() -> Filter:
    """Drops each step with probability `drop_rate`, whatever the head says: a control."""

    def keep(
        state: tuple[()], observation: Array, vex: Array, key: Array, hypers: Hypers
    ) -> tuple[tuple[()], Array]:
        return state, jax.random.uniform(key, vex.shape) >= hypers.drop_rate

    return Filter(lambda num_envs, capacity: (), keep)
