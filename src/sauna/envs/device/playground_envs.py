"""MuJoCo Playground: `playground/CheetahRun`, `playground/HumanoidRun`, ..."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mujoco_playground import registry

from sauna.envs.device.brax_like import from_brax
from sauna.envs.device.contract import JaxEnv


def names() -> list[str]:
    return list(registry.ALL_ENVS)


def own_config(name: str, overrides: Mapping[str, Any]) -> Any:
    """The task's config; `overrides` name its keys, with dots where it is nested."""
    own = registry.get_default_config(name)
    # The JAX implementation needs no further package and runs on every machine.
    own.update_from_flattened_dict({"impl": "jax", **overrides})
    return own


def make(name: str, **overrides: Any) -> JaxEnv:
    """`overrides` are keys of the task's own config (`episode_length`, `impl="warp"`, ...)."""
    own = own_config(name, overrides)
    env = registry.load(name, config=own)

    def render(state: Any) -> Any:
        return env.render([state])[0]

    return from_brax(env, own.episode_length, own.action_repeat, render, 1.0 / env.dt)
