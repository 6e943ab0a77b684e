"""AVEC: a critic that learns differences of values instead of values."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.types import Array


def avec(error: Array, weight: Array) -> Array:
    """Half of the variance of the errors over a minibatch: `0.5 (mean(e^2) - mean(e)^2)`.

    `e = R - V`. The half keeps `value_coef` in the meaning it has for PPO's squared error. The
    value is not clipped. The mean of V is not learned: `unbiased` puts it right before it is used.
    Source: Flet-Berliac et al. 2021, arXiv 2010.04440.

    Args:
      error, weight: `[B]`.
    """
    number = jnp.maximum(jnp.sum(weight), 1.0)
    mean = jnp.sum(error * weight) / number
    return 0.5 * (jnp.sum(error**2 * weight) / number - mean**2)


def unbiased(advantage: Array, of_constant: Array, weight: Array) -> Array:
    """The constant c that makes `mean(R - V)` 0 if `V + c` takes the place of V, `[]`.

    Advantages are linear in c: `A(V + c) = A(V) + c A1`, `A1` the advantages of a value that is 1
    everywhere under rewards of 0.

    Args:
      advantage: `A(V)`, of_constant: `A1`, weight: `[S, N]`.
    """
    slope = jnp.sum(of_constant * weight)
    safe = jnp.where(slope == 0, 1.0, slope)
    return jnp.where(slope == 0, 0.0, -jnp.sum(advantage * weight) / safe)
