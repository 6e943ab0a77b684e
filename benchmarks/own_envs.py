"""Environments as a user writes them, for `benchmarks/make.py`."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class Reach(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """A point in the plane moves to a goal; the observation is a Dict of three vectors.

    Args:
      milliseconds: of CPU time that each step takes besides, as a simulator would.
    """

    def __init__(self, milliseconds: float = 0.0) -> None:
        plane = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space = spaces.Dict({"place": plane, "speed": plane, "goal": plane})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._seconds = milliseconds / 1000
        self._place, self._speed, self._goal = np.zeros((3, 2))
        self._steps = 0

    def _observed(self) -> dict[str, np.ndarray]:
        return {"place": self._place, "speed": self._speed, "goal": self._goal}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._place, self._goal = self.np_random.uniform(-1.0, 1.0, (2, 2))
        self._speed, self._steps = np.zeros(2), 0
        return self._observed(), {}

    def step(self, action: np.ndarray) -> Any:
        began = time.perf_counter()
        self._speed = 0.9 * self._speed + 0.1 * action
        self._place = self._place + 0.1 * self._speed
        self._steps += 1
        distance = float(np.linalg.norm(self._place - self._goal))
        while time.perf_counter() - began < self._seconds:
            pass
        return self._observed(), -distance, distance < 0.05, self._steps >= 200, {}
