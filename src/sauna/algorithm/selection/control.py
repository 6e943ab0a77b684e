"""Matched controls: as many rows as a rule takes in this iteration, chosen without its idea."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from sauna.algorithm.selection.draws import kept_first
from sauna.algorithm.selection.scores import largest, ranks
from sauna.algorithm.types import Array, Choice, LossTerms, LossWeight, Sampler, Samples
from sauna.system.errors import BadInput

MAX_STRIDE_ROWS = 65_535  # whose squares fit into uint32


def matched(
    kind: str, keep: Array, score: Array, advantage: Array, eligible: Array, noise: Array
) -> Array:
    """Marks as many eligible rows `[M]` as `keep` does.

    | kind | rows |
    |---|---|
    | `random` | those of smallest `noise` |
    | `stride` | every k-th: rows `floor(i E / count)` of the E eligible ones |
    | `low-advantage` | those of smallest `|A|` |
    | `reversed` | those of smallest `score`; `noise` decides between equal ones |
    """
    count = jnp.sum(keep, dtype=jnp.int32)
    if kind == "random":
        return largest(-noise, count, eligible)
    if kind == "low-advantage":
        return largest(-jnp.abs(advantage), count, eligible)
    if kind == "reversed":
        shuffled = jnp.argsort(noise)  # ranks break ties by the row: rows in random order
        chosen = largest(-score[shuffled], count, eligible[shuffled])
        return jnp.zeros_like(keep).at[shuffled].set(chosen)
    place = (jnp.cumsum(eligible) - 1).astype(jnp.uint32)
    number = jnp.sum(eligible).astype(jnp.uint32)
    many = jnp.maximum(count, 1).astype(jnp.uint32)
    first = (place * many + number - 1) // number  # the least i with i E / count >= place
    return eligible & (first < count) & (first * number < (place + 1) * many)


def controlled(kind: str, sampler: Sampler) -> Sampler:
    """A sampler that asks another how many rows it takes, and takes as many by `kind`.

    Of a rule that draws by probabilities, `random` draws evenly and unweighted, `reversed` gives
    the row of rank i the probability and weight of rank M - 1 - i; the others keep the share K / M.
    """

    def choose(state: Any, samples: Samples, key: Array) -> tuple[Any, Choice]:
        state, choice = sampler.choose(state, samples, key)
        if kind == "reversed" and choice.score is None:
            raise BadInput("control: reversed needs a sampler whose choice has a score")
        noise = jax.random.uniform(jax.random.fold_in(key, 2), samples.present.shape)
        present = samples.present
        if choice.probability is None:
            keep = matched(kind, choice.keep, choice.score, samples.advantage, present, noise)
            return state, Choice(keep=keep, score=choice.score)
        if kind == "reversed":
            return state, _reversed_probabilities(choice, present)
        even = present / jnp.sum(present)
        if kind == "random":
            return state, Choice(probability=even, score=choice.score)
        asked = jnp.arange(len(noise)) < jnp.ceil(sampler.share * jnp.sum(present))
        keep = matched(kind, asked, choice.score, samples.advantage, present, noise)
        return state, Choice(keep=keep, score=choice.score)

    return sampler._replace(choose=choose)


def _reversed_probabilities(choice: Choice, present: Array) -> Choice:
    def reversed_ranks(value: Array | None, score: Array) -> Array | None:
        if value is None:
            return None
        rank = ranks(score, present)
        by_rank = jnp.zeros_like(value).at[rank].set(value)
        return jnp.where(present, by_rank[jnp.sum(present) - 1 - rank], 0.0)

    value_p = choice.value_probability
    return Choice(
        probability=reversed_ranks(choice.probability, choice.score),
        weight=reversed_ranks(choice.weight, choice.score),
        value_probability=reversed_ranks(value_p, value_p) if value_p is not None else None,
        value_weight=reversed_ranks(choice.value_weight, value_p) if value_p is not None else None,
        score=choice.score,
    )


def controlled_weight(kind: str, rule: LossWeight) -> LossWeight:
    """A loss weight whose values are given to other rows of the minibatch.

    A minibatch's rows stand in random order, so that each row gets a random one's weight if it gets
    that of the present row before it. `reversed` gives the largest weight to the row that had the
    smallest.
    """

    def weight(terms: LossTerms) -> tuple[Array, Array]:
        mask, scale = rule.weight(terms)
        if kind == "reversed":
            rank = ranks(scale * mask, terms.present > 0)
            last = jnp.sum(terms.present > 0).astype(jnp.int32) - 1
            turn: Callable[[Array], Array] = lambda x: (  # noqa: E731
                jnp.zeros_like(x).at[rank].set(x)[jnp.maximum(last - rank, 0)]
            )
            return turn(mask) * terms.present, turn(scale)
        present = terms.present > 0
        rows, number = kept_first(present, jnp.arange(len(present), dtype=jnp.int32))
        before = rows[(jnp.cumsum(present) - 2) % jnp.maximum(number, 1)]
        return mask[before] * terms.present, scale[before]

    return rule._replace(weight=weight)


def controlled_filter(kind: str, keep: Array, advantage: Array, valid: Array, key: Array) -> Array:
    """As many steps of each env as a filter kept, `[S, N]`, chosen by `kind`; the first is kept.

    The filter decides while the rollout is collected, so that its control has the same env steps.
    `reversed` takes the steps that the filter dropped, and others at random if those are too few.
    """
    noise = jax.random.uniform(key, keep.shape)
    first = jnp.arange(len(keep)) == 0

    def column(keep: Array, advantage: Array, valid: Array, noise: Array) -> Array:
        rest = valid & ~first
        score = keep.astype(jnp.float32)
        chosen = matched(kind, keep & ~first, score, advantage, rest, noise)
        return chosen | (keep & first)

    return jax.vmap(column, in_axes=1, out_axes=1)(keep, advantage, valid, noise)
