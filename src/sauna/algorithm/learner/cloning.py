"""Behaviour cloning: a policy of largest likelihood, and the values of what was played.

The loss of `B` rows is `-mean(log pi(a|s)) + c1 mean((V(s) - G)^2) / mean(G^2)`, with `c1` the
weight of PPO's value loss and the last mean over all rows, so that no scale of rewards lets one
term drown the other. Its optimizer is Adam (Pomerleau 1991; the policy term is that of the package
`imitation`). `G` is the discounted sum of the rewards up to the end of the episode. Behind an end
that is no termination, the value goes on: `gamma^k V(s_end)` of today's network is added, where `k`
env steps are left.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from sauna.algorithm.policy.bounded import to_env
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.types import Array
from sauna.config.settings import Config

BATCH = 64  # rows of a gradient step
CHUNK = 1024  # rows of one call of the network outside of gradient steps


class Rows(NamedTuple):
    """`M` env steps of `E` episodes."""

    observation: Any  # [M, *obs] as the network gets it
    action: Any  # [M, A]
    return_: Any  # [M] float32, of the rewards up to the end
    discount: Any  # [M] float32, of the value at the end; 0 after a termination
    episode: Any  # [M] int32, index into `final`
    final: Any  # [E, *obs] as the network gets it


class Fit(NamedTuple):
    """How well a policy fits rows that it was not fitted to; scalars."""

    loss: Array
    log_likelihood: Array  # mean log-probability of the actions
    agreement: Array  # share of rows whose mode is the action; continuous: explained variance
    value_error: Array  # root of mean((V - G)^2) / mean(G^2)


class State(NamedTuple):
    params: Array  # [D]
    optimizer: Any


class Cloner(NamedTuple):
    """The compiled functions of cloning.

    Attributes:
      start: `params [D] -> State`.
      epoch: `(state, rows, order [steps, B]) -> (State, loss)`, a pass over the rows.
      fit: `(params, rows) -> Fit`.
    """

    start: Callable[[Array], State]
    epoch: Callable[[State, Rows, Any], tuple[State, Array]]
    fit: Callable[[Array, Rows], Fit]


def make_cloner(config: Config, policy: Policy, value_coef: float) -> Cloner:
    """Builds (without compiling) what a policy is cloned by."""
    optimizer = optax.adam(config.clone_learning_rate)
    how: dict[str, Any] = {"policy": policy, "value_coef": value_coef}
    return Cloner(
        lambda params: State(params, optimizer.init(params)),
        jax.jit(partial(_epoch, optimizer=optimizer, **how)),
        jax.jit(partial(_fit, **how)),
    )


def _targets(params: Array, rows: Rows, policy: Policy) -> Array:
    """`G` `[M]`; no gradient goes through it."""
    values = jax.lax.map(lambda one: policy.apply(params, one).value, rows.final, batch_size=CHUNK)
    return rows.return_ + rows.discount * values[rows.episode]


def _scale(target: Array) -> Array:
    """`mean(G^2)`; 1 if no reward was ever given."""
    square = jnp.mean(target**2)
    return jnp.where(square > 0, square, 1.0)


def _epoch(
    state: State,
    rows: Rows,
    order: Array,
    *,
    optimizer: optax.GradientTransformation,
    policy: Policy,
    value_coef: float,
) -> tuple[State, Array]:
    target = _targets(state.params, rows, policy)
    scale = _scale(target)

    def loss(params: Array, chosen: Array) -> Array:
        output = policy.apply(params, rows.observation[chosen])
        log_prob = policy.distribution.log_prob(output.policy, rows.action[chosen])
        error = jnp.mean((output.value - target[chosen]) ** 2) / scale
        return value_coef * error - jnp.mean(log_prob)

    def step(state: State, chosen: Array) -> tuple[State, Array]:
        now, gradient = jax.value_and_grad(loss)(state.params, chosen)
        change, moments = optimizer.update(gradient, state.optimizer)
        return State(optax.apply_updates(state.params, change), moments), now

    state, losses = jax.lax.scan(step, state, order)
    return state, jnp.mean(losses)


def _fit(params: Array, rows: Rows, *, policy: Policy, value_coef: float) -> Fit:
    distribution, target = policy.distribution, _targets(params, rows, policy)

    def one(pair: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        output = policy.apply(params, pair[0])
        mode = distribution.mode(output.policy)
        return distribution.log_prob(output.policy, pair[1]), output.value, mode

    pairs = rows.observation, rows.action
    log_prob, value, mode = jax.lax.map(one, pairs, batch_size=CHUNK)
    if rows.action.dtype == jnp.int32:
        agreement = jnp.mean(jnp.all(mode == rows.action, -1))
    else:
        agreement = _explained(to_env(distribution, rows.action), to_env(distribution, mode))
    error = jnp.mean((value - target) ** 2) / _scale(target)
    likelihood = jnp.mean(log_prob)
    return Fit(value_coef * error - likelihood, likelihood, agreement, jnp.sqrt(error))


def _explained(true: Array, guess: Array) -> Array:
    """`1 - sum((x - y)^2) / sum((x - mean x)^2)` of `[M, A]`; 0 if `x` is constant.

    A spread that the mean's rounding makes is none.
    """
    spread = jnp.sum((true - jnp.mean(true, 0)) ** 2)
    varies = spread > 1e-10 * jnp.sum(true**2)
    share = jnp.sum((true - guess) ** 2) / jnp.where(varies, spread, 1.0)
    return jnp.where(varies, 1.0 - share, 0.0)


def clone_order(number: int, seed: int, epoch: int) -> np.ndarray:
    """The rows of an epoch's gradient steps `[steps, B]` int32; those left over are left out."""
    size = min(BATCH, number)
    order = np.random.default_rng([seed, 2**31, epoch]).permutation(number).astype(np.int32)
    return order[: number // size * size].reshape(-1, size)


def returns_to_go(
    reward: np.ndarray, length: np.ndarray, bootstrap: np.ndarray, gamma: float
) -> tuple[np.ndarray, np.ndarray]:
    """`G_t = r_t + gamma G_{t+1}` up to the end of each episode, and the discount of what follows.

    Args:
      reward: `[M]` of `E` episodes, one behind the other.
      length: `[E]` env steps of each.
      bootstrap: `[E]` whether its last value is bootstrapped.

    Returns:
      `G [M]` and `gamma^(steps left) [M]`, which is 0 if nothing goes on; float64.
    """
    returns, discounts, end = np.zeros(len(reward)), np.zeros(len(reward)), 0
    for steps, more in zip(length.tolist(), bootstrap.tolist(), strict=True):
        start, end, sum_ = end, end + steps, 0.0
        for t in range(end - 1, start - 1, -1):
            sum_ = float(reward[t]) + gamma * sum_
            returns[t] = sum_
        if more:
            discounts[start:end] = gamma ** np.arange(steps, 0, -1)
    return returns, discounts
