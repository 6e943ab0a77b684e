"""The compiled functions of collecting; `act` takes all members of a process at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.policy.policy import (
    Policy,
    act,
    act_with_state,
    make_policy,
    score,
    score_with_state,
)
from sauna.algorithm.selection.registry import make_filter
from sauna.algorithm.types import Array, Hypers, ScoredStep, StepFilter
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces


class Program(NamedTuple):
    """The compiled functions of one static config that act, score and decide.

    `act` takes a leading member axis `P` on every argument; the others take one member. On CPU a
    member's numbers must not depend on its neighbours, so members are never batched into one
    matrix product: `act` maps over them.

    Of a recurrent policy, `act` takes and gives states instead of giving scores, `score` takes what
    `score_with_state` does, and `value` takes states.
    """

    config: Config
    policy: Policy
    filter: StepFilter | None
    draw: Callable[[Array, Any, Any], Array]
    act: Callable[..., Any]
    score: Callable[..., Array]
    value: Callable[..., Array]
    decide: Callable[..., tuple[Any, Array]]


def map_members(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of one member, over a leading axis of members, one after the other.

    Not a `vmap`: a batched product rounds differently for 6 members than for 1, and training
    amplifies the difference.
    """
    return lambda *arguments: jax.lax.map(lambda x: function(*x), arguments)


def make_program(config: Config, spaces: Spaces) -> Program:
    """Builds (without compiling) what members with this static config collect by."""
    policy = make_policy(config, spaces)
    filter = make_filter(config)
    recurrent = policy.state_size > 0
    acting, scoring = (act_with_state, score_with_state) if recurrent else (act, score)
    return Program(
        config=config,
        policy=policy,
        filter=filter,
        draw=jax.jit(partial(draw_noise, policy, config)),
        act=jax.jit(map_members(partial(acting, policy))),
        score=jax.jit(partial(scoring, policy)),
        value=jax.jit(partial(_value, policy)),
        decide=jax.jit(partial(decide, filter)) if filter else _nothing_to_decide,
    )


def _value(policy: Policy, params: Array, observation: Array, state: Any = ()) -> Array:
    return policy.step(params, observation, state)[0].value


def draw_noise(
    policy: Policy, config: Config, root: Array, iteration: Array, block: Array
) -> Array:
    """Action noise `[T / hold, N, M]`, rounded up, of the rollout's rows from `block * T` on."""
    key = jax.random.fold_in(jax.random.fold_in(root, iteration), block)
    return policy.distribution.draw(key, (-(-config.rollout_steps // policy.hold), config.envs))


def _nothing_to_decide(*arguments: Any) -> tuple[Any, Array]:
    raise AssertionError("a program without a filter keeps every step")


def decide(
    filter: StepFilter,
    state: Any,
    steps: ScoredStep,
    first: Array,
    length: Array,
    key: Array,
    hypers: Hypers,
) -> tuple[Any, Array]:
    """Runs a filter over a segment of consecutive env steps.

    Args:
      steps: fields `[L, N, ...]`, of which the first `length` rows count.
      first: index of the segment's first step within the rollout.
      key: the rollout's filter key; step t uses `fold_in(key, t)`.

    Returns:
      the filter's state after the segment, and the mask `[L, N]` (False behind `length`).
    """

    def step(carry: tuple[Array, Any, Array]) -> tuple[Array, Any, Array]:
        t, state, mask = carry
        step_key = jax.random.fold_in(key, first + t)
        now = jax.tree.map(lambda x: x[t], steps)
        state, kept = filter.keep(state, now, step_key, hypers)
        return t + 1, state, mask.at[t].set(kept)

    start = (jnp.int32(0), state, jnp.zeros(steps.vex.shape, bool))
    _, state, mask = jax.lax.while_loop(lambda carry: carry[0] < length, step, start)
    return state, mask
