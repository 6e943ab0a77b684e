"""Which spaces are pictures, and how one is read: `[H, W, C]`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

SMALLEST_IMAGE = 36  # the Nature CNN's three convolutions need this many pixels


def is_picture(part: Any) -> bool:
    """Whether a part of a Dict or Tuple is a picture; smaller boards are numbers."""
    return is_bytes(part) and is_large(part)


def is_large(part: Any) -> bool:
    return sum(side >= SMALLEST_IMAGE for side in part.shape or ()) >= 2


def highest_byte(space: Any) -> float:
    return float(space.high.max(initial=0)) or 255.0


def is_bytes(space: Any) -> bool:
    """Whether a space is a picture or a board: `uint8`, of two or three axes."""
    from gymnasium import spaces as gym

    return isinstance(space, gym.Box) and space.dtype == np.uint8 and len(space.shape) in (2, 3)


def is_float_picture(space: Any) -> bool:
    """Whether a space is a picture of floats in [0, 1]; small boards are vectors."""
    from gymnasium import spaces as gym

    if not isinstance(space, gym.Box) or not np.issubdtype(space.dtype, np.floating):
        return False
    large = is_large(space) and len(space.shape) <= 3
    return large and bool((space.low == 0).all() and (space.high == 1).all())


def channels_last(shape: tuple[int, ...]) -> tuple[int, ...]:
    if len(shape) == 2:
        return (*shape, 1)
    return (shape[1], shape[2], shape[0]) if channels_first(shape) else shape


def channels_first(shape: tuple[int, ...]) -> bool:
    """A stack of frames `[C, H, W]`: fewer channels in front than pixels behind."""
    return len(shape) == 3 and shape[0] < min(shape[1:])


def picture_reader(space: Any) -> Callable[[Any], np.ndarray]:
    if len(space.shape) == 2:
        return lambda image: np.asarray(image)[..., None]
    if channels_first(space.shape):
        return lambda image: np.moveaxis(np.asarray(image), 0, -1)
    return np.asarray
