"""The quantile form of advantage filtering."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_range, check_share, count_of, largest
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def top_advantage(setup: SamplerSetup, share: float = 0.5, leak: float = 0.0) -> Sampler:
    """Keeps the `ceil(share M)` rows of largest `|A|`, and a random share `leak` of the others.

    Advantages are raw. They are standardised over the whole rollout before the choice
    (`normalize_over=rollout`): the mean of the kept is not 0, and subtracting it would flip signs
    near it.
    """
    check_share(share)
    check_range("leak", leak, 0.0, 1.0)
    count = count_of(share, setup.rows)

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        size = jnp.abs(samples.advantage)
        keep = largest(size, count, samples.present)
        if leak:
            leaked = jax.random.uniform(key, size.shape) < leak
            keep |= leaked & samples.present
        return state, Choice(keep=keep, score=size)

    return Sampler(lambda: (), choose, share=1.0 if leak else share)
