"""SAUNA's own quantity, known instead of predicted."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_choice, check_share, count_of, largest
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def vex_oracle(setup: SamplerSetup, share: float = 0.5, keep: str = "high") -> Sampler:
    """Keeps the `ceil(share M)` rows by their share of the explained variance, `1 - e^2 / Var(R)`.

    `keep` is `high`, `low`, or `both` (half at each end, the odd one at the high end). `e = R - V`
    is known once the rollout is complete: whether this helps says whether SAUNA's idea or its
    prediction fails. If the returns do not vary, every share is 0.
    """
    check_share(share)
    check_choice("keep", keep, ("high", "low", "both"))
    count = count_of(share, setup.rows)
    high = {"high": count, "low": 0, "both": (count + 1) // 2}[keep]

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        present, number = samples.present, jnp.sum(samples.present)
        mean = jnp.sum(samples.return_ * present) / number
        variance = jnp.sum((samples.return_ - mean) ** 2 * present) / number
        explained = jnp.where(
            variance > 0, 1.0 - samples.error**2 / jnp.where(variance > 0, variance, 1.0), 0.0
        )
        top = largest(explained, high, present)
        kept = top | largest(-explained, count - high, present & ~top)
        wanted = {"high": explained, "low": -explained}.get(keep, kept.astype(jnp.float32))
        return state, Choice(keep=kept, score=wanted)

    return Sampler(lambda: (), choose, share=share)
