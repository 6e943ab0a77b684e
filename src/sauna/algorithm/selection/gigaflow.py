"""Advantage filtering as GigaFlow has it."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_range
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def gigaflow(setup: SamplerSetup, threshold: float = 0.01, rate: float = 0.25) -> Sampler:
    """Drops rows far below the running largest advantage (Cusumano-Towner et al. 2025, Alg. 1).

    `M <- max|A|` in the first rollout, later `rate max|A| + (1 - rate) M`; a row stays if
    `|A| >= threshold M`. Advantages are raw. Policy, value and entropy see the kept rows only.
    M can outlive the advantages, so that nothing is kept: that iteration learns nothing.
    Source: arXiv 2502.03349; the constants are those of PufferDrive.
    """
    check_range("threshold", threshold, 0.0)
    check_range("rate", rate, 0.0, 1.0)

    def choose(state: Array, samples: Samples, key: Array) -> tuple[Array, Choice]:
        size = jnp.where(samples.present, jnp.abs(samples.advantage), 0.0)
        now = jnp.max(size)
        largest = jnp.where(jnp.isnan(state), now, rate * now + (1.0 - rate) * state)
        keep = (size >= threshold * largest) & samples.present
        return largest, Choice(keep=keep, score=size)

    return Sampler(lambda: jnp.float32(jnp.nan), choose)
