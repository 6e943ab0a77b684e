"""One member's update: epochs of minibatches over a batch, as one compiled function."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from sauna.config.settings import Config
from sauna.core import a2c
from sauna.core.losses import Losses, combine, standardize, value_error, weighted_mean
from sauna.core.policy import Policy
from sauna.core.types import Array, Batch, Hypers, Rollout, TrainState
from sauna.selection.filters import threshold_held
from sauna.selection.vex import VexTarget


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
    finite: Array  # bool: parameters and losses are finite


def scaling(config: Config) -> optax.GradientTransformation:
    """Adam or RMSProp without the step size (which is traced).

    RMSProp is TensorFlow's, as in baselines: the mean square starts at 1, epsilon is under the
    root.
    """
    if config.optimizer == "rmsprop":
        return optax.scale_by_rms(
            config.rmsprop_decay, config.rmsprop_epsilon, initial_scale=1.0, eps_in_sqrt=True
        )
    return optax.scale_by_adam(eps=config.adam_epsilon)


def optimizer(config: Config, hypers: Hypers) -> optax.GradientTransformation:
    """Global-norm clipping, then the optimizer's scaling."""
    return optax.chain(optax.clip_by_global_norm(hypers.max_grad_norm), scaling(config))


def init_state(config: Config, policy: Policy, key: Array) -> TrainState:
    params = policy.init(key)
    return TrainState(params, scaling(config).init(params))


def vex_targets(batch: Batch, target: VexTarget) -> Array:
    """Targets `[B]`: the batch's own, or computed on it if the target is one per minibatch."""
    if not target.per_minibatch:
        return batch.vex_target
    one_episode = jnp.zeros(batch.value.shape, jnp.int32)
    return target.target(batch.return_, batch.value, batch.weight, one_episode)


def minibatch_losses(
    params: Array,
    batch: Batch,
    hypers: Hypers,
    *,
    config: Config,
    policy: Policy,
    target: VexTarget,
) -> Losses:
    """The algorithm's objective on one minibatch of `[B]` samples."""
    output = policy.apply(params, batch.observation)
    advantage = batch.advantage
    if config.normalize_advantages:
        advantage = standardize(advantage, batch.weight)
    vex_target = vex_targets(batch, target)
    log_prob = policy.distribution.log_prob(output.policy, batch.action)
    if config.algorithm == "a2c":
        return a2c.combine(
            log_prob,
            advantage,
            output.value,
            batch.return_,
            (output.vex - vex_target) ** 2,
            policy.distribution.entropy(output.policy),
            batch.weight,
            hypers,
        )
    return combine(
        log_prob - batch.log_prob,
        advantage,
        value_error(
            output.value,
            batch.value,
            batch.return_,
            hypers.clip_range if config.clip_value else None,
        ),
        (output.vex - vex_target) ** 2,
        policy.distribution.entropy(output.policy),
        batch.weight,
        hypers,
    )


def update(
    state: TrainState,
    batch: Batch,
    hypers: Hypers,
    order: Array,
    *,
    config: Config,
    policy: Policy,
    target: VexTarget,
) -> tuple[TrainState, Losses, Array]:
    """`epochs` passes over `batch` in `minibatches` shuffled parts each.

    Args:
      batch: `[T * N]` samples.
      order: `[epochs, T * N]` int32, a permutation of the samples for each epoch. Given rather
        than drawn here, because XLA's sort on CPU would take a quarter of the update's time.

    Returns:
      the new state, the mean losses, and the mean gradient norm before clipping.
    """

    def loss(params: Array, part: Batch) -> tuple[Array, Losses]:
        losses = minibatch_losses(params, part, hypers, config=config, policy=policy, target=target)
        return losses.total, losses

    transform = optimizer(config, hypers)

    def minibatch(state: TrainState, rows: Array) -> tuple[TrainState, tuple[Losses, Array]]:
        part = jax.tree.map(lambda x: x[rows], batch)
        gradient, losses = jax.grad(loss, has_aux=True)(state.params, part)
        step, (_, scale) = transform.update(gradient, (optax.EmptyState(), state.optimizer))
        params = state.params - hypers.learning_rate * step
        return TrainState(params, scale), (losses, jnp.linalg.norm(gradient))

    parts = order.reshape((config.epochs * config.minibatches, -1))
    state, (losses, norms) = jax.lax.scan(minibatch, state, parts)
    return state, jax.tree.map(jnp.mean, losses), jnp.mean(norms)


def variance_explained(return_: Array, value: Array, weight: Array) -> Array:
    """`1 - Var(R - V) / Var(R)` over the samples of weight 1; NaN where R does not vary."""

    def variance(x: Array) -> Array:
        return weighted_mean((x - weighted_mean(x, weight)) ** 2, weight)

    return 1.0 - variance(return_ - value) / variance(return_)


def head_statistics(vex: Array, valid: Array) -> tuple[Array, Array, Array]:
    """Mean, standard deviation and median of the head's predictions over all env steps."""
    number = jnp.sum(valid)
    mean = jnp.sum(jnp.where(valid, vex, 0.0)) / number
    spread = jnp.sqrt(jnp.sum(jnp.where(valid, (vex - mean) ** 2, 0.0)) / number)
    ordered = jnp.sort(jnp.where(valid, vex, jnp.inf).ravel())
    median = 0.5 * (ordered[(number - 1) // 2] + ordered[number // 2])
    return mean, spread, median


def moved_threshold(rollout: Rollout, hypers: Hypers, config: Config) -> Array:
    """The threshold of this iteration; NaN where it is the config's own, or nothing is filtered."""
    unmoved = jnp.float32(jnp.nan)
    if config.keep_rate_target:
        held = threshold_held(rollout.vex, rollout.valid, config.keep_rate_target)
        return jnp.where(hypers.threshold > 0, held, unmoved)
    return unmoved if config.threshold_schedule == "constant" else jnp.float32(hypers.threshold)


def learn(
    state: TrainState,
    rollout: Rollout,
    batch: Batch,
    hypers: Hypers,
    order: Array,
    *,
    config: Config,
    policy: Policy,
    target: VexTarget,
) -> tuple[TrainState, UpdateMetrics]:
    """The update and everything that is logged about it."""
    mean_target = weighted_mean(vex_targets(batch, target), batch.weight)
    state, losses, gradient_norm = update(
        state, batch, hypers, order, config=config, policy=policy, target=target
    )
    finite = jnp.isfinite(losses.total) & jnp.all(jnp.isfinite(state.params))
    metrics = UpdateMetrics(
        losses.policy_loss,
        losses.value_loss,
        losses.vex_loss,
        losses.entropy,
        losses.kl,
        losses.clip_fraction,
        gradient_norm,
        variance_explained(batch.return_, batch.value, batch.weight),
        mean_target,
        *head_statistics(rollout.vex, rollout.valid),
        moved_threshold(rollout, hypers, config),
        finite,
    )
    return state, metrics
