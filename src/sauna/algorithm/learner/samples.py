"""From a rollout to a batch: advantages over the stream, then only the kept steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.advantages import gae
from sauna.algorithm.learner.vex_targets import VexTarget
from sauna.algorithm.types import Array, Batch, Hypers, Rollout
from sauna.config.settings import Config


def kept_rows(keep: Array, length: int) -> Array:
    """Row numbers `[length, N]` of the kept steps of `[S, N]` in time order, then of others."""
    return jnp.argsort(~keep, axis=0, stable=True)[:length]


def take(x: Array, rows: Array) -> Array:
    """`x[rows[t, n], n]` for `x` `[S, N, ...]`."""
    return x[rows, jnp.arange(rows.shape[1])]


def advantages_over_all(rollout: Rollout, hypers: Hypers, bootstrap_truncated: bool) -> Array:
    """GAE over every env step `[S, N]`, kept or not: no gap, no reward lost."""
    ended = rollout.terminated | rollout.truncated
    last = ~jnp.concatenate([rollout.valid[1:], jnp.zeros_like(rollout.valid[:1])])
    bootstrap = ~rollout.terminated if bootstrap_truncated else ~ended
    return gae(
        rollout.reward,
        rollout.value,
        rollout.next_value,
        bootstrap & rollout.valid,
        ~(ended | last),
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


def make_batch(rollout: Rollout, hypers: Hypers, *, config: Config, target: VexTarget) -> Batch:
    """Advantages, returns and Vex targets of the kept steps, flattened to `[T * N]`.

    With fewer than T kept steps in an env the remaining slots have weight 0.
    """
    rows = kept_rows(rollout.keep, config.rollout_steps)
    if config.gae_over == "all":
        over_all = advantages_over_all(rollout, hypers, config.truncation == "bootstrap")
        advantage = take(over_all, rows)
    else:
        advantage = advantages_over_kept(rollout, rows, hypers)
    value = take(rollout.value, rows)
    weight = take(rollout.keep, rows).astype(jnp.float32)
    return_ = advantage + value
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
    )
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), batch)
