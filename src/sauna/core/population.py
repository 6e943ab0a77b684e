"""The members' axis. Everything else in `core/` is written for one member."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from sauna.config.settings import Config
from sauna.core.batch import make_batch
from sauna.core.policy import Policy, act, make_policy, score
from sauna.core.types import Array, Batch, Hypers, Rollout, TrainState
from sauna.core.update import UpdateMetrics, init_state, learn
from sauna.envs.spaces import Spaces
from sauna.selection.filters import Filter, decide, make_filter
from sauna.selection.vex import make_target


class Program(NamedTuple):
    """The compiled functions of one static config.

    `act` takes a leading member axis `P` on every argument; the others take one member. On CPU a
    member's numbers must not depend on its neighbours, so members are never batched into one
    matrix product: `act` maps over them, and updates are called one by one.
    """

    config: Config
    policy: Policy
    filter: Filter | None
    init: Callable[[Array], TrainState]
    draw: Callable[[Array, Any, Any], Array]
    act: Callable[[Array, Any, Any], Array]
    score: Callable[[Any, Any, Any], Array]
    value: Callable[[Any, Any], Array]
    decide: Callable[..., tuple[Any, Array]]
    make_batch: Callable[[Rollout, Hypers], Batch]
    learn: Callable[[TrainState, Rollout, Batch, Hypers, Any], tuple[TrainState, UpdateMetrics]]


def map_members(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of one member, over a leading axis of members, one after the other.

    Not a `vmap`: a batched product rounds differently for 6 members than for 1, and training
    amplifies the difference.
    """
    return lambda *arguments: jax.lax.map(lambda x: function(*x), arguments)


def make_program(config: Config, spaces: Spaces) -> Program:
    """Builds (without compiling) everything that members with this static config run."""
    policy, target = make_policy(config, spaces), make_target(config)
    filter = make_filter(config)
    return Program(
        config=config,
        policy=policy,
        filter=filter,
        init=jax.jit(partial(init_state, config, policy)),
        draw=jax.jit(partial(draw_noise, policy, config)),
        act=jax.jit(map_members(partial(act, policy))),
        score=jax.jit(partial(score, policy)),
        value=jax.jit(lambda params, observation: policy.apply(params, observation).value),
        decide=jax.jit(partial(decide, filter)) if filter else _nothing_to_decide,
        make_batch=jax.jit(partial(make_batch, config=config, target=target)),
        learn=jax.jit(
            partial(learn, config=config, policy=policy, target=target), donate_argnums=(0,)
        ),
    )


def draw_noise(
    policy: Policy, config: Config, root: Array, iteration: Array, block: Array
) -> Array:
    """Action noise `[T, N, M]` of the rollout's rows from `block * T` on."""
    key = jax.random.fold_in(jax.random.fold_in(root, iteration), block)
    return policy.distribution.draw(key, (config.rollout_steps, config.envs))


def _nothing_to_decide(*arguments: Any) -> tuple[Any, Array]:
    raise AssertionError("a program without a filter keeps every step")


class Keys(NamedTuple):
    """The JAX keys of one member; each use folds in the iteration, so that no key is stored."""

    init: Array
    action: Array
    filter: Array
    env: Array  # of environments on the accelerator; a host environment has a seed per episode
    order: Array  # of minibatches drawn on the accelerator; see `minibatch_order`


def minibatch_order(config: Config, seed: int, iteration: int) -> np.ndarray:
    """The order of the samples in every epoch of an update, `[epochs, T * N]` int32."""
    samples = np.arange(config.rollout_steps * config.envs, dtype=np.int32)
    generator = np.random.default_rng([seed, iteration])
    return generator.permuted(np.tile(samples, (config.epochs, 1)), axis=1)


def member_keys(seed: int) -> Keys:
    """Keys that depend on the member's seed alone."""
    root = jax.random.key(seed)
    init, action, filter = jax.random.split(root, 3)
    return Keys(init, action, filter, jax.random.fold_in(root, 3), jax.random.fold_in(root, 4))
