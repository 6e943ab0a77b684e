"""The data that flows through one iteration, as declared types.

Axes: `S` env steps tried in a rollout, `T` kept steps per env, `N` envs of one member, `B` samples
of a minibatch. Everything here belongs to one member; only `population.py` knows of several.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

Array = jax.Array
Params = Any  # a flax parameter pytree


class Hypers(NamedTuple):
    """Traced hyperparameters, float32 scalars: members that differ in them share one program."""

    learning_rate: Array  # of this iteration, after its schedule
    clip_range: Array
    gamma: Array
    gae_lambda: Array
    entropy_coef: Array
    value_coef: Array
    vex_coef: Array  # c2 of eq. 6
    max_grad_norm: Array
    threshold: Array  # of eq. 7
    drop_rate: Array  # of this iteration


class Rollout(NamedTuple):
    """The full stream of one member's iteration, in time order.

    Env n acted in its first `valid[:, n].sum()` rows; the rows behind are padding.
    """

    observation: Array  # [S, N, ...] normalised float32, or uint8 images
    action: Array  # [S, N, A] float32 (continuous, unclipped) or int32
    log_prob: Array  # [S, N] float32
    reward: Array  # [S, N] float32, normalised
    value: Array  # [S, N] float32, V(s_t) at collection
    next_value: Array  # [S, N] float32, V of the true successor (the final observation at an end)
    vex: Array  # [S, N] float32, the Vex head at s_t
    terminated: Array  # [S, N] bool
    truncated: Array  # [S, N] bool
    valid: Array  # [S, N] bool
    keep: Array  # [S, N] bool, the filter's decision; False on padding


class Batch(NamedTuple):
    """What the update learns from: the kept steps of one rollout, flattened to `T * N` samples."""

    observation: Array  # [T * N, ...]
    action: Array  # [T * N, A]
    log_prob: Array  # [T * N]
    advantage: Array  # [T * N]
    return_: Array  # [T * N]
    value: Array  # [T * N]
    vex_target: Array  # [T * N]; not read when the target is computed per minibatch
    weight: Array  # [T * N] 1, or 0 for a slot that stayed empty or a masked step


class TrainState(NamedTuple):
    """What learning changes. Parameters are one flat vector, so that a step is a few vector ops."""

    params: Array  # [D] float32, the raveled parameter pytree
    optimizer: Any  # optax's ScaleByAdamState (count int32, mu [D], nu [D]) or ScaleByRmsState


class PolicyOutput(NamedTuple):
    """The network at one observation."""

    policy: Array  # [..., K] parameters of the action distribution
    value: Array  # [...]
    vex: Array  # [...]


class Keys(NamedTuple):
    """The JAX keys of one member; each use folds in the iteration, so that no key is stored."""

    init: Array
    action: Array
    filter: Array
    env: Array  # of environments on the accelerator; a host environment has a seed per episode
    order: Array  # of minibatches drawn on the accelerator; see `minibatch_order`


def member_keys(seed: int) -> Keys:
    """Keys that depend on the member's seed alone."""
    root = jax.random.key(seed)
    init, action, filter = jax.random.split(root, 3)
    return Keys(init, action, filter, jax.random.fold_in(root, 3), jax.random.fold_in(root, 4))


class Filter(NamedTuple):
    """`init(num_envs, capacity) -> state`, `keep(state, ...) -> (state, mask [N])`."""

    init: Callable[[int, int], Any]
    keep: Callable[[Any, Array, Array, Array, Hypers], tuple[Any, Array]]
