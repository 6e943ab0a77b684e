"""Learning again from the rollouts of the last iterations, as if today's policy had acted.

An earlier rollout was collected by a policy mu; pi is today's, before the update. A step counts
by its truncated importance weight `rho = min(1, pi(a|s) / mu(a|s))`, and V-trace (Espeholt et al.
2018, with c_t = lambda rho_t) corrects what flows back over later steps:

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t)
    A_t     = delta_t + gamma lambda rho_{t+1} A_{t+1}
    R_t     = V(s_t) + rho_t A_t

V is today's. With pi = mu these are the advantages and returns of GAE. The objective then takes the
step as one of pi: its ratio is against pi, and its policy term is multiplied by rho.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.samples import (
    advantages_over_all,
    flat_batch,
    kept_rows,
    take,
    with_values,
)
from sauna.algorithm.learner.vex_targets import VexTarget
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.types import Array, Batch, Hypers, Replay, Rollout
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces


def pool_rows(config: Config) -> int:
    """M: the rows that an update chooses from, T * N of the new rollout and of each earlier one."""
    return config.rollout_steps * config.envs * (1 + config.replay_rollouts)


def empty_replay(config: Config, spaces: Spaces) -> Replay:
    """Room for the last `replay_rollouts` rollouts."""
    lead = (config.replay_rollouts, capacity(config), config.envs)
    number, flag = jnp.zeros(lead, jnp.float32), jnp.zeros(lead, bool)
    rollouts = Rollout(
        observation=jnp.zeros((*lead, *spaces.observation_shape), spaces.observation_dtype),
        action=jnp.zeros((*lead, spaces.action_width), spaces.action_dtype),
        **dict.fromkeys(("log_prob", "reward", "value", "next_value", "vex"), number),
        **dict.fromkeys(("terminated", "truncated", "valid", "keep"), flag),
    )
    return Replay(rollouts, jnp.int32(0))


def remember(replay: Replay, rollout: Rollout) -> Replay:
    """The replay with a new rollout in front; the oldest one is forgotten."""
    rollouts = jax.tree.map(
        lambda old, new: jnp.concatenate([new[None].astype(old.dtype), old[:-1]]),
        replay.rollouts,
        rollout,
    )
    return Replay(rollouts, jnp.minimum(replay.number + 1, len(rollouts.valid)))


def with_replayed(batch: Batch, replay: Replay, again: Callable[[Rollout], Batch]) -> Batch:
    """The new rollout's batch `[T * N]` and behind it those of the earlier ones: `[M]` rows.

    Args:
      again: what an earlier rollout is today; see `as_if_now`.
    """

    def one(numbered: tuple[Array, Rollout]) -> Batch:
        i, rollout = numbered
        found = again(rollout)
        return found._replace(weight=found.weight * (i < replay.number))

    places = jnp.arange(len(replay.rollouts.valid))
    earlier = jax.lax.map(one, (places, replay.rollouts))
    new = batch._replace(importance=jnp.ones_like(batch.weight))
    return jax.tree.map(
        lambda now, then: jnp.concatenate([now, then.reshape((-1, *then.shape[2:]))]), new, earlier
    )


def as_if_now(
    rollout: Rollout,
    params: Array,
    hypers: Hypers,
    *,
    config: Config,
    policy: Policy,
    target: VexTarget,
) -> Batch:
    """The kept steps `[T * N]` of an earlier rollout `[S, N, ...]`, as today's policy sees them."""
    output = policy.apply(params, rollout.observation)
    log_prob = policy.distribution.log_prob(output.policy, rollout.action)
    rho = jnp.where(rollout.valid, jnp.exp(jnp.minimum(log_prob - rollout.log_prob, 0.0)), 1.0)
    now = with_values(rollout, output.value)._replace(log_prob=log_prob, vex=output.vex)
    advantage = advantages_over_all(now, hypers, config.truncation == "bootstrap", rho)
    rows = kept_rows(rollout.keep, config.rollout_steps)
    return_ = take(now.value + rho * advantage, rows)
    batch = flat_batch(now, rows, take(advantage, rows), return_, config, target)
    return batch._replace(importance=take(rho, rows).ravel())
