"""Environments that speak Brax's language: a state with `obs`, `reward`, `done`.

Brax and MuJoCo Playground leave the time limit, repeated actions and resets to wrappers of their
own; here only the environment itself is used, and the rest is ours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from sauna.envs.device.contract import JaxEnv, Transition, ended_where_broken
from sauna.system.errors import BadInput


class State(NamedTuple):
    """The environment's own state and the env steps of the running episode."""

    inner: Any
    steps: jax.Array  # [] int32


def from_brax(
    env: Any,
    episode_length: int,
    action_repeat: int = 1,
    render: Callable[[Any], Any] | None = None,
    frames_per_second: float = 30.0,
) -> JaxEnv:
    """Args:
      env: with `reset(key)`, `step(state, action)`, `observation_size`, `action_size`.
      episode_length: physics control steps until the time limit.
      action_repeat: control steps per env step; their rewards are added up.

    Raises:
      BadInput: observations are several arrays and none is called `state`.
    """
    size = env.observation_size
    if not isinstance(size, int) and "state" not in size:
        raise BadInput(f"env: observations {sorted(size)} are not supported; one named 'state' is")
    shape = (size,) if isinstance(size, int) else tuple(np.atleast_1d(size["state"]))
    limit = -(-episode_length // action_repeat)

    def seen(state: Any) -> jax.Array:
        return state.obs if isinstance(size, int) else state.obs["state"]

    def reset(key: jax.Array) -> tuple[State, jax.Array]:
        with jax.default_matmul_precision("highest"):
            inner = env.reset(key)
        return State(inner, jnp.int32(0)), seen(inner)

    def step(state: State, action: jax.Array) -> Transition:
        inner, reward = state.inner, jnp.float32(0.0)
        with jax.default_matmul_precision("highest"):
            for _ in range(action_repeat):
                inner = env.step(inner, action)
                reward += inner.reward
        steps = state.steps + 1
        transition = Transition(
            State(inner, steps),
            seen(inner),
            reward,
            inner.done > 0,
            jnp.asarray(steps >= limit),
            inner.metrics,
        )
        return ended_where_broken(transition)

    unbounded = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
    actions = gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
    shown = None if render is None else lambda state: render(state.inner)
    return JaxEnv(reset, step, unbounded, actions, shown, frames_per_second)
