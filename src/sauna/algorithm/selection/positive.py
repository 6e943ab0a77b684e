"""Only what went better than expected."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def cut_at_zero(advantage: Array, weight: Array) -> Array:
    """`max(0, A) / (std(A) + 1e-8)`, not centred; the std is that of the uncut advantages.

    Source: Jesson et al. 2023, arXiv 2306.01460.
    """
    number = jnp.maximum(jnp.sum(weight), 1.0)
    mean = jnp.sum(advantage * weight) / number
    variance = jnp.sum((advantage - mean) ** 2 * weight) / number
    return jnp.maximum(advantage, 0.0) / (jnp.sqrt(variance) + 1e-8)


def positive(setup: SamplerSetup) -> Sampler:
    """Keeps the rows with `A > 0`: the subset form of the same idea.

    With `selection_losses=policy` the critic learns from all rows.
    """

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        keep = (samples.advantage > 0) & samples.present
        return state, Choice(keep=keep, score=samples.advantage)

    return Sampler(lambda: (), choose)
