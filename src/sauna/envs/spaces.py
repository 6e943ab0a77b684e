"""Observation and action spaces: what is supported, and the conversions at the env's border."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sauna.system.errors import BadInput

SMALLEST_IMAGE = 36  # the Nature CNN's three convolutions need this many pixels


class Spaces(NamedTuple):
    """What the learner has to know of an environment's spaces."""

    observation_kind: str  # vector | image | one_hot
    observation_shape: tuple[int, ...]
    action_kind: str  # continuous | discrete | multi_discrete | multi_binary
    action_sizes: tuple[int, ...]  # (A,), (choices,), (choices, choices, ...), (bits,)
    # Of parts that are flattened, their order and sizes; runs of 0.1.0 hold Gymnasium's text.
    observation_structure: Any
    action_structure: Any

    @property
    def observation_dtype(self) -> Any:
        return np.uint8 if self.observation_kind == "image" else np.float32

    @property
    def action_dtype(self) -> Any:
        return np.float32 if self.action_kind == "continuous" else np.int32

    @property
    def action_width(self) -> int:
        """Components of one action (`A`)."""
        one_each = len(self.action_sizes)
        return one_each if self.action_kind.endswith("discrete") else self.action_sizes[0]


def read_spaces(values: list[Any]) -> Spaces:
    """`Spaces` back from its JSON form, where tuples have become lists.

    Raises:
      TypeError, ValueError: they are none.
    """
    spaces = Spaces(*map(_tuples, values))
    for sizes in (spaces.observation_shape, spaces.action_sizes):
        if not isinstance(sizes, tuple) or not all(
            type(n) is int and 0 <= n < 2**31 for n in sizes
        ):
            raise ValueError(f"{sizes} are no sizes")
    return spaces


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def difference(before: Spaces, now: Spaces) -> str:
    """What of the spaces is not as it was, for a message; empty where a learner sees no difference.

    Bounds and types of numbers are no part of it: the learner does not read them.
    """
    for name in Spaces._fields:
        old, new = getattr(before, name), getattr(now, name)
        if name.endswith("structure") and not (isinstance(old, tuple) and isinstance(new, tuple)):
            continue  # text, of 0.1.0
        if old != new:
            return f"{name.replace('_', ' ')} {old} instead of {new}"
    return ""


def _structure(space: Any) -> tuple[Any, ...]:
    """The kind of a space, and of its parts in the order in which they are flattened."""
    from gymnasium import spaces as gym

    if isinstance(space, gym.Dict):
        return ("Dict", *((str(name), _structure(part)) for name, part in space.spaces.items()))
    if isinstance(space, gym.Tuple):
        return ("Tuple", *map(_structure, space.spaces))
    if isinstance(space, gym.Discrete):
        return ("Discrete", int(space.n))
    if isinstance(space, gym.MultiDiscrete):
        return ("MultiDiscrete", *map(int, space.nvec.ravel()))
    return (type(space).__name__, *map(int, space.shape or ()))


def describe(observation_space: Any, action_space: Any) -> Spaces:
    """The `Spaces` of a Gymnasium environment.

    Raises:
      BadInput: a space that is not supported, by name.
    """
    kind, shape = describe_observation(observation_space)
    action_kind, sizes = _describe_action(action_space)
    return Spaces(
        kind, shape, action_kind, sizes, _structure(observation_space), _structure(action_space)
    )


def describe_observation(space: Any) -> tuple[str, tuple[int, ...]]:
    from gymnasium import spaces as gym

    if isinstance(space, gym.Box) and space.dtype == np.uint8 and len(space.shape) in (2, 3):
        shape = _channels_last(space.shape)
        if min(shape[:2]) < SMALLEST_IMAGE:
            raise BadInput(
                f"observation space {space} is not supported: images need at least "
                f"{SMALLEST_IMAGE} x {SMALLEST_IMAGE} pixels"
            )
        return "image", shape
    if isinstance(space, gym.Box):
        return "vector", (math.prod(space.shape),)
    if isinstance(space, gym.Discrete):
        return "one_hot", (int(space.n),)
    if isinstance(space, gym.Dict) and all(
        isinstance(part, gym.Box | gym.Discrete) for part in space.spaces.values()
    ):
        return "vector", (gym.utils.flatdim(space),)
    raise BadInput(
        f"observation space {type(space).__name__} is not supported "
        "(Box, Discrete, and Dict of those are)"
    )


def _describe_action(space: Any) -> tuple[str, tuple[int, ...]]:
    from gymnasium import spaces as gym

    if isinstance(space, gym.Box) and np.issubdtype(space.dtype, np.floating):
        return "continuous", (math.prod(space.shape),)
    if isinstance(space, gym.Discrete):
        return "discrete", (int(space.n),)
    if isinstance(space, gym.MultiDiscrete) and space.nvec.ndim == 1:
        return "multi_discrete", tuple(int(n) for n in space.nvec)
    if isinstance(space, gym.MultiBinary) and len(space.shape) == 1:
        return "multi_binary", (int(space.shape[0]),)
    raise BadInput(
        f"action space {space} is not supported "
        "(continuous Box, Discrete, MultiDiscrete and MultiBinary are)"
    )


def _channels_last(shape: tuple[int, ...]) -> tuple[int, ...]:
    if len(shape) == 2:
        return (*shape, 1)
    return (shape[1], shape[2], shape[0]) if _channels_first(shape) else shape


def _channels_first(shape: tuple[int, ...]) -> bool:
    """A stack of frames `[C, H, W]`: fewer channels in front than pixels behind."""
    return len(shape) == 3 and shape[0] < min(shape[1:])


def observation_reader(space: Any) -> Callable[[Any], np.ndarray]:
    """A function from the env's observation to the array of `Spaces.observation_shape`.

    Vectors keep the env's precision; the collector rounds them after normalising.
    """
    from gymnasium import spaces as gym

    if isinstance(space, gym.Box) and space.dtype == np.uint8 and len(space.shape) in (2, 3):
        if len(space.shape) == 2:
            return lambda image: image[..., None]
        if _channels_first(space.shape):
            return lambda image: np.moveaxis(np.asarray(image), 0, -1)
        return np.asarray
    if isinstance(space, gym.Box):
        return np.asarray if len(space.shape) == 1 else lambda x: np.asarray(x).reshape(-1)
    return lambda x: gym.flatten(space, x)


def action_writer(space: Any) -> Callable[[np.ndarray], Any]:
    """A function from an action `[A]` to what `env.step` takes; only here is an action clipped."""
    from gymnasium import spaces as gym

    if isinstance(space, gym.Box):
        low, high, shape, dtype = space.low.ravel(), space.high.ravel(), space.shape, space.dtype
        lowest, highest = low.astype(np.float32), high.astype(np.float32)

        def clip(action: np.ndarray) -> np.ndarray:
            inside = np.minimum(np.maximum(action, lowest), highest)
            return inside if inside.dtype == dtype else inside.astype(dtype)

        if len(shape) == 1:
            return clip
        return lambda action: clip(action).reshape(shape)
    if isinstance(space, gym.Discrete):
        start = int(space.start)
        return lambda action: int(action[0]) + start
    if isinstance(space, gym.MultiDiscrete):
        starts = np.asarray(getattr(space, "start", 0))
        return lambda action: (action + starts).astype(space.dtype)
    return lambda action: action.astype(space.dtype)
