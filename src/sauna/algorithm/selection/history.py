"""Earlier predictions of a rollout in rising order: their median and quantiles."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from sauna.algorithm.types import Array


class History(NamedTuple):
    """Earlier predictions in rising order, so that their median is a look-up."""

    ordered: Array  # [..., capacity + 1], +inf behind the first `number`
    number: Array  # [...] int32


def empty_history(lead: tuple[int, ...], capacity: int) -> History:
    return History(
        jnp.full((*lead, capacity + 1), jnp.inf, jnp.float32), jnp.zeros(lead, jnp.int32)
    )


def median(history: History) -> Array:
    """Median over the last axis; the mean of the middle two of an even number. 0 if empty."""
    low = jnp.maximum(history.number - 1, 0) // 2
    pair = jnp.stack([low, history.number // 2], -1)
    middle = jnp.take_along_axis(history.ordered, pair, -1)
    return jnp.where(history.number > 0, 0.5 * (middle[..., 0] + middle[..., 1]), 0.0)


def insert(history: History, x: Array) -> History:
    """`x` `[...]` put in its place: each slot becomes the middle of (left neighbour, x, itself)."""
    widths = [(0, 0)] * x.ndim + [(1, 0)]
    left = jnp.pad(history.ordered[..., :-1], widths, constant_values=-jnp.inf)
    ordered = jnp.maximum(left, jnp.minimum(history.ordered, x[..., None]))
    return History(ordered, history.number + 1)


def quantile(ordered: Array, number: Array, level: Array) -> Array:
    """The value that a further one of the same kind falls short of with the chance `level`.

    Among n + 1 values in random order each rank is as likely, so it is the one of rank
    `floor(level (n + 1))` of n, counted from 1: -inf for rank 0, +inf behind the last.

    Args:
      ordered: `[..., >= number]`, rising, +inf behind the first `number` `[...]`.
      level: `[...]`.
    """
    rank = jnp.floor(level * (number + 1)).astype(jnp.int32)
    place = jnp.clip(rank - 1, 0, ordered.shape[-1] - 1)
    found = jnp.take_along_axis(ordered, place[..., None], -1)[..., 0]
    return jnp.where(rank < 1, -jnp.inf, jnp.where(rank > number, jnp.inf, found))
