"""Small environments as pure functions. Importable by name, so that workers can make them."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from sauna import JaxEnv, Transition

LENGTH = 12


class State(NamedTuple):
    x: jax.Array
    steps: jax.Array
    key: jax.Array


def _observe(state: State) -> jax.Array:
    return jnp.stack([state.x, 0.1 * state.steps])


def reset(key: jax.Array) -> tuple[State, jax.Array]:
    key, own = jax.random.split(key)
    state = State(jax.random.normal(own), jnp.int32(0), key)
    return state, _observe(state)


def step(state: State, action: jax.Array) -> Transition:
    key, own = jax.random.split(state.key)
    x = state.x + 0.3 * action[0] + 0.2 * jax.random.normal(own)
    after = State(x, state.steps + 1, key)
    ended = jnp.abs(x) > 2.0
    return Transition(
        after, _observe(after), 1.0 - jnp.abs(x), ended, (after.steps >= LENGTH) & ~ended
    )


_BOX = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
_PUSH = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

# A random walk that ends beyond +-2 and is cut off after 12 steps.
walk = JaxEnv(reset, step, _BOX, _PUSH)


def make_walk(limit: float = 2.0) -> JaxEnv:
    def near(state: State, action: jax.Array) -> Transition:
        told = step(state, action)
        ended = jnp.abs(told.state.x) > limit
        return told._replace(terminated=ended, truncated=(told.state.steps >= LENGTH) & ~ended)

    return walk._replace(step=near)


def _always_one(state: State, action: jax.Array) -> Transition:
    told = step(state, action)
    return told._replace(
        observation=jnp.ones(2),
        reward=jnp.float32(1.0),
        terminated=jnp.bool_(False),
        truncated=told.state.steps >= 2,
    )


# Reward 1 for ever, one observation, cut off every other step: V is 1 / (1 - gamma).
cut_off = walk._replace(
    reset=lambda key: (reset(key)[0], jnp.ones(2)), step=_always_one, action_space=_PUSH
)


def _breaks(state: State, action: jax.Array) -> Transition:
    told = step(state, action)
    return told._replace(reward=jnp.where(told.state.steps == 5, jnp.nan, told.reward))


broken = walk._replace(step=_breaks)


def _starts_nowhere(key: jax.Array) -> tuple[State, jax.Array]:
    state, observation = reset(key)
    return state, observation * jnp.nan


broken_start = walk._replace(reset=_starts_nowhere)


def no_env(**kwargs: Any) -> int:
    return 3
