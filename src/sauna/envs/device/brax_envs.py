"""Brax's own environments: `brax/ant`, `brax/humanoid`, ..."""

from __future__ import annotations

from typing import Any

from brax import envs

from sauna.envs.device.brax_like import from_brax
from sauna.envs.device.contract import JaxEnv


def names() -> list[str]:
    return list(envs._envs)


def make(name: str, episode_length: int = 1000, action_repeat: int = 1, **kwargs: Any) -> JaxEnv:
    """`kwargs` are the environment's own (`backend="mjx"`)."""
    env = envs.get_environment(name, **kwargs)

    def render(state: Any) -> Any:
        from brax.io import image

        return image.render_array(env.sys, state.pipeline_state, 240, 320)

    return from_brax(env, episode_length, action_repeat, render, 1.0 / float(env.dt))
