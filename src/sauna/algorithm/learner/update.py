"""One member's update: epochs of minibatches over a batch, as one compiled function."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from sauna.algorithm.learner import a2c, ppo
from sauna.algorithm.learner.losses import Losses, Minibatch, standardize
from sauna.algorithm.learner.optimizers import moved_rate, moves_rate, optimizer, scaling
from sauna.algorithm.learner.sequences import as_rows, outputs, units
from sauna.algorithm.learner.vex_targets import VexTarget
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.selection.positive import cut_at_zero
from sauna.algorithm.selection.registry import Rules
from sauna.algorithm.types import Array, Batch, Hypers, Replay, TrainState
from sauna.config.settings import Config


class Parts(NamedTuple):
    """The static parts of learning."""

    config: Config
    policy: Policy
    target: VexTarget
    rules: Rules
    replay: Callable[[], Replay] | None = None  # makes an empty one; None: nothing is replayed


def init_state(parts: Parts, key: Array) -> TrainState:
    config, policy, sampler = parts.config, parts.policy, parts.rules.sampler
    params = policy.init(key)
    carried = sampler.init() if sampler else ()
    rate = jnp.float32(0.0) if moves_rate(config) else ()
    replay = parts.replay() if parts.replay else ()
    return TrainState(params, scaling(config, policy).init(params), carried, rate, replay)


def vex_targets(batch: Batch, target: VexTarget) -> Array:
    """Targets `[B]`: the batch's own, or computed on it if the target is one per minibatch."""
    if not target.per_minibatch:
        return batch.vex_target
    one_episode = jnp.zeros(batch.value.shape, jnp.int32)
    return target.target(batch.return_, batch.value, batch.weight, one_episode)


def plain_minibatch(rows: Batch, parts: Parts) -> Minibatch:
    """The rows `[B]` of one gradient step, each of which counts as its weight says."""
    target = vex_targets(rows, parts.target)
    advantage = minibatch_advantage(rows, parts.config)
    return Minibatch(rows, rows, advantage, target, rows.weight, None, rows.weight, None)


def acts_on_mean(parts: Parts) -> bool:
    """Whether a sampler's mask chooses rows for the gradient of a Gaussian's mean alone."""
    sampler = parts.rules.sampler
    on_policy = parts.config.selection_losses == "policy" and parts.policy.distribution.has_log_std
    return on_policy and sampler is not None and sampler.on_mean


def minibatch_advantage(rows: Batch, config: Config) -> Array:
    """The advantages `[B]` as the loss uses them, unless a larger set has made them so before."""
    if config.normalize_over == "minibatch":
        return loss_advantage(rows.advantage, rows.weight, config)
    return rows.advantage


def loss_advantage(advantage: Array, weight: Array, config: Config) -> Array:
    """The advantages as the loss uses them: standardised, cut at zero, or as they are."""
    if config.advantage_sign == "positive":
        return cut_at_zero(advantage, weight)
    if config.normalize_advantages:
        return standardize(advantage, weight)
    return advantage


def minibatch_losses(
    params: Array, minibatch: Minibatch, hypers: Hypers, *, parts: Parts
) -> Losses:
    """The algorithm's objective on one minibatch of `B` rows."""
    config, policy, rules = parts.config, parts.policy, parts.rules
    rows, values = minibatch.rows, minibatch.value_rows
    output = critic = outputs(policy, params, rows.observation, rows.memory)
    if values is not rows:
        critic = outputs(policy, params, values.observation, values.memory)
    objective = a2c.losses if config.algorithm == "a2c" else ppo.losses
    losses = objective(
        output,
        critic,
        minibatch,
        hypers,
        config=config,
        distribution=policy.distribution,
        rules=rules,
    )
    if rules.auxiliary is None:
        return losses
    extra = rules.auxiliary(
        critic.prediction, values.observation, values.next_observation, values.next_weight
    )
    return losses._replace(total=losses.total + config.auxiliary_coef * extra)


def gradient_step(
    state: TrainState, minibatch: Minibatch, hypers: Hypers, *, parts: Parts
) -> tuple[TrainState, Losses, Array]:
    """One step down the gradient; the losses before it, and the gradient's norm before clipping."""

    def loss(params: Array) -> tuple[Array, Losses]:
        losses = minibatch_losses(params, minibatch, hypers, parts=parts)
        return losses.total, losses

    gradient, losses = jax.grad(loss, has_aux=True)(state.params)
    transform = optimizer(parts.config, parts.policy, hypers)
    before = (optax.EmptyState(), state.optimizer)
    step, (_, scale) = transform.update(gradient, before, state.params)
    rate, carried = hypers.learning_rate, state.learning_rate
    if moves_rate(parts.config):
        rate = carried = moved_rate(jnp.where(carried > 0, carried, rate), losses.kl, parts.config)
    params = state.params - rate * step
    return TrainState(params, scale, state.sampler, carried), losses, jnp.linalg.norm(gradient)


def update_on_all(
    state: TrainState, batch: Batch, hypers: Hypers, order: Array, *, parts: Parts
) -> tuple[TrainState, Losses, Array]:
    """`epochs` passes over `batch` in `minibatches` shuffled parts each.

    Args:
      batch: `[T * N]` samples, or sequences `[K, L]` of a recurrent policy.
      order: `[epochs, T * N]` (or `[epochs, K]`) int32, a permutation for each epoch. Given rather
        than drawn here, because XLA's sort on CPU would take a quarter of the update's time.

    Returns:
      the new state, the mean losses, and the mean gradient norm before clipping.
    """

    def step(state: TrainState, places: Array) -> tuple[TrainState, tuple[Losses, Array]]:
        part = jax.tree.map(lambda x: x[places], batch)
        rows = part if part.memory is None else as_rows(part)
        state, losses, norm = gradient_step(
            state, plain_minibatch(rows, parts), hypers, parts=parts
        )
        return state, (losses, norm)

    steps = order.reshape((parts.config.epochs * parts.config.minibatches, -1))
    state, (losses, norms) = jax.lax.scan(step, state, steps)
    return state, jax.tree.map(jnp.mean, losses), jnp.mean(norms)


def minibatch_order(config: Config, seed: int, iteration: int) -> np.ndarray:
    """The order of the samples (or sequences) in every epoch of an update, `[epochs, M]` int32."""
    samples = np.arange(units(config), dtype=np.int32)
    generator = np.random.default_rng([seed, iteration])
    return generator.permuted(np.tile(samples, (config.epochs, 1)), axis=1)


def device_minibatch_order(config: Config, key: Array, length: int | None = None) -> Array:
    """The order of samples (or sequences) in every epoch `[epochs, M]`, or of the first `length`.

    A permutation is a sort here, so that one of fewer rows takes less time.
    """
    number = length or units(config)
    keys = jax.random.split(key, config.epochs)
    return jax.vmap(lambda key: permutation(key, number))(keys)


def permutation(key: Array, number: int) -> Array:
    """Draws what `jax.random.permutation(key, number)` draws, `[number]` int32.

    JAX sorts pairs of a random key and an element, so often that equal keys do not matter. Here
    both are one 64-bit number, because XLA sorts plain numbers much faster on a CPU.
    """
    order = jnp.arange(number, dtype=jnp.int32)
    rounds = math.ceil(3 * math.log(max(number, 1)) / math.log(2**32 - 1))
    for _ in range(rounds):
        key, own = jax.random.split(key)
        first = jax.random.bits(own, (number,), jnp.uint32)
        with jax.enable_x64(True):
            pairs = first.astype(jnp.uint64) << 32 | jnp.arange(number, dtype=jnp.uint64)
            places = jnp.sort(pairs, stable=False).astype(jnp.uint32)
        order = order[places]
    return order
