"""What several rules share: ranks, counts, and the mask of the rows that score highest."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array


def count_of(share: float, rows: int) -> int:
    """Rounds up: `ceil(share * rows)`, at least 1; a float product's last bit does not count."""
    return min(rows, max(1, math.ceil(share * rows - 1e-6)))


def ranks(score: Array, eligible: Array) -> Array:
    """Ranks rows `[M]` from 0, the largest score first; where scores tie, the lower row first.

    Rows that are not eligible come last.
    """
    order = jnp.argsort(jnp.where(eligible, -score, jnp.inf), stable=True)
    return jnp.zeros(len(score), jnp.int32).at[order].set(jnp.arange(len(score), dtype=jnp.int32))


def largest(score: Array, count: int | Array, eligible: Array) -> Array:
    """Marks the `count` eligible rows of largest score; where scores tie, the lower rows.

    If the count is static, no full sort is needed.
    """
    if not isinstance(count, int):
        return (ranks(score, eligible) < count) & eligible
    _, found = jax.lax.top_k(jnp.where(eligible, score, -jnp.inf), count)
    return jnp.zeros(len(score), bool).at[found].set(True) & eligible
