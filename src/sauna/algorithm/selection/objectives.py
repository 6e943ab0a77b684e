"""Forms of the policy term in place of PPO's clipped surrogate.

Each takes `(log_ratio [B], advantage [B], clip_range)` and gives the term to minimise `[B]`.
"""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.types import Array


def unclipped(log_ratio: Array, advantage: Array, clip_range: Array) -> Array:
    """`-A r`: importance sampling without a clip; meant to be used with a stop rule."""
    return -advantage * jnp.exp(log_ratio)


def spo(log_ratio: Array, advantage: Array, clip_range: Array) -> Array:
    """`-(A r - |A| (r - 1)^2 / (2 eps))`: a penalty in place of the clip.

    Its optimum over r is `1 + eps sign(A)`, where the clip's gradient ends. Source: Xie et al.
    2024, arXiv 2401.16025.
    """
    ratio = jnp.exp(log_ratio)
    return -(advantage * ratio - jnp.abs(advantage) * (ratio - 1.0) ** 2 / (2.0 * clip_range))
