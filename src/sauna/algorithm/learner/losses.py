"""What PPO's and A2C's objectives share: the minibatch, weighted means, the total of eq. 6."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.policy.distributions import Distribution
from sauna.algorithm.selection.draws import effective_size
from sauna.algorithm.selection.registry import Rules
from sauna.algorithm.types import Array, Batch, Hypers, LossTerms, PolicyOutput


class Minibatch(NamedTuple):
    """The `B` rows of one gradient step, ready for the objective."""

    rows: Batch  # of the policy loss and the entropy
    value_rows: Batch  # of the value and Vex losses, as a rule the same
    advantage: Array  # [B] of `rows`, as the loss uses it
    vex_target: Array  # [B] of `value_rows`
    policy_mask: Array  # [B] 1 for a row whose policy term counts
    policy_scale: Any  # [B] multiplies the policy term; None: 1
    value_mask: Array  # [B] 1 for a row whose value and Vex terms count
    value_scale: Any  # [B] multiplies them; None: 1
    mean_scale: Any = None  # [B] multiplies the gradient of a Gaussian's mean alone; None: 1


class Losses(NamedTuple):
    """Scalars of one minibatch; NaN where an algorithm has no such number."""

    total: Array
    policy_loss: Array
    value_loss: Array
    vex_loss: Array
    entropy: Array
    kl: Array
    clip_fraction: Array
    effective_size: Any = None  # [] of a loss weight's weights; None without one
    stop: Any = None  # [] bool, whether the stop rule forbids this step; None without one


def weighted_mean(x: Array, weight: Array) -> Array:
    """`sum(w x) / sum(w)` of `[B]` arrays; 0 where all weights are 0."""
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def standardize(advantage: Array, weight: Array) -> Array:
    """`(A - mean) / (std + 1e-8)` over the rows of weight 1, population std as in baselines."""
    centred = advantage - weighted_mean(advantage, weight)
    return centred / (jnp.sqrt(weighted_mean(centred**2, weight)) + 1e-8)


def masked_mean(terms: Array, mask: Array, scale: Any) -> Array:
    """`sum(mask scale l) / sum(mask)` of `[B]` arrays; a scale of None is 1.

    With a scale of `1 / (M p)` for rows drawn by p, its mean over draws is the mean of all rows.
    """
    return weighted_mean(terms if scale is None else terms * scale, mask)


def value_weight(minibatch: Minibatch) -> Array:
    """Mask times scale of the value terms `[B]`."""
    scale = minibatch.value_scale
    return minibatch.value_mask if scale is None else minibatch.value_mask * scale


def vex_loss_of(critic: PolicyOutput, minibatch: Minibatch) -> Array:
    """The Vex loss: the mean of `(Vex(s) - target)^2`."""
    error = (critic.vex - minibatch.vex_target) ** 2
    return masked_mean(error, minibatch.value_mask, minibatch.value_scale)


def weigh(
    policy_loss: Array, value_loss: Array, vex_loss: Array, entropy: Array, hypers: Hypers
) -> Array:
    """The total of eq. 6: `policy - c_ent * entropy + c1 * value + c2 * vex`."""
    total = policy_loss - hypers.entropy_coef * entropy
    return total + hypers.value_coef * value_loss + hypers.vex_coef * vex_loss


def weigh_policy(
    output: PolicyOutput,
    minibatch: Minibatch,
    log_prob: Array,
    log_ratio: Array,
    entropy: Array,
    *,
    distribution: Distribution,
    rules: Rules,
) -> tuple[Array, Array, Any, Any]:
    """What a loss weight makes of a minibatch's policy terms; as they are if there is no rule.

    Args:
      log_ratio: `[B]` what the objective is a function of; for A2C the log-probability.

    Returns:
      `log_ratio`, with the gradient of the mean scaled if a rule weighs that alone; the mask and
      the scale (None: 1) of the terms `[B]`; the effective size of the weights, if there are any.
    """
    rows, effective = minibatch.rows, None
    mask, scale, mean_scale = minibatch.policy_mask, minibatch.policy_scale, minibatch.mean_scale
    if rules.loss_weight is not None:
        terms = loss_terms(rows, minibatch.advantage, mask, log_prob, entropy, distribution)
        mask, own = rules.loss_weight.weight(terms)
        effective = effective_size(mask * times(own, mean_scale))
        if rules.loss_weight.on_mean and distribution.has_log_std:
            mean_scale = times(own, mean_scale)
        else:
            scale = times(own, scale)
    if mean_scale is not None:
        mean, log_std = jnp.split(output.policy, 2, -1)
        parameters = jnp.concatenate([scale_gradient(mean, mean_scale[:, None]), log_std], -1)
        change = distribution.log_prob(parameters, rows.action) - jax.lax.stop_gradient(log_prob)
        log_ratio = jnp.where(rows.weight > 0, jax.lax.stop_gradient(log_ratio) + change, 0.0)
    return log_ratio, mask, scale, effective


def times(scale: Array, other: Any) -> Array:
    """Multiplies scales `[B]`, of which the second may be None: 1."""
    return scale if other is None else scale * other


def scale_of_kept(kept: Array, weight: Array) -> Array:
    """Scales rows `[B]` so that their mean over all rows is the mean over the kept ones.

    Args:
      kept: the weights of the rows that are kept, 0 for the others; weight: of all rows.
    """
    return kept * (jnp.maximum(jnp.sum(weight), 1.0) / jnp.maximum(jnp.sum(kept), 1.0))


def loss_terms(
    rows: Batch,
    advantage: Array,
    present: Array,
    log_prob: Array,
    entropy: Array,
    distribution: Distribution,
) -> LossTerms:
    """What a loss weight sees of `B` rows: constants for the gradient, `[B]` each."""
    change = jnp.where(rows.weight > 0, log_prob - rows.log_prob, 0.0)
    return LossTerms(
        jax.lax.stop_gradient(log_prob),
        jax.lax.stop_gradient(change),
        advantage,
        jax.lax.stop_gradient(entropy),
        present,
        distribution.continuous,
    )


def scale_gradient(x: Array, scale: Array) -> Array:
    """`x`, whose gradient is multiplied by `scale`."""
    return jax.lax.stop_gradient(x - x * scale) + x * scale
