"""The policy's gradient alone, where it stands before an update begins."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.losses import standardize, weighted_mean
from sauna.algorithm.learner.ppo import surrogate
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.types import Array


def policy_gradient(
    params: Array,
    observation: Array,
    action: Array,
    advantage: Array,
    weight: Array,
    *,
    policy: Policy,
    standardized: bool,
) -> Array:
    """Returns the direction `[D]` in which the surrogate of eq. 3 rises, at a probability ratio of
    1.

    There the clipping does nothing, and this is `mean(A grad log pi(a | s))`. The losses of value,
    Vex and entropy are left out.

    Args:
      params: `[D]`.
      observation: `[B, *obs]` normalised; action: `[B, A]`; advantage: `[B]`.
      weight: `[B]` 1, or 0 for a row to leave out.
      standardized: standardise the advantages over these samples, as `normalize_advantages` does.
    """
    if standardized:
        advantage = standardize(advantage, weight)

    def loss(params: Array) -> Array:
        output = policy.apply(params, observation)
        log_prob = policy.distribution.log_prob(output.policy, action)
        log_ratio = log_prob - jax.lax.stop_gradient(log_prob)
        clip_range = jnp.float32(1.0)  # any: nothing is clipped
        return weighted_mean(surrogate(log_ratio, advantage, clip_range), weight)

    return -jax.grad(loss)(params)
