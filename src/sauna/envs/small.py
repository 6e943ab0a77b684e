"""Two small environments of our own: one with many invalid actions, one of a picture and numbers.

The studies `invalid-actions` and `picture-and-numbers` train on them.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

SIDE = 5  # squares of the board's side
JUMPS = ((1, 2), (2, 1), (2, -1), (1, -2), (-1, -2), (-2, -1), (-2, 1), (-1, 2))


class KnightsTour(gymnasium.Env):
    """A knight visits as many squares of a 5 x 5 board as it can, each once; 1 for each.

    An action names the square to jump to. At most 8 of the 25 can be reached, and none twice. An
    invalid action ends the episode, as does a square from which nothing can be reached.
    """

    observation_space = spaces.MultiBinary(2 * SIDE * SIDE)  # visited squares, and the knight's
    action_space = spaces.Discrete(SIDE * SIDE)

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._visited = np.zeros(SIDE * SIDE, np.int8)
        self._jump(int(self.np_random.integers(SIDE * SIDE)))
        return self._seen(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if not self.action_masks()[action]:
            return self._seen(), 0.0, True, False, {}
        self._jump(int(action))
        return self._seen(), 1.0, not self.action_masks().any(), False, {}

    def action_masks(self) -> np.ndarray:
        """Which squares the knight can jump to."""
        row, column = divmod(self._square, SIDE)
        mask = np.zeros((SIDE, SIDE), bool)
        for down, right in JUMPS:
            if 0 <= row + down < SIDE and 0 <= column + right < SIDE:
                mask[row + down, column + right] = True
        return mask.ravel() & (self._visited == 0)

    def _jump(self, square: int) -> None:
        self._square = square
        self._visited[square] = 1

    def _seen(self) -> np.ndarray:
        here = np.zeros(SIDE * SIDE, np.int8)
        here[self._square] = 1
        return np.concatenate([self._visited, here])


PIXELS = 36
STEPS = 16


class Signpost(gymnasium.Env):
    """Name the corner that a picture and a number point to together; 1 if it is right.

    The picture has a bright corner. The number says how many corners further on, clockwise, is the
    right one, from 0 to 3. Neither says anything by itself.

    Args:
      shows: `both`, or `picture` or `number` alone, with which nobody can do better than 1 in 4.
    """

    action_space = spaces.Discrete(4)

    def __init__(self, shows: str = "both") -> None:
        parts: dict[str, spaces.Space] = {
            "picture": spaces.Box(0, 255, (PIXELS, PIXELS, 1), np.uint8),
            "number": spaces.Box(0.0, 3.0, (1,), np.float32),
        }
        self.observation_space = spaces.Dict(
            {name: part for name, part in parts.items() if shows in ("both", name)}
        )

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._turn(), {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        reward = float(action == (self._corner + self._further) % 4)
        self._steps += 1
        return self._turn(), reward, self._steps == STEPS, False, {}

    def _turn(self) -> dict[str, np.ndarray]:
        self._corner, self._further = (int(n) for n in self.np_random.integers(4, size=2))
        picture = self.np_random.integers(0, 64, (PIXELS, PIXELS, 1), np.uint8)
        down, right = ((0, 0), (0, 1), (1, 1), (1, 0))[self._corner]
        half = PIXELS // 2
        picture[half * down : half * (down + 1), half * right : half * (right + 1)] += 160
        seen = {"picture": picture, "number": np.array([self._further], np.float32)}
        return {name: seen[name] for name in self.observation_space.spaces}
