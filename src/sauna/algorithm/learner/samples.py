"""From a rollout to a batch: advantages over the stream, then only the kept steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.advantages import gae
from sauna.algorithm.learner.vex_targets import VexTarget
from sauna.algorithm.selection.avec import unbiased
from sauna.algorithm.selection.control import controlled_filter
from sauna.algorithm.types import Array, Batch, Hypers, Rollout
from sauna.config.settings import Config


def kept_rows(keep: Array, length: int) -> Array:
    """Row numbers `[length, N]` of the kept steps of `[S, N]` in time order, then of others."""
    return jnp.argsort(~keep, axis=0, stable=True)[:length]


def take(x: Array, rows: Array) -> Array:
    """`x[rows[t, n], n]` for `x` `[S, N, ...]`."""
    return x[rows, jnp.arange(rows.shape[1])]


def advantages_over_all(
    rollout: Rollout, hypers: Hypers, bootstrap_truncated: bool, trace: Array | None = None
) -> Array:
    """GAE over every env step `[S, N]`, kept or not: no gap, no reward lost.

    Args:
      trace: `[S, N]` of each step, how much of its advantage flows to the step before; None: 1.
    """
    ended = rollout.terminated | rollout.truncated
    last = ~jnp.concatenate([rollout.valid[1:], jnp.zeros_like(rollout.valid[:1])])
    bootstrap = ~rollout.terminated if bootstrap_truncated else ~ended
    flows = ~(ended | last)
    if trace is not None:
        flows = flows * jnp.concatenate([trace[1:], trace[-1:]])
    return gae(
        rollout.reward,
        rollout.value,
        rollout.next_value,
        bootstrap & rollout.valid,
        flows,
        hypers.gamma,
        hypers.gae_lambda,
    )


def advantages_over_kept(rollout: Rollout, rows: Array, hypers: Hypers) -> Array:
    """GAE over the kept steps `[T, N]` as if they were adjacent: a quirk of the released code.

    `runner.py` of the release appends to its buffers on kept steps only. So a dropped step's
    reward is lost, one gamma spans any gap, and the end of an episode counts only if it happened
    on the env step just before a kept one (`mb_dones` holds the flag of the step before): an end
    followed by a dropped step is forgotten, one on a dropped step is laid to the kept step before.
    After the last kept step counts the last env step, kept or not (`self.dones`).
    """
    length = rows.shape[0]
    ended = rollout.terminated | rollout.truncated
    ended_before = jnp.concatenate([jnp.zeros_like(ended[:1]), ended[:-1]])
    final_row = jnp.sum(rollout.valid, 0, keepdims=True) - 1
    number = jnp.sum(rollout.keep, 0)
    is_last = jnp.arange(length)[:, None] >= number - 1
    following = jnp.concatenate([rows[1:], rows[-1:]])
    cut = jnp.where(is_last, take(ended, final_row), take(ended_before, following))
    next_value = jnp.where(
        is_last, take(rollout.next_value, final_row), take(rollout.value, following)
    )
    return gae(
        take(rollout.reward, rows),
        take(rollout.value, rows),
        next_value,
        ~cut,
        ~(cut | is_last),
        hypers.gamma,
        hypers.gae_lambda,
    )


def episode_numbers(rollout: Rollout, rows: Array) -> Array:
    """Which episode each kept step `[T, N]` belongs to, numbered 0, 1, ... without gaps."""
    ended = (rollout.terminated | rollout.truncated).astype(jnp.int32)
    number = take(jnp.cumsum(ended, 0) - ended, rows)
    changed = jnp.concatenate([jnp.zeros_like(number[:1]), number[1:] != number[:-1]])
    return jnp.cumsum(changed, 0).astype(jnp.int32)


def make_batch(
    rollout: Rollout, hypers: Hypers, key: Array, *, config: Config, target: VexTarget
) -> Batch:
    """Advantages, returns and Vex targets of the kept steps, flattened to `[T * N]`.

    With fewer than T kept steps in an env the remaining slots have weight 0.

    Args:
      key: of the draws of this iteration's selection; read by a filter's matched control alone.
    """
    if config.critic == "avec":
        rollout = with_unbiased_value(rollout, hypers, config)
    if config.gae_over == "all":
        over_all = advantages_over_all(rollout, hypers, config.truncation == "bootstrap")
        rollout = with_matched_control(rollout, over_all, key, config)
        rows = kept_rows(rollout.keep, config.rollout_steps)
        advantage = take(over_all, rows)
    else:
        rows = kept_rows(rollout.keep, config.rollout_steps)
        advantage = advantages_over_kept(rollout, rows, hypers)
    return flat_batch(
        rollout, rows, advantage, advantage + take(rollout.value, rows), config, target
    )


def flat_batch(
    rollout: Rollout,
    rows: Array,
    advantage: Array,
    return_: Array,
    config: Config,
    target: VexTarget,
) -> Batch:
    """The kept steps of a rollout with their advantages and returns, flattened to `[T * N]`.

    Args:
      rows, advantage, return_: `[T, N]`.
    """
    value = take(rollout.value, rows)
    weight = take(rollout.keep, rows).astype(jnp.float32)
    vex_target = jnp.zeros_like(value)
    if not target.per_minibatch:
        vex_target = target.target(return_, value, weight, episode_numbers(rollout, rows))
    batch = Batch(
        take(rollout.observation, rows),
        take(rollout.action, rows),
        take(rollout.log_prob, rows),
        advantage,
        return_,
        value,
        vex_target,
        weight,
        take(rollout.vex, rows),
    )
    if config.auxiliary != "none":
        following, there = next_observations(rollout)
        batch = batch._replace(
            next_observation=take(following, rows), next_weight=take(there, rows) * weight
        )
    if rollout.memory is not None or config.recompute_advantages:
        batch = batch._replace(row=rows * rows.shape[1] + jnp.arange(rows.shape[1]))
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), batch)


def with_matched_control(rollout: Rollout, advantage: Array, key: Array, config: Config) -> Rollout:
    """The rollout with as many steps kept as its filter kept, chosen by the control, if any."""
    if config.control == "none" or config.filter == "none":
        return rollout
    keep = controlled_filter(config.control, rollout.keep, advantage, rollout.valid, key)
    return rollout._replace(keep=keep)


def with_unbiased_value(rollout: Rollout, hypers: Hypers, config: Config) -> Rollout:
    """The rollout with the constant added to its values that makes `mean(R - V)` 0."""
    weight = rollout.valid.astype(jnp.float32)
    bootstrap = config.truncation == "bootstrap"
    advantage = advantages_over_all(rollout, hypers, bootstrap)
    one, zero = jnp.ones_like(rollout.value), jnp.zeros_like(rollout.value)
    constant = rollout._replace(reward=zero, value=one, next_value=one)
    c = unbiased(advantage, advantages_over_all(constant, hypers, bootstrap), weight)
    return rollout._replace(value=rollout.value + c, next_value=rollout.next_value + c)


def next_observations(rollout: Rollout) -> tuple[Array, Array]:
    """The observation after each step `[S, N, ...]`, and 1 where it is of the same episode.

    The observation after the last step of a rollout is not in it, nor the final one of an episode.
    """
    following = jnp.concatenate([rollout.observation[1:], rollout.observation[-1:]])
    ended = rollout.terminated | rollout.truncated
    valid_next = jnp.concatenate([rollout.valid[1:], jnp.zeros_like(rollout.valid[:1])])
    return following, (valid_next & ~ended).astype(jnp.float32)


def with_values(rollout: Rollout, value: Array) -> Rollout:
    """The rollout with other values `[S, N]` of its observations.

    Where a step's successor is not a step of the rollout (at an episode's end, behind the last
    step), its value stays that of collection.
    """
    last = ~jnp.concatenate([rollout.valid[1:], jnp.zeros_like(rollout.valid[:1])])
    outside = rollout.terminated | rollout.truncated | last
    following = jnp.concatenate([value[1:], value[-1:]])
    return rollout._replace(
        value=value, next_value=jnp.where(outside, rollout.next_value, following)
    )


def recomputed(
    batch: Batch, rollout: Rollout, value: Array, hypers: Hypers, *, config: Config
) -> Batch:
    """The batch with the advantages and returns that other values of the same steps give.

    See `with_values` for the successors that are no step of the rollout. Value clipping goes on
    from the value at collection.

    Args:
      value: `[S, N]` of the rollout's observations by today's network.
    """
    now = with_values(rollout, value)
    if config.critic == "avec":
        now = with_unbiased_value(now, hypers, config)
    over_all = advantages_over_all(now, hypers, config.truncation == "bootstrap")
    advantage = over_all.ravel()[batch.row]
    return batch._replace(advantage=advantage, return_=advantage + now.value.ravel()[batch.row])
