"""CarRacing in every eighth picture, small and grey.

`--wrap sauna.envs.car_racing:EveryEighth` puts it around the environments of a run.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from sauna.envs.small_grey import SmallGrey


class EveryEighth(SmallGrey):
    """Shows CarRacing as grey pictures `[64, 64, 1]`; takes each action eight times.

    The reward is the sum of the eight. An episode that ends before the eighth ends there.
    Gymnasium (1.3) draws a picture in each step, which takes most of its time. Pictures that nobody
    sees are not drawn here; the others stay the same to the bit.

    Raises:
      ValueError: the environment is another one.
    """

    times = 8

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._racing: Any = env.unwrapped
        if not hasattr(self._racing, "_render") or not hasattr(self._racing, "car"):
            raise ValueError(f"it is for Gymnasium's CarRacing, and this is {env}")

    def _step(self, action: Any, last: bool) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if last:
            return self.env.step(action)
        racing, draw = self._racing, self._racing._render
        racing._render = lambda mode: racing.state  # the picture before
        try:
            _, reward, terminated, truncated, info = self.env.step(action)
        finally:
            del racing._render
        picture = draw("state_pixels") if terminated or truncated else None
        return picture, reward, terminated, truncated, info
