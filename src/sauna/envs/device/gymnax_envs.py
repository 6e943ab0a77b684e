"""gymnax environments: `gymnax/CartPole-v1`, `gymnax/Breakout-MinAtar`, ..."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np

from sauna.envs.device.contract import JaxEnv, Transition
from sauna.system.errors import BadInput
from sauna.system.imports import put_off

# gymnax imports them for its own pictures, and that takes longer than all the rest of it.
with put_off("matplotlib", "matplotlib.colors", "matplotlib.pyplot", "seaborn"):
    import gymnax
    from gymnax.environments import spaces


class State(NamedTuple):
    """gymnax's own state and the key that its steps draw from."""

    inner: Any
    key: jax.Array


def names() -> list[str]:
    return list(gymnax.registered_envs)


def make(name: str, **params: Any) -> JaxEnv:
    """`params` are fields of the environment's `EnvParams` (`max_steps_in_episode=200`)."""
    env, defaults = gymnax.make(name)
    for key in params:
        if not hasattr(defaults, key):
            raise BadInput(f"env_kwargs: {name} has no parameter {key!r}")
    fixed = defaults.replace(**params)

    def reset(key: jax.Array) -> tuple[State, jax.Array]:
        key, reset_key = jax.random.split(key)
        observation, inner = env.reset_env(reset_key, fixed)
        return State(inner, key), observation

    def step(state: State, action: jax.Array) -> Transition:
        key, step_key = jax.random.split(state.key)
        observation, inner, reward, terminated, info = env.step_env(
            step_key, state.inner, action, fixed
        )
        terminated = jax.numpy.asarray(terminated, bool)
        truncated = jax.numpy.asarray(env.is_truncated(inner, fixed), bool) & ~terminated
        info = {name: number for name, number in info.items() if name != "discount"}  # 0 at an end
        return Transition(State(inner, key), observation, reward, terminated, truncated, info)

    return JaxEnv(
        reset, step, _space(env.observation_space(fixed)), _space(env.action_space(fixed))
    )


def _space(space: Any) -> gymnasium.Space:
    if isinstance(space, spaces.Discrete):
        return gymnasium.spaces.Discrete(int(space.n))
    if isinstance(space, spaces.Dict):
        parts = {name: _space(part) for name, part in space.spaces.items()}
        return gymnasium.spaces.Dict(parts)
    low, high = (np.broadcast_to(np.asarray(x), space.shape) for x in (space.low, space.high))
    return gymnasium.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
