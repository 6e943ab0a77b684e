"""Rules that end an iteration's updates early."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_range
from sauna.algorithm.types import Array, StopRule


def target_kl(limit: float = 0.02, factor: float = 1.5) -> StopRule:
    """Stops if the KL estimate `mean((r - 1) - log r)` of a minibatch exceeds `factor * limit`.

    The step of that minibatch is not taken. Source: Stable-Baselines3's `target_kl`, whose usual
    values are 0.01 to 0.03.
    """
    check_range("limit", limit, 0.0)
    check_range("factor", factor, 0.0)

    def exceeded(log_ratio: Array, weight: Array) -> Array:
        kl = jnp.exp(log_ratio) - 1.0 - log_ratio
        return jnp.sum(kl * weight) > factor * limit * jnp.maximum(jnp.sum(weight), 1.0)

    return StopRule(exceeded)


def espo(limit: float = 0.25) -> StopRule:
    """Stops if the mean `|r - 1|` of a minibatch reaches `limit`; meant for `objective=unclipped`.

    The step of that minibatch is not taken. Source: Sun et al. 2022, arXiv 2202.00079; their code
    measures after the step.
    """
    check_range("limit", limit, 0.0)

    def exceeded(log_ratio: Array, weight: Array) -> Array:
        deviation = jnp.abs(jnp.exp(log_ratio) - 1.0)
        return jnp.sum(deviation * weight) >= limit * jnp.maximum(jnp.sum(weight), 1.0)

    return StopRule(exceeded)
