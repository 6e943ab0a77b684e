"""PPO's objective: eq. 6 of the paper, on one minibatch. A2C's is in `a2c.py`.

    total = policy_loss - c_ent entropy + c1 value_loss + c2 vex_loss

All means are weighted: a row with weight 0 (a slot left empty) counts for nothing. With every
weight 1 they are plain means.
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
from sauna.algorithm.types import Array, Hypers, PolicyOutput
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
    """PPO's losses, their total and what is logged beside it.

    The KL estimate is `mean((r - 1) - log r)` (Schulman's k3), of new against old policy.

    Args:
      output: the network at the rows of the policy loss `[B]`.
      critic: the network at the rows of the value loss `[B]`, as a rule the same.
    """
    rows, values = minibatch.rows, minibatch.value_rows
    log_prob = distribution.log_prob(output.policy, rows.action)
    log_ratio = jnp.where(rows.weight > 0, log_prob - rows.log_prob, 0.0)
    entropy = distribution.entropy(output.policy)
    log_ratio, mask, scale, effective = weigh_policy(
        output, minibatch, log_prob, log_ratio, entropy, distribution=distribution, rules=rules
    )
    form = rules.objective or surrogate
    terms = form(log_ratio, minibatch.advantage, hypers.clip_range)
    policy_loss = masked_mean(terms, mask, scale)
    value_clip = hypers.clip_range if config.clip_value else None
    if rules.critic is None:
        errors = value_error(critic.value, values.value, values.return_, value_clip)
        value_loss = masked_mean(errors, minibatch.value_mask, minibatch.value_scale)
    else:
        value_loss = rules.critic(values.return_ - critic.value, value_weight(minibatch))
    vex_loss = vex_loss_of(critic, minibatch)
    mean_entropy = weighted_mean(entropy, rows.weight)
    total = weigh(policy_loss, value_loss, vex_loss, mean_entropy, hypers)
    ratio = jnp.exp(log_ratio)
    kl = weighted_mean((ratio - 1.0) - log_ratio, rows.weight)
    outside = (jnp.abs(ratio - 1.0) > hypers.clip_range).astype(ratio.dtype)
    clip_fraction = weighted_mean(outside, rows.weight)
    stop = None if rules.stop is None else rules.stop.exceeded(log_ratio, rows.weight)
    return Losses(
        total,
        policy_loss,
        value_loss,
        vex_loss,
        mean_entropy,
        kl,
        clip_fraction,
        effective,
        stop,
    )


def surrogate(log_ratio: Array, advantage: Array, clip_range: Array) -> Array:
    """Eq. 3, negated: `max(-A r, -A clip(r, 1 - eps, 1 + eps))` for each sample `[B]`."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip_range, 1.0 + clip_range)
    return jnp.maximum(-advantage * ratio, -advantage * clipped)


def value_error(value: Array, old: Array, return_: Array, clip_range: Array | None) -> Array:
    """`0.5 * max((V - R)^2, (V_clipped - R)^2)` for each sample `[B]`, as in baselines.

    `clip_range` None leaves out the clipped branch.
    """
    error = (value - return_) ** 2
    if clip_range is not None:
        clipped = old + jnp.clip(value - old, -clip_range, clip_range)
        error = jnp.maximum(error, (clipped - return_) ** 2)
    return 0.5 * error
