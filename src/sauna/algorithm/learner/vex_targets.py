"""Vex targets: the explained variance that the third head learns to predict.

A target is one pure function of returns and values. Targets of a rollout are computed once per
iteration, before the first epoch; the released code's is computed inside each minibatch.

Everything is guarded: where the returns do not vary, there is nothing to explain and the target
is 0 (the released code divides by zero there).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array
from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.system.errors import BadInput

CLIP_BELOW = -5.0  # of the per-sample target, whose lower tail is unbounded
# Variance over mean square below which equal float32 returns differ by rounding only.
ROUNDING = 1e-8


class VexTarget(NamedTuple):
    """`target(return_, value, weight, episode) -> target`, all arrays of one shape.

    Attributes:
      target: on `[T, N]` arrays of a rollout, or on `[B]` arrays of a minibatch. `return_` is the
        lambda-return, `value` V at collection, `weight` 1 or 0 (slots to leave out), `episode` an
        int32 that numbers an env's episodes 0, 1, ... (all 0 in a minibatch).
      per_minibatch: computed on each minibatch instead of once per rollout.
    """

    target: Callable[[Array, Array, Array, Array], Array]
    per_minibatch: bool = False


def _mean(x: Array, weight: Array) -> Array:
    """Weighted mean over the first axis, keeping it."""
    return jnp.sum(x * weight, 0, keepdims=True) / jnp.maximum(
        jnp.sum(weight, 0, keepdims=True), 1.0
    )


def _explained(unexplained: Array, variance: Array, mean_square: Array) -> Array:
    """`1 - unexplained / variance`, and 0 where the returns vary by rounding alone."""
    varies = variance > ROUNDING * mean_square
    return jnp.where(varies, 1.0 - unexplained / jnp.where(varies, variance, 1.0), 0.0)


def rollout_target(return_: Array, value: Array, weight: Array, episode: Array) -> Array:
    """Eq. 5 over each actor's buffer: one number for all states of a column of `[T, N]`."""
    variance = _mean((return_ - _mean(return_, weight)) ** 2, weight)
    unexplained = _mean((return_ - value) ** 2, weight)
    explained = _explained(unexplained, variance, _mean(return_**2, weight))
    return jnp.broadcast_to(explained, return_.shape)


def minibatch_target(return_: Array, value: Array, weight: Array, episode: Array) -> Array:
    """`1 - Var(R - V_old) / Var(R)` over `[B]`, as `model.py` of the released code has it.

    A constant error of V costs nothing here, unlike in eq. 5.
    """
    residual = return_ - value
    unexplained = _mean((residual - _mean(residual, weight)) ** 2, weight)
    variance = _mean((return_ - _mean(return_, weight)) ** 2, weight)
    explained = _explained(unexplained, variance, _mean(return_**2, weight))
    return jnp.broadcast_to(explained, return_.shape)


def episode_target(return_: Array, value: Array, weight: Array, episode: Array) -> Array:
    """Eq. 5 over each segment of one episode inside a column of `[T, N]`."""

    def column(return_: Array, value: Array, weight: Array, episode: Array) -> Array:
        length = return_.shape[0]

        def over_segment(x: Array) -> Array:
            total = jax.ops.segment_sum(x * weight, episode, length)
            number = jax.ops.segment_sum(weight, episode, length)
            return (total / jnp.maximum(number, 1.0))[episode]

        variance = over_segment((return_ - over_segment(return_)) ** 2)
        unexplained = over_segment((return_ - value) ** 2)
        return _explained(unexplained, variance, over_segment(return_**2))

    return jax.vmap(column, in_axes=1, out_axes=1)(return_, value, weight, episode)


def sample_target(return_: Array, value: Array, weight: Array, episode: Array) -> Array:
    """Each state's share of eq. 5: `1 - (R_t - V(s_t))^2 / Var(R)`, clipped to [-5, 1].

    Its mean over a column is eq. 5 as long as nothing is clipped, and the head can differ between
    states.
    """
    variance = _mean((return_ - _mean(return_, weight)) ** 2, weight)
    explained = _explained((return_ - value) ** 2, variance, _mean(return_**2, weight))
    return jnp.clip(explained, CLIP_BELOW, 1.0)


TARGETS = {
    "rollout": VexTarget(rollout_target),
    "minibatch": VexTarget(minibatch_target, per_minibatch=True),
    "episode": VexTarget(episode_target),
    "sample": VexTarget(sample_target),
}


def make_target(config: Config) -> VexTarget:
    """The target that `config` names.

    Raises:
      BadInput: a user's `module:name` is something else.
    """
    if config.vex_target in TARGETS:
        return TARGETS[config.vex_target]
    target = import_name("vex_target", config.vex_target)
    if not isinstance(target, VexTarget):
        raise BadInput(f"vex_target: {config.vex_target} is not a sauna.VexTarget")
    return target
