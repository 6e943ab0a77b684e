"""Actions between the network and the environment: clipped, stretched, and read back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sauna.envs.spaces import bounded_components, describe_action


def action_writer(space: Any, rescale: bool = False) -> Callable[[np.ndarray], Any]:
    """A function from an action `[A]` to what `env.step` takes; only here is an action clipped.

    Args:
      rescale: stretch [-1, 1] to the bounds of a box, where it has both; else only clip.
    """
    from gymnasium import spaces as gym

    if isinstance(space, gym.Box):
        return _box_writer(space, rescale)
    if isinstance(space, gym.Discrete):
        start = int(space.start)
        return lambda action: action.item() + start
    if isinstance(space, gym.MultiDiscrete):
        starts = np.asarray(getattr(space, "start", 0))
        return lambda action: (action + starts).astype(space.dtype)
    return lambda action: action.astype(space.dtype)


def _box_writer(space: Any, rescale: bool) -> Callable[[np.ndarray], Any]:
    low, high, shape, dtype = space.low.ravel(), space.high.ravel(), space.shape, space.dtype
    lowest, highest = low.astype(np.float32), high.astype(np.float32)
    stretched = stretch(space) if rescale else None

    def clip(action: np.ndarray) -> np.ndarray:
        inside = np.minimum(np.maximum(action, lowest), highest)
        return inside if inside.dtype == dtype else inside.astype(dtype)

    def write(action: np.ndarray) -> np.ndarray:
        assert stretched is not None
        bounded, center, half = stretched
        inner = np.where(bounded, np.clip(action, -1.0, 1.0), action)
        return np.clip((center + half * inner).astype(dtype), low, high)

    chosen = clip if stretched is None else write
    return chosen if len(shape) == 1 else lambda action: chosen(action).reshape(shape)


def action_reader(space: Any, rescale: bool = False) -> Callable[[Any], np.ndarray]:
    """A function from actions that `env.step` took `[L, ...]` to the network's `[L, A]`.

    It is the inverse of `action_writer`; what that has clipped stays at the bound. It raises
    `ValueError` for a choice that the space does not have.
    """
    from gymnasium import spaces as gym

    if isinstance(space, gym.Box):
        stretched = stretch(space) if rescale else None

        def read(actions: Any) -> np.ndarray:
            flat = np.asarray(actions, np.float64).reshape(len(actions), -1)
            if stretched is None or flat.shape[1:] != stretched[0].shape:
                return flat
            bounded, center, half = stretched
            return np.where(bounded, (flat - center) / half, flat)

        return read
    _, sizes = describe_action(space)
    choices = np.full(sizes, 2) if isinstance(space, gym.MultiBinary) else np.array(sizes)
    start = np.asarray(getattr(space, "start", 0))

    def read_choices(actions: Any) -> np.ndarray:
        found = np.asarray(actions).reshape(len(actions), -1)
        fits = found.shape[1] == choices.size and found.dtype.kind in "iub"
        chosen = found.astype(np.int64) - start if fits else found
        if not fits or ((chosen < 0) | (chosen >= choices)).any():
            raise ValueError(f"its actions are none of {' '.join(str(space).split())}")
        return chosen

    return read_choices


def stretch(space: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """How [-1, 1] is stretched to a box: `center + half * action` where `bounded`, all `[A]`.

    Components without both bounds have center 0 and half 1: they stay as they are.

    Returns:
      `(bounded, center, half)`, or None where nothing would change.
    """
    low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
    bounded = bounded_components(space)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    center, half = (low + high) / 2, (high - low) / 2
    if np.all(center == 0.0) and np.all(half == 1.0):
        return None
    return bounded, center, half
