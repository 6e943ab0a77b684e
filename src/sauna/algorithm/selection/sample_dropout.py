"""Sample dropout: terms whose ratio has gone far drop out."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_range
from sauna.algorithm.types import Array, LossTerms, LossWeight


def sample_dropout(deviation: float = 1.0) -> LossWeight:
    """Drops from each minibatch the policy terms with `|r - 1| >= deviation`; none left: all stay.

    1 is for use beside the clip, 0.25 without it (`objective=unclipped`). Value and entropy see
    every row. Source: Lin et al. 2023, arXiv 2302.02299.
    """
    check_range("deviation", deviation, 0.0)

    def weight(terms: LossTerms) -> tuple[Array, Array]:
        near = jnp.abs(jnp.exp(terms.log_ratio) - 1.0) < deviation
        kept = terms.present * near
        kept = jnp.where(jnp.any(kept > 0), kept, terms.present)
        return kept, jnp.ones_like(kept)

    return LossWeight(weight)
