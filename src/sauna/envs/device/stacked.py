"""`envs.stacked.StackedEnv` for environments on the device."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from sauna.envs.device.contract import JaxEnv, State, Transition, _reader
from sauna.envs.stacked import StackedSpace


def stacked(env: JaxEnv, number: int) -> JaxEnv:
    """`env` showing its last `number` observations as one; they are a part of its state.

    Of one alone it is `env` itself.

    Raises:
      BadInput: its observations cannot be stacked.
    """
    if number == 1:
        return env
    read = _reader(env.observation_space)
    space = StackedSpace(env.observation_space, env.action_space, number)
    new = space.shape[-1] // number

    def reset(key: Array) -> tuple[State, Array]:
        state, observation = env.reset(key)
        seen = jnp.tile(read(observation), number)  # along the last axis
        return (state, seen), seen

    def step(state: State, action: Any) -> Transition:
        inner, seen = state
        transition = env.step(inner, action)
        seen = jnp.concatenate([seen[..., new:], read(transition.observation)], -1)
        return transition._replace(state=(transition.state, seen), observation=seen)

    def of_inner(function: Any) -> Any:
        return None if function is None else lambda state: function(state[0])

    return env._replace(
        reset=reset,
        step=step,
        observation_space=space,
        render=of_inner(env.render),
        action_mask=of_inner(env.action_mask),
    )
