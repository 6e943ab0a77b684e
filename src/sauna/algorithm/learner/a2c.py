"""Advantage actor-critic (A2C), the synchronous form of A3C (Mnih et al. 2016): its losses.

Collecting, advantages, filters, Vex targets, optimizers and everything around them are the same as
for PPO. With one pass over the whole rollout, which is what A2C makes, the ratio of PPO's
surrogate is 1 and nothing is clipped: its gradient is A2C's (Huang et al. 2022, "A2C is a special
case of PPO"), except that the value loss has no factor 1/2 of its own here.
"""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.learner.ppo import Losses, weigh, weighted_mean
from sauna.algorithm.types import Array, Hypers


def combine(
    log_prob: Array,
    advantage: Array,
    value: Array,
    return_: Array,
    vex_error: Array,
    entropy: Array,
    weight: Array,
    hypers: Hypers,
) -> Losses:
    """`mean(-log pi(a|s) A)`, `mean((V - R)^2)`, entropy and Vex loss, as in baselines' `a2c.py`.

    All arguments but `hypers` are `[B]`. There is no old policy to compare with, so KL and clip
    fraction are NaN, which leaves them out of the metrics.
    """
    log_prob = jnp.where(weight > 0, log_prob, 0.0)
    policy_loss = weighted_mean(-log_prob * advantage, weight)
    value_loss = weighted_mean((value - return_) ** 2, weight)
    vex_loss = weighted_mean(vex_error, weight)
    mean_entropy = weighted_mean(entropy, weight)
    total = weigh(policy_loss, value_loss, vex_loss, mean_entropy, hypers)
    none = jnp.full_like(total, jnp.nan)
    return Losses(total, policy_loss, value_loss, vex_loss, mean_entropy, none, none)
