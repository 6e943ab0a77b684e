"""Advantage actor-critic (A2C), the synchronous form of A3C (Mnih et al. 2016): its objective.

Collecting, advantages, filters, Vex targets, optimizers and everything around them are the same as
for PPO. With one pass over the whole rollout, which is what A2C makes, the ratio of PPO's
surrogate is 1 and nothing is clipped: its gradient is A2C's (Huang et al. 2022, "A2C is a special
case of PPO"), except that the value loss has no factor 1/2 of its own here.
"""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.learner.losses import (
    Losses,
    Minibatch,
    masked_mean,
    value_weight,
    vex_loss_of,
    weigh,
    weigh_policy,
    weighted_mean,
)
from sauna.algorithm.policy.distributions import Distribution
from sauna.algorithm.selection.registry import Rules
from sauna.algorithm.types import Hypers, PolicyOutput
from sauna.config.settings import Config


def losses(
    output: PolicyOutput,
    critic: PolicyOutput,
    minibatch: Minibatch,
    hypers: Hypers,
    *,
    config: Config,
    distribution: Distribution,
    rules: Rules,
) -> Losses:
    """`mean(-log pi(a|s) A)`, `mean((V - R)^2)`, entropy and Vex loss, as in baselines' `a2c.py`.

    There is no old policy to compare with, so KL and clip fraction are NaN, which leaves them out
    of the metrics.
    """
    rows, values = minibatch.rows, minibatch.value_rows
    log_prob = distribution.log_prob(output.policy, rows.action)
    log_prob = jnp.where(rows.weight > 0, log_prob, 0.0)
    entropy = distribution.entropy(output.policy)
    log_prob, mask, scale, effective = weigh_policy(
        output, minibatch, log_prob, log_prob, entropy, distribution=distribution, rules=rules
    )
    terms = -log_prob * minibatch.advantage
    policy_loss = masked_mean(terms, mask, scale)
    if rules.critic is None:
        errors = (critic.value - values.return_) ** 2
        value_loss = masked_mean(errors, minibatch.value_mask, minibatch.value_scale)
    else:
        value_loss = rules.critic(values.return_ - critic.value, value_weight(minibatch))
    vex_loss = vex_loss_of(critic, minibatch)
    mean_entropy = weighted_mean(entropy, rows.weight)
    total = weigh(policy_loss, value_loss, vex_loss, mean_entropy, hypers)
    none = jnp.full_like(total, jnp.nan)
    return Losses(total, policy_loss, value_loss, vex_loss, mean_entropy, none, none, effective)
