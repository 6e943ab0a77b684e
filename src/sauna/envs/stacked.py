"""The last observations as one: one shows how things are, several show how they move.

Vectors stand side by side, and so do the channels of pictures. The oldest comes first. At the start
of an episode, its first observation stands for those before it, too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces as gym

from sauna.envs.pictures import channels_first
from sauna.envs.spaces import PICTURES, describe, observation_reader
from sauna.system.errors import BadInput


class StackedSpace(gym.Box):
    """`number` observations `[D]` as `[number * D]`, or pictures `[H, W, C]` as
    `[H, W, number * C]`."""

    def __init__(self, space: Any, action_space: Any, number: int) -> None:
        spaces = describe(space, action_space)
        if spaces.pictures:
            raise BadInput("stack: a Dict or Tuple with pictures is not stacked")
        *rest, last = spaces.observation_shape
        shape = (*rest, number * last)
        if channels_first(shape):
            raise BadInput(
                f"stack: {shape[2]} channels of {shape[0]} x {shape[1]} pixels would be read as "
                "a picture whose channels come first"
            )
        if spaces.observation_kind in PICTURES:
            super().__init__(0, space.high.max(), shape, space.dtype)
        else:
            super().__init__(-np.inf, np.inf, shape, np.float64)


def stacked_space(space: Any, action_space: Any, number: int) -> Any:
    """The space of stacked observations, unless it is one already.

    Raises:
      BadInput: the observations cannot be stacked.
    """
    if isinstance(space, StackedSpace):
        return space
    return StackedSpace(space, action_space, number)


class StackedEnv:
    """An environment that shows its last `number` observations as one.

    Raises:
      BadInput: its observations cannot be stacked.
    """

    def __init__(self, env: Any, number: int) -> None:
        self.env = env
        self.observation_space = StackedSpace(env.observation_space, env.action_space, number)
        self._read = observation_reader(env.observation_space)
        self._seen = np.zeros(self.observation_space.shape, self.observation_space.dtype)
        shape = self._seen.shape
        self._number, self._shape = number, (*shape[:-1], shape[-1] // number)

    def reset(self, **how: Any) -> Any:
        answer = self.env.reset(**how)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            return answer  # refused by who reads it
        self._seen[:] = np.tile(self._one(answer[0]), self._number)  # along the last axis
        return self._seen.copy(), answer[1]

    def step(self, action: Any) -> Any:
        answer = self.env.step(action)
        if not (isinstance(answer, tuple) and len(answer) == 5):
            return answer
        new = self._shape[-1]
        self._seen[..., :-new] = self._seen[..., new:]
        self._seen[..., -new:] = self._one(answer[0])
        return self._seen.copy(), *answer[1:]

    def _one(self, observation: Any) -> np.ndarray:
        """Reads one observation; another shape must not be stretched to fit.

        Raises:
          ValueError: its shape is another one.
        """
        read = np.asarray(self._read(observation))
        if read.shape != self._shape:
            raise ValueError(f"an observation is of shape {read.shape} instead of {self._shape}")
        return read

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # also of a copy that is not complete yet
            raise AttributeError(name)
        return getattr(self.env, name)
