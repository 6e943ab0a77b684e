"""From a rule's choice to the rows of each minibatch.

A choice marks rows to keep, or gives probabilities to draw by. How many rows that is may be known
only while the program runs; the arrays have a static length `K = ceil(share * M)` all the same.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array, Choice, Draw


def draw(choice: Choice, permutation: Array, key: Array, length: int) -> Draw:
    """Draws the rows of one epoch.

    Rows to keep come in the permutation's order. Rows with probabilities are drawn with
    replacement, `length` of them.

    Args:
      choice: of `M` rows.
      permutation: `[M]` int32.
      length: K, at least as many as a choice keeps.
    """
    number = jnp.int32(length)
    if choice.probability is None:
        index, number = kept_in_order(choice.keep, permutation)
        index, number = index[:length], jnp.minimum(number, length)
    else:
        index = by_probability(choice.probability, jax.random.uniform(key, (length,)))
    value_index = index
    if choice.value_probability is not None:
        other = jax.random.uniform(jax.random.fold_in(key, 1), (length,))
        value_index = by_probability(choice.value_probability, other)
    return Draw(index, value_index, number)


def kept_in_order(keep: Array, permutation: Array) -> tuple[Array, Array]:
    """Puts the kept rows first, in the order of a permutation of all rows or of that many of them.

    Returns:
      as many rows as the permutation has, and how many of them are kept.
    """
    length = len(permutation)
    if length == len(keep):
        return kept_first(keep, permutation)
    rows, number = kept_first(keep, jnp.arange(len(keep), dtype=permutation.dtype))
    number = jnp.minimum(number, length)
    places, _ = kept_first(jnp.arange(length) < number, permutation)
    return rows[places], number


def kept_first(keep: Array, permutation: Array) -> tuple[Array, Array]:
    """Puts the kept rows before the others, each group in the permutation's order.

    Two sums instead of a sort, which takes long on a CPU.

    Returns:
      the rows `[M]` and how many of them are kept.
    """
    kept = keep[permutation].astype(jnp.int32)
    number = jnp.sum(kept)
    before = jnp.cumsum(kept) - kept  # kept rows in front of each
    place = jnp.where(kept > 0, before, number + jnp.arange(len(keep)) - before)
    return jnp.zeros_like(permutation).at[place].set(permutation), number


def by_probability(probability: Array, uniform: Array) -> Array:
    """Draws rows `[K]` by the inverse of the distribution function, from uniform numbers `[K]`."""
    total = jnp.cumsum(probability)
    found = jnp.searchsorted(total, uniform * total[-1], side="right")
    return jnp.minimum(found, len(probability) - 1).astype(jnp.int32)


def minibatch_size(mode: str, full: int, minibatches: int, length: int) -> int:
    """Gives the rows of one minibatch; `full` is PPO's own size.

    `length` rows that do not fill whole minibatches of PPO's size are shared out evenly, so that
    hardly a row goes through the network only to fill the last one.
    """
    if mode == "smaller":
        return math.ceil(length / minibatches)
    return math.ceil(length / math.ceil(length / full)) if mode == "fewer" else full


def minibatch_count(mode: str, number: Array, size: int, minibatches: int) -> Array:
    """Gives the gradient steps of one epoch that has drawn `number` rows; none for 0 rows."""
    if mode == "fewer":
        return (number + size - 1) // size
    if mode == "smaller":
        return jnp.minimum(number, minibatches)
    return jnp.where(number > 0, minibatches, 0)


def minibatch_places(
    mode: str, i: Array, number: Array, size: int, minibatches: int
) -> tuple[Array, Array]:
    """Gives the places `[size]` of minibatch `i` among the rows drawn, and which of them count.

    | mode | minibatches | a minibatch |
    |---|---|---|
    | `fewer` | as many as the rows fill | at most PPO's size; the last is filled from the front |
    | `smaller` | as many as without a rule, at most one a row | an equal share of the rows |
    | `refill` | as many as without a rule | PPO's size; the rows are gone through again |
    """
    inside = jnp.arange(size)
    if mode == "smaller":
        pieces = jnp.clip(number, 1, minibatches)
        first, last = i * number // pieces, (i + 1) * number // pieces
        return jnp.minimum(first + inside, number - 1), first + inside < last
    return (i * size + inside) % jnp.maximum(number, 1), jnp.ones(size, bool)


def effective_size(weight: Array) -> Array:
    """Counts the equal weights that would vary as much: `(sum w)^2 / sum w^2` (Kish 1965)."""
    square = jnp.sum(weight**2)
    return jnp.where(square > 0, jnp.sum(weight) ** 2 / jnp.where(square > 0, square, 1.0), 0.0)
