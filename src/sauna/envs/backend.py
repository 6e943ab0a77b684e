"""Which host backend steps an environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sauna.envs.gymnasium import GymnasiumEnvs, env_maker


def in_process_envs(
    env: str, env_kwargs: dict[str, Any], seeds: Sequence[tuple[int, int]], backend: str
) -> GymnasiumEnvs:
    """M environments stepped in this process, by the fastest backend that gives the same bits.

    Args:
      env, env_kwargs: what is made; see `env_maker`.
      seeds: `(member seed, env index)` of each environment.
      backend: `auto`, or `gymnasium` to have every step taken by Gymnasium itself.
    """
    make = env_maker(env, env_kwargs)
    if backend == "auto" and env.startswith("ALE/"):
        from sauna.envs.atari import AtariEnvs

        return AtariEnvs(make, seeds)
    if backend == "auto" and is_mujoco(env):
        from sauna.envs.mujoco import MujocoEnvs, time_limit

        first = make()
        fits = time_limit(first) is not None
        first.close()
        if fits:
            return MujocoEnvs(make, seeds)
    return GymnasiumEnvs(make, seeds)


def is_mujoco(env: str) -> bool:
    """Whether a registered environment's class is one of Gymnasium's MuJoCo tasks."""
    import gymnasium

    spec = gymnasium.registry.get(env)
    return spec is not None and str(spec.entry_point).startswith("gymnasium.envs.mujoco")
