"""Some env steps with random actions, and what was seen in them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sauna.envs.host.answers import first_of, five_of, one_number
from sauna.envs.probe import any_action, each_observation

SECONDS = 20.0  # after which no further step is played


@dataclass
class Played:
    """What was seen.

    Attributes:
      steps: env steps that were played.
      seconds: that they took.
      rewards: of each step.
      lengths: of each episode that ended.
      terminated: of those, whether each ended by `terminated`.
      outside: observations that are not in their space, and the first of them in words.
      not_finite: observations or rewards that are NaN or infinite.
    """

    steps: int = 0
    seconds: float = 0.0
    rewards: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    terminated: list[bool] = field(default_factory=list)
    outside: int = 0
    outside_text: str = ""
    not_finite: int = 0


def play(env: Any, steps: int) -> Played:
    """Plays with random actions, for `steps` env steps or `SECONDS`."""
    seen, length = Played(), 0
    env.action_space.seed(0)
    observation = first_of(env.reset(seed=0))
    _look(env, observation, seen)
    while seen.steps < steps and seen.seconds < SECONDS:
        action = any_action(env, observation)
        before = time.perf_counter()
        observation, reward, terminated, truncated, _ = five_of(env.step(action))
        seen.seconds += time.perf_counter() - before
        seen.steps, length = seen.steps + 1, length + 1
        seen.rewards.append(one_number(reward))
        seen.not_finite += not np.isfinite(seen.rewards[-1])
        _look(env, observation, seen)
        if terminated or truncated:
            seen.lengths.append(length)
            seen.terminated.append(bool(terminated))
            length = 0
            before = time.perf_counter()
            observation = first_of(env.reset())
            seen.seconds += time.perf_counter() - before
            _look(env, observation, seen)
    return seen


def _look(env: Any, given: Any, seen: Played) -> None:
    for observation in each_observation(env, given):
        _look_at(env, observation, seen)


def _look_at(env: Any, observation: Any, seen: Played) -> None:
    space = env.observation_space
    if not space.contains(observation):
        seen.outside += 1
        seen.outside_text = seen.outside_text or why_outside(space, observation, "the observation")
    for part in _arrays(observation):
        if part.dtype.kind == "f" and not np.isfinite(part).all():
            seen.not_finite += 1


def _arrays(value: Any) -> list[np.ndarray]:
    if isinstance(value, dict):
        return [array for part in value.values() for array in _arrays(part)]
    if isinstance(value, tuple):
        return [array for part in value for array in _arrays(part)]
    return [np.asarray(value)]


def why_outside(space: Any, value: Any, name: str) -> str:
    """Says why a value is not in its space; the part of a Dict or Tuple is named."""
    from gymnasium import spaces as gym

    if isinstance(space, gym.Dict | gym.Tuple) and isinstance(value, dict | tuple):
        parts = space.spaces.items() if isinstance(space, gym.Dict) else enumerate(space.spaces)
        for key, part in parts:
            try:
                inner = value[key]
            except LookupError:
                return f"{name} has no {key!r}"
            if not part.contains(inner):
                return why_outside(part, inner, f"{name}[{key!r}]")
        return f"{name} has parts that its space does not have"
    array = np.asarray(value)
    if array.shape != tuple(space.shape or ()):
        return f"{name} is of shape {array.shape}, and its space of {space.shape}"
    if isinstance(space, gym.Box):
        if not np.can_cast(array.dtype, space.dtype):
            return f"{name} is of type {array.dtype}, and its space of {space.dtype}"
        wrong = np.argwhere(~((array >= space.low) & (array <= space.high)))
        if len(wrong):
            index = tuple(map(int, wrong[0]))
            low, high = space.low[index], space.high[index]
            return f"{name} is {array[index]:g} at {list(index)}, not between {low:g} and {high:g}"
    return f"{name} is {value!r}"[:200]
