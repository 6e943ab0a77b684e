"""The objective of eq. 6: clipped surrogate, value loss, entropy and Vex loss. A2C's: `a2c.py`.

All means are weighted: a slot with weight 0 (left empty, or masked by the filter) counts for
nothing. With every weight 1 they are plain means.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from sauna.algorithm.types import Array, Hypers


class Losses(NamedTuple):
    """Scalars of one minibatch; NaN where an algorithm has no such number."""

    total: Array
    policy_loss: Array
    value_loss: Array
    vex_loss: Array
    entropy: Array
    kl: Array
    clip_fraction: Array


def weighted_mean(x: Array, weight: Array) -> Array:
    """`sum(w x) / sum(w)` of `[B]` arrays; 0 where all weights are 0."""
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def standardize(advantage: Array, weight: Array) -> Array:
    """`(A - mean) / (std + 1e-8)` over a minibatch `[B]`, population std as in baselines."""
    centred = advantage - weighted_mean(advantage, weight)
    return centred / (jnp.sqrt(weighted_mean(centred**2, weight)) + 1e-8)


def surrogate(log_ratio: Array, advantage: Array, clip_range: Array) -> Array:
    """Eq. 3, negated: `max(-A r, -A clip(r, 1 - eps, 1 + eps))` for each sample `[B]`."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip_range, 1.0 + clip_range)
    return jnp.maximum(-advantage * ratio, -advantage * clipped)


def value_error(value: Array, old: Array, return_: Array, clip_range: Array | None) -> Array:
    """`0.5 * max((V - R)^2, (V_clipped - R)^2)` for each sample `[B]`, as in baselines.

    `clip_range` None leaves out the clipped branch.
    """
    error = (value - return_) ** 2
    if clip_range is not None:
        clipped = old + jnp.clip(value - old, -clip_range, clip_range)
        error = jnp.maximum(error, (clipped - return_) ** 2)
    return 0.5 * error


def weigh(
    policy_loss: Array, value_loss: Array, vex_loss: Array, entropy: Array, hypers: Hypers
) -> Array:
    """The total of eq. 6: `policy - c_ent * entropy + c1 * value + c2 * vex`."""
    total = policy_loss - hypers.entropy_coef * entropy
    return total + hypers.value_coef * value_loss + hypers.vex_coef * vex_loss


def combine(
    log_ratio: Array,
    advantage: Array,
    value_errors: Array,
    vex_error: Array,
    entropy: Array,
    weight: Array,
    hypers: Hypers,
) -> Losses:
    """PPO's losses, their total and what is logged beside it.

    The KL estimate is `mean((r - 1) - log r)` (Schulman's k3), of new against old policy.
    """
    log_ratio = jnp.where(weight > 0, log_ratio, 0.0)
    ratio = jnp.exp(log_ratio)
    policy_loss = weighted_mean(surrogate(log_ratio, advantage, hypers.clip_range), weight)
    value_loss = weighted_mean(value_errors, weight)
    vex_loss = weighted_mean(vex_error, weight)
    mean_entropy = weighted_mean(entropy, weight)
    total = weigh(policy_loss, value_loss, vex_loss, mean_entropy, hypers)
    kl = weighted_mean((ratio - 1.0) - log_ratio, weight)
    outside = (jnp.abs(ratio - 1.0) > hypers.clip_range).astype(ratio.dtype)
    return Losses(
        total, policy_loss, value_loss, vex_loss, mean_entropy, kl, weighted_mean(outside, weight)
    )
