"""One member's update: epochs of minibatches over a batch, as one compiled function."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax

from sauna.algorithm.learner import a2c
from sauna.algorithm.learner.metrics import UpdateMetrics, head_statistics, variance_explained
from sauna.algorithm.learner.ppo import Losses, combine, standardize, value_error, weighted_mean
from sauna.algorithm.learner.vex_targets import VexTarget
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.selection.vex_filter import moved_threshold
from sauna.algorithm.types import Array, Batch, Hypers, Rollout, TrainState
from sauna.config.settings import Config


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


def minibatch_order(config: Config, seed: int, iteration: int) -> np.ndarray:
    """The order of the samples in every epoch of an update, `[epochs, T * N]` int32."""
    samples = np.arange(config.rollout_steps * config.envs, dtype=np.int32)
    generator = np.random.default_rng([seed, iteration])
    return generator.permuted(np.tile(samples, (config.epochs, 1)), axis=1)


def device_minibatch_order(config: Config, key: Array) -> Array:
    """The order of the samples in every epoch `[epochs, T * N]`."""
    number = config.rollout_steps * config.envs
    keys = jax.random.split(key, config.epochs)
    return jax.vmap(lambda key: jax.random.permutation(key, number))(keys)
