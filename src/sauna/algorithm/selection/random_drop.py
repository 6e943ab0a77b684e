"""Dropping at random: a control."""

from __future__ import annotations

import jax

from sauna.algorithm.types import Array, Hypers, ScoredStep, StepFilter


def random_drop() -> StepFilter:
    """Drops each step with probability `drop_rate`, whatever the head says: a control."""

    def keep(
        state: tuple[()], step: ScoredStep, key: Array, hypers: Hypers
    ) -> tuple[tuple[()], Array]:
        return state, jax.random.uniform(key, step.vex.shape) >= hypers.drop_rate

    return StepFilter(lambda num_envs, capacity: (), keep)
