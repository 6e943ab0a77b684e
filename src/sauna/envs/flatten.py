"""One vector of an observation of several parts, prepared once per space."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sauna.envs.shapes import leaves


def flattener(space: Any, check: Callable[[Any], None]) -> Callable[[Any], np.ndarray]:
    """`gymnasium.spaces.flatten` of one space, prepared: at every env step that would cost more
    than many an environment."""
    from gymnasium import spaces as gym

    places, end = [], 0
    for path, part in leaves(space):
        start, end = end, end + int(gym.utils.flatdim(part))
        places.append((path, _part_writer(part), start, end))
    dtype = np.result_type(*(part.dtype for _, part in leaves(space)))

    def flatten(observation: Any) -> np.ndarray:
        check(observation)
        vector = np.zeros(end, dtype)
        for path, write, start, stop in places:
            value = observation
            for name in path:
                value = value[name]
            write(vector[start:stop], value)
        return vector

    return flatten


def _part_writer(space: Any) -> Callable[[np.ndarray, Any], None]:
    """A function that writes a value of a space into zeros, as `gymnasium.spaces.flatten` does."""
    from gymnasium import spaces as gym

    first, dtype = getattr(space, "start", 0), space.dtype

    def one_hot(place: np.ndarray, value: Any) -> None:
        place[value - first] = 1

    def plain(place: np.ndarray, value: Any) -> None:
        array = np.asarray(value, dtype)
        place[:] = array if array.ndim == 1 else array.reshape(-1)

    def any_other(place: np.ndarray, value: Any) -> None:
        place[:] = gym.flatten(space, value)

    if isinstance(space, gym.Discrete):
        return one_hot
    return plain if isinstance(space, gym.Box | gym.MultiBinary) else any_other
