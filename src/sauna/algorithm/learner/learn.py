"""Everything that one iteration learns from a rollout, and what is logged of it."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.losses import Losses, weighted_mean
from sauna.algorithm.learner.metrics import (
    UpdateMetrics,
    Work,
    head_statistics,
    policy_std,
    variance_explained,
)
from sauna.algorithm.learner.optimizers import moves_rate
from sauna.algorithm.learner.replay import as_if_now, pool_rows, remember, with_replayed
from sauna.algorithm.learner.selected import Totals, needs_selection, update_on_selected
from sauna.algorithm.learner.sequences import in_sequences
from sauna.algorithm.learner.update import Parts, loss_advantage, update_on_all, vex_targets
from sauna.algorithm.selection.vex_filter import moved_threshold
from sauna.algorithm.types import Array, Batch, Hypers, Rollout, TrainState


def learn(
    state: TrainState,
    rollout: Rollout,
    batch: Batch,
    hypers: Hypers,
    order: Array,
    key: Array,
    *,
    parts: Parts,
) -> tuple[TrainState, UpdateMetrics]:
    """The update and everything that is logged about it.

    Args:
      batch: what `samples.make_batch` made of the rollout.
      order: `[epochs, M]` int32, a permutation of the samples for each epoch.
      key: of the draws of this iteration's selection; not read without one.
    """
    config = parts.config
    mean_target = weighted_mean(vex_targets(batch, parts.target), batch.weight)
    explained = variance_explained(batch.return_, batch.value, batch.weight)
    replay, state = state.replay, state._replace(replay=())
    if parts.replay:
        again = partial(
            as_if_now,
            params=state.params,
            hypers=hypers,
            config=config,
            policy=parts.policy,
            target=parts.target,
        )
        batch = with_replayed(batch, replay, again)
    if needs_selection(parts):
        state, totals = update_on_selected(state, batch, rollout, hypers, order, key, parts=parts)
        losses, gradient_norm, work = _means(totals, batch, rollout, parts)
        is_finite = jnp.isfinite(totals.losses.total)
    else:
        learned_from = batch
        if config.normalize_over != "minibatch":
            over_all = loss_advantage(batch.advantage, batch.weight, config)
            learned_from = batch._replace(advantage=over_all)
        if rollout.memory is not None:
            learned_from = in_sequences(learned_from, rollout, config.sequence_length)
        state, losses, gradient_norm = update_on_all(
            state, learned_from, hypers, order, parts=parts
        )
        work = _all_work(batch, losses, parts)
        is_finite = jnp.isfinite(losses.total)
    metrics = UpdateMetrics(
        losses.policy_loss,
        losses.value_loss,
        losses.vex_loss,
        losses.entropy,
        losses.kl,
        losses.clip_fraction,
        gradient_norm,
        explained,
        mean_target,
        *head_statistics(rollout.vex, rollout.valid),
        moved_threshold(rollout, hypers, config),
        state.learning_rate if moves_rate(config) else jnp.float32(jnp.nan),
        policy_std(parts.policy.unravel(state.params), config.sde_expln),
        is_finite & jnp.all(jnp.isfinite(state.params)),
        work,
    )
    return state._replace(replay=remember(replay, rollout) if parts.replay else ()), metrics


def _means(
    totals: Totals, batch: Batch, rollout: Rollout, parts: Parts
) -> tuple[Losses, Array, Work]:
    """Means over the steps taken, NaN if there was none; and the work done."""
    config, sampler = parts.config, parts.rules.sampler
    steps = totals.steps.astype(jnp.float32)
    rows = pool_rows(config)
    epochs = totals.epochs.astype(jnp.float32)
    only_forward: Any = 0.0
    if sampler is not None and sampler.reads_policy:
        only_forward = rows * (epochs if sampler.each_epoch else 1.0)
    if config.recompute_advantages:
        only_forward += rollout.vex.size * epochs
    if parts.replay:
        only_forward += rollout.vex.size * config.replay_rollouts
    present = jnp.sum(batch.weight)
    work = Work(
        gradient_steps=steps,
        sample_rate=totals.drawn / (epochs * present),
        samples_forward=totals.rows + only_forward,
        samples_backward=totals.rows.astype(jnp.float32),
        effective_sample_size=totals.effective_size / steps,
    )
    losses = jax.tree.map(lambda x: x / steps, totals.losses)
    return losses, totals.gradient_norm / steps, work


def _all_work(batch: Batch, losses: Losses, parts: Parts) -> Work:
    config = parts.config
    effective = losses.effective_size
    if effective is None:
        effective = jnp.sum(batch.weight) / config.minibatches
    steps, rows = config.epochs * config.minibatches, config.rollout_steps * config.envs
    return Work(
        gradient_steps=jnp.float32(steps),
        sample_rate=jnp.float32(1.0),
        samples_forward=jnp.float32(config.epochs * rows),
        samples_backward=jnp.float32(config.epochs * rows),
        effective_sample_size=effective,
    )
