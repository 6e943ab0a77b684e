"""Wrappers of a user's own."""

from __future__ import annotations

from typing import Any

import gymnasium


class Double(gymnasium.RewardWrapper):
    def reward(self, reward: Any) -> float:
        return 2.0 * float(reward)


def plus_one(env: Any) -> Any:
    return gymnasium.wrappers.TransformReward(env, lambda reward: reward + 1.0)


def nothing(env: Any) -> None:
    return None


def broken(env: Any) -> Any:
    raise ValueError("no\nsuch thing")


NUMBER = 3
