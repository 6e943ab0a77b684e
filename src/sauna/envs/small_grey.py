"""Large coloured pictures made small and grey, as RL Zoo does with CarRacing's.

`--wrap sauna.envs.small_grey:SmallGrey` puts it around the environments of a run.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

SIDE = 64  # pixels
BRIGHTNESS = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green and blue (ITU-R BT.601)


def shares(before: int, after: int) -> np.ndarray:
    """The share `[after, before]` that each pixel of a longer line has in each of a shorter one.

    A pixel of the shorter line is the mean of what it covers.
    """
    edges = np.linspace(0.0, before, after + 1)
    begin, end = np.maximum.outer(edges[:-1], np.arange(before)), edges[1:]
    covered = np.minimum.outer(end, np.arange(before) + 1.0) - begin
    return (np.maximum(covered, 0.0) * after / before).astype(np.float32)


class SmallGrey(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Shows pictures `[H, W, 3]` of bytes as grey ones `[64, 64, 1]`; takes each action twice.

    The reward is the sum of both. An episode that ends after the first ends there.

    Raises:
      ValueError: the environment shows something else.
    """

    times = 2  # that an action is taken

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        space: Any = env.observation_space
        if space.dtype != np.uint8 or len(space.shape) != 3 or space.shape[2] != 3:
            raise ValueError(f"its observations are no pictures [H, W, 3] of bytes: {space}")
        self.observation_space = gymnasium.spaces.Box(0, 255, (SIDE, SIDE, 1), np.uint8)
        if "render_fps" in env.metadata:  # a video has a frame of each env step
            self.metadata = {**env.metadata, "render_fps": env.metadata["render_fps"] / self.times}
        self._rows = shares(space.shape[0], SIDE)
        self._columns = shares(space.shape[1], SIDE).T

    def reset(self, **how: Any) -> tuple[np.ndarray, dict[str, Any]]:
        picture, info = self.env.reset(**how)
        return self._seen(picture), info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        total = 0.0
        for left in reversed(range(self.times)):
            picture, reward, terminated, truncated, info = self._step(action, last=left == 0)
            total += float(reward)
            if terminated or truncated:
                break
        return self._seen(picture), total, terminated, truncated, info

    def _step(self, action: Any, last: bool) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment; only the picture of the last time, or of an end, is seen."""
        return self.env.step(action)

    def _seen(self, picture: np.ndarray) -> np.ndarray:
        grey = self._rows @ (picture @ BRIGHTNESS) @ self._columns
        return np.rint(grey).astype(np.uint8)[..., None]
