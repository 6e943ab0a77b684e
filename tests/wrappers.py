"""Wrappers of a user's own."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np


class Double(gymnasium.RewardWrapper):
    def reward(self, reward: Any) -> float:
        return 2.0 * float(reward)


def plus_one(env: Any) -> Any:
    return gymnasium.wrappers.TransformReward(env, lambda reward: reward + 1.0)


class Pictured(gymnasium.ObservationWrapper):
    """Shows a picture in place of what the environment shows."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(0, 255, (12, 12, 1), np.uint8)

    def observation(self, observation: Any) -> np.ndarray:
        return np.zeros((12, 12, 1), np.uint8)


def nothing(env: Any) -> None:
    return None


def broken(env: Any) -> Any:
    raise ValueError("no\nsuch thing")


NUMBER = 3
