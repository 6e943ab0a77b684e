"""Any environment of the accelerator as an ordinary Gymnasium environment.

Evaluation, videos and other people's trainers meet the same functions that training compiles.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np

from sauna.envs.device.contract import JaxEnv, Transition, numbers_in

# `split(key)[i]` is `fold_in(key, i)`: whoever plays an episode folds its env steps into the same
# seed's key for the actions, and those must not be what the reset draws from.
_RESET = 2**31


class HostFace(gymnasium.Env):
    """One environment, its two functions compiled for this machine's CPU."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, env: JaxEnv, render_mode: str | None = None) -> None:
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.render_mode, self._env = render_mode, env
        self.metadata = {**HostFace.metadata, "render_fps": env.frames_per_second}
        self._reset, self._step = jax.jit(env.reset), jax.jit(self._compiled_step)
        self._state: Any = None
        self.action_masks = None if env.action_mask is None else self._mask

    def _mask(self) -> np.ndarray:
        """Which actions are valid now."""
        assert self._env.action_mask is not None
        return np.asarray(self._env.action_mask(self._state))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Without a seed, the episode is drawn from the generator that the last seed began."""
        super().reset(seed=seed)
        drawn = seed if seed is not None else int(self.np_random.integers(2**31))
        key = jax.random.fold_in(jax.random.key(drawn), _RESET)
        self._state, observation = self._reset(key)
        return self._read(observation), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        transition = self._step(self._state, action)
        self._state = transition.state
        truncated = bool(transition.truncated) and not bool(transition.terminated)
        seen = self._read(transition.observation)
        info = {name: float(number) for name, number in transition.info.items()}
        return seen, float(transition.reward), bool(transition.terminated), truncated, info

    def _compiled_step(self, state: Any, action: Any) -> Transition:
        transition = self._env.step(state, action)
        return transition._replace(info=numbers_in(transition.info))

    def _read(self, observation: Any) -> Any:
        return jax.tree.map(np.asarray, observation)

    @property
    def is_drawn(self) -> bool:
        """Whether it has pictures."""
        return self._env.render is not None

    def render(self) -> Any:
        if self.render_mode is None or self._env.render is None:
            return None
        return self._env.render(self._state)
