"""Environments that the zoo does not know, for the presets that are picked by the spaces."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

CELLS, PIXELS = 5, 8  # of a side of the board, of a side of a cell


class Catch(gymnasium.Env[np.ndarray, int]):
    """A ball falls, one row a step, and a paddle at the bottom moves a cell left or right, or not.

    An observation is a picture `[40, 40, 1]`. The reward at the end is 1 if the paddle is under the
    ball, and -1 if not.
    """

    def __init__(self) -> None:
        side = CELLS * PIXELS
        self.observation_space = spaces.Box(0, 255, (side, side, 1), np.uint8)
        self.action_space = spaces.Discrete(3)
        self._row = self._ball = self._paddle = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._row = 0
        self._ball, self._paddle = map(int, self.np_random.integers(CELLS, size=2))
        return self._seen(), {}

    def step(self, action: int) -> Any:
        self._paddle = min(max(self._paddle + int(action) - 1, 0), CELLS - 1)
        self._row += 1
        ended = self._row == CELLS - 1
        reward = 0.0 if not ended else 1.0 if self._ball == self._paddle else -1.0
        return self._seen(), reward, ended, False, {}

    def _seen(self) -> np.ndarray:
        board = np.zeros((CELLS, CELLS, 1), np.uint8)
        board[self._row, self._ball] = board[-1, self._paddle] = 255
        return board.repeat(PIXELS, 0).repeat(PIXELS, 1)


def long_swimmer() -> gymnasium.Env[Any, Any]:
    """Makes Swimmer with episodes of 2000 steps, twice as many as usual."""
    return gymnasium.make("Swimmer-v5", max_episode_steps=2000)
