"""What is logged of an update."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from sauna.algorithm.learner.losses import weighted_mean
from sauna.algorithm.policy.gsde import deviation
from sauna.algorithm.types import Array, Params


class Work(NamedTuple):
    """What one iteration's update took; `[]` each."""

    gradient_steps: Array
    sample_rate: Array  # rows that the policy loss draws per epoch, of the rollout's
    samples_forward: Array  # rows through the network, with those that only a rule needs
    samples_backward: Array  # rows through its gradient, also of a step that a stop rule forbids
    effective_sample_size: Array  # (sum w)^2 / sum w^2 of a minibatch's policy weights, the mean


class UpdateMetrics(NamedTuple):
    """Scalars of one iteration. Losses are means over all minibatches.

    What an algorithm or a rollout does not have is NaN.
    """

    policy_loss: Array
    value_loss: Array
    vex_loss: Array
    entropy: Array
    kl: Array
    clip_fraction: Array
    gradient_norm: Array  # before clipping
    explained_variance: Array  # 1 - Var(R - V_old) / Var(R) of the kept steps
    vex_target: Array  # mean target over the kept steps
    vex_mean: Array  # of the head's predictions over all env steps
    vex_spread: Array  # their standard deviation
    vex_median: Array
    threshold: Array  # where it moves: that of this iteration; else NaN
    learning_rate: Array  # if the KL divergence moves it: that of the last step; else NaN
    policy_std: Array  # mean over the action's components, after the update; NaN if discrete
    finite: Array  # bool: parameters and losses are finite
    work: Work


def variance_explained(return_: Array, value: Array, weight: Array) -> Array:
    """`1 - Var(R - V) / Var(R)` over the samples of weight 1; NaN where R does not vary."""

    def variance(x: Array) -> Array:
        return weighted_mean((x - weighted_mean(x, weight)) ** 2, weight)

    return 1.0 - variance(return_ - value) / variance(return_)


def policy_std(params: Params, expln: bool) -> Array:
    """The mean of the policy's standard deviations, which depend on no state; NaN without any.

    Args:
      expln: how they follow from their parameters; see `gsde.deviation`.
    """
    log_std = params["params"].get("log_std")
    return jnp.float32(jnp.nan) if log_std is None else jnp.mean(deviation(log_std, expln))


def head_statistics(vex: Array, valid: Array) -> tuple[Array, Array, Array]:
    """Mean, standard deviation and median of the head's predictions over all env steps."""
    number = jnp.sum(valid)
    mean = jnp.sum(jnp.where(valid, vex, 0.0)) / number
    spread = jnp.sqrt(jnp.sum(jnp.where(valid, (vex - mean) ** 2, 0.0)) / number)
    ordered = jnp.sort(jnp.where(valid, vex, jnp.inf).ravel())
    median = 0.5 * (ordered[(number - 1) // 2] + ordered[number // 2])
    return mean, spread, median
