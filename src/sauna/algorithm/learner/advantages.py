"""Generalised advantage estimation (Schulman et al. 2016)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array


def gae(
    reward: Array,
    value: Array,
    next_value: Array,
    bootstrap: Array,
    not_last: Array,
    gamma: Array,
    gae_lambda: Array,
) -> Array:
    """Advantages of a stream in time order.

    `delta_t = r_t + gamma * bootstrap_t * next_value_t - value_t` and
    `A_t = delta_t + gamma * lambda * not_last_t * A_{t+1}`.

    Terminated and truncated differ here and only here: a truncated step bootstraps the value of its
    final observation (`bootstrap` 1) while nothing flows back over it (`not_last` 0).

    Args:
      reward, value: `[S, ...]`.
      next_value: `[S, ...]` value of each step's true successor.
      bootstrap: `[S, ...]` 0 where the successor is terminal.
      not_last: `[S, ...]` 0 at the last step of an episode and of the stream.
      gamma, gae_lambda: scalars.

    Returns:
      advantages `[S, ...]`; `advantage + value` is the lambda-return.
    """
    delta = reward + gamma * bootstrap * next_value - value

    def step(later: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_t, not_last_t = now
        advantage = delta_t + gamma * gae_lambda * not_last_t * later
        return advantage, advantage

    start = jnp.zeros_like(delta[0])
    return jax.lax.scan(step, start, (delta, not_last.astype(delta.dtype)), reverse=True)[1]
