"""Minibatches drawn by the size of the advantage."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_range, check_share
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples

FLOOR = 1e-6  # so that a row of advantage 0 can be drawn


def prioritized(
    setup: SamplerSetup, power: float = 0.8, correction: float = 0.2, share: float = 1.0
) -> Sampler:
    """Draws by `p = (|A| + 1e-6)^power / sum`, with replacement.

    The policy term of a row is multiplied by `w = (M p)^-b`, divided by `sum(p w)`: the mean weight
    of a draw is 1, so that the policy loss keeps its size beside the value loss and the entropy
    bonus. These two are not weighted, and are means over rows drawn by p. `b` rises from
    `correction` to 1 over the budget. At b = 1 the policy term has the mean of all rows, and
    `sum(p w)` is 1 by itself.
    Source: PufferLib 3, after Schaul et al. 2016. PufferLib does not divide, works on segments of
    64 steps, draws without replacement, and its `b` never reaches 1. Schaul et al. divide by the
    largest weight, which is that of the row of |A| nearest 0: the policy loss is then as good as
    gone beside the others.
    """

    check_range("power", power, 0.0)
    check_range("correction", correction, 0.0, 1.0)
    check_share(share)

    def choose(count: Array, samples: Samples, key: Array) -> tuple[Array, Choice]:
        size = (jnp.abs(samples.advantage) + FLOOR) ** power * samples.present
        p = size / jnp.sum(size)
        progress = jnp.minimum(count / max(setup.iterations - 1, 1), 1.0)
        b = correction + (1.0 - correction) * progress
        number = jnp.sum(samples.present)
        weight = jnp.where(samples.present, (number * jnp.where(p > 0, p, 1.0)) ** -b, 0.0)
        return count + 1, Choice(probability=p, weight=weight / jnp.sum(p * weight), score=size)

    return Sampler(lambda: jnp.int32(0), choose, share=share)
