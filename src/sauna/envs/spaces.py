"""Observation and action spaces: what is supported, and the conversions at the env's border."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sauna.envs.shapes import parts_of, shape_check
from sauna.system.errors import BadInput

SMALLEST_IMAGE = 36  # the Nature CNN's three convolutions need this many pixels
PICTURES = ("image", "float_image")  # kinds of observations that are one picture
MAX_BOUND = 1e30  # an action box this wide is not bounded: such bounds stand for none


class Spaces(NamedTuple):
    """What the learner has to know of an environment's spaces."""

    observation_kind: str  # vector | image (bytes) | float_image (in [0, 1]) | one_hot
    observation_shape: tuple[int, ...]
    action_kind: str  # continuous | discrete | multi_discrete | multi_binary
    action_sizes: tuple[int, ...]  # (A,), (choices,), (choices, choices, ...), (bits,)
    # Of parts that are flattened, their order and sizes; runs of 0.1.0 hold Gymnasium's text.
    observation_structure: Any
    action_structure: Any
    observation_high: float = 255.0  # of an image's bytes: the networks here divide by it

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


def board_of(spaces: Spaces) -> tuple[int, ...]:
    """The shape, of two or three axes, of a Box that is flattened to a vector; () for another."""
    structure = spaces.observation_structure
    if not isinstance(structure, tuple) or len(structure) not in (3, 4) or structure[0] != "Box":
        return ()
    shape = structure[1:]
    is_whole = all(type(side) is int and side > 0 for side in shape)
    fits = is_whole and spaces.observation_shape == (math.prod(shape),)
    return shape if fits and spaces.observation_kind == "vector" else ()


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
    high = float(observation_space.high.max(initial=0)) if kind == "image" else 0.0
    action_kind, sizes = _describe_action(action_space)
    parts = _structure(observation_space), _structure(action_space)
    return Spaces(kind, shape, action_kind, sizes, *parts, high or 255.0)


def describe_observation(space: Any) -> tuple[str, tuple[int, ...]]:
    """The kind of an observation and the shape of its array.

    Raises:
      BadInput: the space, or a part of it, cannot be learned from; its key is named.
    """
    from gymnasium import spaces as gym

    if _is_bytes(space):
        return "image", _channels_last(space.shape)
    if _is_float_picture(space):
        return "float_image", _channels_last(space.shape)
    _check_part(space, "")
    size = int(gym.utils.flatdim(space))
    if isinstance(space, gym.Discrete | gym.MultiDiscrete | gym.MultiBinary):
        return "one_hot", (size,)
    return "vector", (size,)


def _is_bytes(space: Any) -> bool:
    """Whether a space is a picture or a board: `uint8`, of two or three axes."""
    from gymnasium import spaces as gym

    return isinstance(space, gym.Box) and space.dtype == np.uint8 and len(space.shape) in (2, 3)


def _is_float_picture(space: Any) -> bool:
    """Whether a space is a picture of floats in [0, 1]; small boards are vectors."""
    from gymnasium import spaces as gym

    if not isinstance(space, gym.Box) or not np.issubdtype(space.dtype, np.floating):
        return False
    large = sum(side >= SMALLEST_IMAGE for side in space.shape) >= 2 and len(space.shape) <= 3
    return large and bool((space.low == 0).all() and (space.high == 1).all())


def _check_part(space: Any, key: str) -> None:
    """Refuses what cannot be read as a short vector, and says what to do instead.

    Args:
      key: of the part in its Dict or Tuple, `["camera"]`; empty for the whole space.
    """
    from gymnasium import spaces as gym

    if isinstance(space, gym.Dict | gym.Tuple):
        parts = space.spaces.items() if isinstance(space, gym.Dict) else enumerate(space.spaces)
        for name, part in parts:
            _check_part(part, f"{key}[{name!r}]")
        return
    if not isinstance(space, gym.Box | gym.Discrete | gym.MultiDiscrete | gym.MultiBinary):
        raise BadInput(
            f"observation space{key}: {type(space).__name__} is not supported (Box, Discrete, "
            "MultiDiscrete, MultiBinary, and Dict and Tuple of those are)"
        )
    if sum(side >= SMALLEST_IMAGE for side in space.shape or ()) >= 2:
        raise BadInput(
            f"observation space{key}: pictures of shape {space.shape} and type {space.dtype} are "
            f"not supported {_instead(space, key)}"
        )


def _instead(space: Any, key: str) -> str:
    """What to write where a picture cannot be taken as it is."""
    flat = "gymnasium.wrappers.FlattenObservation makes one vector of it for an MLP"
    if key:
        return (
            "in a Dict or Tuple: give the picture alone (uint8 [H, W, C]), "
            "or leave it out (gymnasium.wrappers.FilterObservation)"
        )
    if len(space.shape) > 3:
        return f"(more than three axes): give a stack as uint8 [H, W, frames x C]; {flat}"
    return (
        "(only uint8 is, and a Box of floats from 0 to 1): give bytes up to 255 as uint8 "
        f"[H, W, C]; {flat}"
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
        f"action space {' '.join(str(space).split())} is not supported "
        "(continuous Box, Discrete, MultiDiscrete and MultiBinary are)"
    )


def _channels_last(shape: tuple[int, ...]) -> tuple[int, ...]:
    if len(shape) == 2:
        return (*shape, 1)
    return (shape[1], shape[2], shape[0]) if channels_first(shape) else shape


def channels_first(shape: tuple[int, ...]) -> bool:
    """A stack of frames `[C, H, W]`: fewer channels in front than pixels behind."""
    return len(shape) == 3 and shape[0] < min(shape[1:])


def observation_reader(space: Any) -> Callable[[Any], np.ndarray]:
    """A function from the env's observation to the array of `Spaces.observation_shape`.

    Vectors keep the env's precision; the collector rounds them after normalising. What is flattened
    is refused (`ValueError`) if a part has another shape than its space.
    """
    from gymnasium import spaces as gym

    if _is_bytes(space) or _is_float_picture(space):
        if len(space.shape) == 2:
            return lambda image: np.asarray(image)[..., None]
        if channels_first(space.shape):
            return lambda image: np.moveaxis(np.asarray(image), 0, -1)
        return np.asarray
    if isinstance(space, gym.Box) and len(space.shape) == 1:
        return np.asarray

    check = shape_check(space)
    if isinstance(space, gym.Box):

        def read(observation: Any) -> np.ndarray:
            check(observation)
            return np.asarray(observation).reshape(-1)

        return read
    return _flattener(space, check)


def _flattener(space: Any, check: Callable[[Any], None]) -> Callable[[Any], np.ndarray]:
    """`gymnasium.spaces.flatten` of one space, prepared: at every env step that would cost more
    than many an environment."""
    from gymnasium import spaces as gym

    places, end = [], 0
    for path, part in parts_of(space):
        start, end = end, end + int(gym.utils.flatdim(part))
        places.append((path, _part_writer(part), start, end))
    dtype = np.result_type(*(part.dtype for _, part in parts_of(space)))

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
    _, sizes = _describe_action(space)
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
    bounded = (low > -MAX_BOUND) & (high < MAX_BOUND) & (low < high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    center, half = (low + high) / 2, (high - low) / 2
    if np.all(center == 0.0) and np.all(half == 1.0):
        return None
    return bounded, center, half
