"""What a rule's choice of rows means for a recurrent policy, whose minibatches are of sequences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.losses import Minibatch, scale_of_kept
from sauna.algorithm.learner.sequences import as_rows, flat, in_sequences, joined, to_sequences
from sauna.algorithm.learner.update import Parts, acts_on_mean, minibatch_advantage, vex_targets
from sauna.algorithm.types import Array, Batch, Choice, Draw, Rollout


def choice_of_sequences(choice: Choice, batch: Batch, rollout: Rollout, length: int) -> Choice:
    """What a choice of rows `[T * N]` means for sequences `[K]`, as far as draws read it.

    A sequence is kept if one of its rows is. It is drawn with the sum of its rows' probabilities.
    """
    sequence_of = to_sequences(batch, rollout, length)

    def total(probability: Any) -> Any:
        return None if probability is None else jnp.sum(sequence_of(probability), 1)

    return Choice(
        keep=None if choice.keep is None else jnp.any(sequence_of(choice.keep), 1),
        probability=total(choice.probability),
        value_probability=total(choice.value_probability),
    )


def rows_of_sequences(x: Array, batch: Batch, rollout: Rollout, length: int) -> Array:
    """Numbers of sequences `[K]` at each of their samples `[T * N]`."""
    spread = jnp.broadcast_to(x[:, None], (len(x), length))
    return joined(spread, rollout.reward.shape[1]).ravel()[batch.row]


def minibatches_of_sequences(
    batch: Batch,
    choice: Choice,
    drawn: Draw,
    rollout: Rollout,
    value_probability: Any,
    *,
    parts: Parts,
) -> Callable[[Array, Array], Minibatch]:
    """A function that makes the minibatch of one gradient step; see `selected.minibatch`.

    A row of a sequence that was drawn counts by its share of the sequence's probability: its terms
    then have the mean that drawing rows by those probabilities gives.

    Args:
      drawn: of sequences.
      value_probability: `[T * N]` by which value rows of their own are drawn; None: there are none.
    """
    config, length = parts.config, parts.config.sequence_length
    sequence_of = to_sequences(batch, rollout, length)
    whole, for_all = in_sequences(batch, rollout, length), config.selection_losses == "all"
    if choice.probability is None:
        counted = whole.weight * sequence_of(choice.keep)
        weight = counted if for_all else whole.weight
    else:
        counted = weight = whole.weight * _shares(sequence_of(choice.probability))
    value_weight = None
    if value_probability is not None:
        value_weight = whole.weight * _shares(sequence_of(value_probability))
    scale = None if choice.weight is None else sequence_of(choice.weight)
    scales_values = for_all and choice.value_weight is not None
    value_scale = sequence_of(choice.value_weight) if scales_values else None

    def rows_of(index: Array, weight: Array) -> Batch:
        part = jax.tree.map(lambda x: x[index], whole)
        if part.next_weight is not None:
            part = part._replace(next_weight=part.next_weight * weight)
        return as_rows(part._replace(weight=part.weight * weight))

    def make(places: Array, counts: Array) -> Minibatch:
        index, value_index = drawn.rows[places], drawn.value_rows[places]
        there = counts[:, None]
        rows = rows_of(index, weight[index] * there)
        value_rows = rows
        if value_weight is not None:
            value_rows = rows_of(value_index, value_weight[value_index] * there)
        mask, mean_scale = flat(counted[index] * there), None
        if choice.keep is not None and acts_on_mean(parts):
            mask, mean_scale = rows.weight, scale_of_kept(mask, rows.weight)
        return Minibatch(
            rows=rows,
            value_rows=value_rows,
            advantage=minibatch_advantage(rows._replace(weight=mask), config),
            vex_target=vex_targets(value_rows, parts.target),
            policy_mask=mask,
            policy_scale=None if scale is None else flat(scale[index]),
            value_mask=value_rows.weight,
            value_scale=None if value_scale is None else flat(value_scale[value_index]),
            mean_scale=mean_scale,
        )

    return make


def _shares(probability: Array) -> Array:
    """Each row's share of its sequence's probability `[K, L]`."""
    total = jnp.sum(probability, 1, keepdims=True)
    return jnp.where(total > 0, probability / jnp.where(total > 0, total, 1.0), 0.0)
