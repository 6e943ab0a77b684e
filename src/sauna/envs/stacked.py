"""The last observations as one: one vector shows how things are, several show how they move.

Where an episode starts, its first observation stands for those before it, too. The oldest comes
first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces as gym

from sauna.envs.spaces import describe, observation_reader
from sauna.system.errors import BadInput


class StackedSpace(gym.Box):
    """`number` observations of a space, each flattened, side by side."""

    def __init__(self, space: Any, action_space: Any, number: int) -> None:
        spaces = describe(space, action_space)
        if spaces.picture_shapes:
            raise BadInput(
                "stack: pictures are not stacked; gymnasium.wrappers.FrameStackObservation does "
                "so, and Atari's come as four frames"
            )
        size = number * spaces.observation_shape[0]
        super().__init__(-np.inf, np.inf, (size,), np.float64)


def stacked_space(space: Any, action_space: Any, number: int) -> Any:
    """The space of stacked observations, unless it is one already.

    Raises:
      BadInput: the observations are pictures.
    """
    if isinstance(space, StackedSpace):
        return space
    return StackedSpace(space, action_space, number)


class StackedEnv:
    """An environment that shows its last `number` observations as one vector.

    Raises:
      BadInput: its observations are pictures.
    """

    def __init__(self, env: Any, number: int) -> None:
        self.env = env
        self.observation_space = StackedSpace(env.observation_space, env.action_space, number)
        self._read = observation_reader(env.observation_space)
        self._seen = np.zeros((number, self.observation_space.shape[0] // number))

    def reset(self, **how: Any) -> Any:
        answer = self.env.reset(**how)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            return answer  # refused by who reads it
        self._seen[:] = self._read(answer[0])
        return self._seen.reshape(-1).copy(), answer[1]

    def step(self, action: Any) -> Any:
        answer = self.env.step(action)
        if not (isinstance(answer, tuple) and len(answer) == 5):
            return answer
        self._seen[:-1] = self._seen[1:]
        self._seen[-1] = self._read(answer[0])
        return self._seen.reshape(-1).copy(), *answer[1:]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # also of a copy that is not complete yet
            raise AttributeError(name)
        return getattr(self.env, name)
