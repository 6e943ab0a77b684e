"""Observation and action spaces: what is supported, and observations as the network sees them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sauna.envs.flatten import flattener
from sauna.envs.pictures import (
    channels_last,
    highest_byte,
    is_bytes,
    is_float_picture,
    is_large,
    is_picture,
    picture_reader,
)
from sauna.envs.shapes import leaves, mask_in, part_at, shape_check
from sauna.system.errors import BadInput

PICTURES = ("image", "float_image")  # kinds of observations that are one picture
Picture = tuple[int, int, int, float]  # height, width, channels, the highest byte
MAX_BOUND = 1e30  # an action box this wide is not bounded: such bounds stand for none


class Spaces(NamedTuple):
    """What the learner has to know of an environment's spaces.

    An observation is one array: a picture `[H, W, C]` of bytes, or numbers `[D]`. Those are, in
    this order, `numbers`, the mask of the valid actions (`mask` of them, 1 or 0), and the
    `pictures`, each as `H * W * C` numbers. Mostly they are `numbers` alone.
    """

    observation_kind: str  # vector | image (bytes) | float_image (in [0, 1]) | one_hot
    observation_shape: tuple[int, ...]
    action_kind: str  # continuous | discrete | multi_discrete | multi_binary
    action_sizes: tuple[int, ...]  # (A,), (choices,), (choices, choices, ...), (bits,)
    # Of parts that are flattened, their order and sizes; runs of 0.1.0 hold Gymnasium's text.
    observation_structure: Any
    action_structure: Any
    observation_high: float = 255.0  # of an image's bytes: the networks here divide by it
    action_bounded: bool = True  # whether each component of a continuous action has both bounds
    mask: int = 0  # 0: no mask, every action is valid
    pictures: tuple[Picture, ...] = ()

    @property
    def observation_dtype(self) -> Any:
        return np.uint8 if self.observation_kind == "image" else np.float32

    @property
    def numbers(self) -> int:
        """The observation's first numbers: what is neither mask nor picture."""
        if self.observation_kind in PICTURES:
            return 0
        return self.observation_shape[0] - self.mask - sum(map(picture_size, self.pictures))

    @property
    def normalized(self) -> int:
        """The observation's first numbers that have running moments."""
        return self.numbers if self.observation_kind == "vector" else 0

    @property
    def picture_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Of all pictures: the observation itself, or those in it."""
        if self.observation_kind in PICTURES:
            return (self.observation_shape,)
        return tuple(picture[:3] for picture in self.pictures)

    @property
    def is_combined(self) -> bool:
        """Whether pictures stand beside numbers or other pictures."""
        return bool(self.numbers and self.pictures) or len(self.pictures) > 1

    @property
    def action_dtype(self) -> Any:
        return np.float32 if self.action_kind == "continuous" else np.int32

    @property
    def action_width(self) -> int:
        """Components of one action (`A`)."""
        one_each = len(self.action_sizes)
        return one_each if self.action_kind.endswith("discrete") else self.action_sizes[0]


def picture_size(picture: Picture) -> int:
    """Counts the bytes of a picture."""
    return picture[0] * picture[1] * picture[2]


def picture_alone(spaces: Spaces, picture: Picture) -> Spaces:
    """The spaces of an environment that shows one of the pictures and nothing else."""
    return spaces._replace(
        observation_kind="image",
        observation_shape=picture[:3],
        observation_high=picture[3],
        mask=0,
        pictures=(),
    )


def seen_spaces(spaces: Spaces) -> Spaces:
    """The spaces as the network sees them: without the mask, and a picture by itself as one."""
    if len(spaces.pictures) == 1 and not spaces.numbers:
        return picture_alone(spaces, spaces.pictures[0])
    if not spaces.mask:
        return spaces
    return spaces._replace(observation_shape=(spaces.observation_shape[0] - spaces.mask,), mask=0)


def read_spaces(values: list[Any]) -> Spaces:
    """`Spaces` back from its JSON form, where tuples have become lists.

    Raises:
      TypeError, ValueError: they are none.
    """
    spaces = Spaces(*map(_tuples, values))
    parts = spaces.observation_structure
    if isinstance(parts, tuple) and parts[:1] == ("StackedSpace",):  # of runs from before
        spaces = spaces._replace(observation_structure=("Box", *parts[1:]))
    for sizes in (spaces.observation_shape, spaces.action_sizes):
        if not isinstance(sizes, tuple) or not all(
            type(n) is int and 0 <= n < 2**31 for n in sizes
        ):
            raise ValueError(f"{sizes} are no sizes")
    _check_parts(spaces)
    return spaces


def _check_parts(spaces: Spaces) -> None:
    """Refuses parts that an observation has no place for.

    Raises:
      TypeError, ValueError: they are none.
    """
    for picture in spaces.pictures:
        height, width, channels, high = picture
        if not all(type(n) is int and n > 0 for n in (height, width, channels)) or not high > 0:
            raise ValueError(f"{picture} is no picture")
    if type(spaces.mask) is not int or spaces.mask < 0 or spaces.numbers < 0:
        raise ValueError("its observations have no place for their parts")


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def difference(before: Spaces, now: Spaces) -> str:
    """What of the spaces is not as it was, for a message; empty where a learner sees no difference.

    Bounds and types of numbers are no part of it: the learner does not read them.
    """
    for name in Spaces._fields:
        old, new = getattr(before, name), getattr(now, name)
        if name == "action_bounded":
            continue
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
    kind = "Box" if isinstance(space, gym.Box) else type(space).__name__  # a stack is one, too
    return (kind, *map(int, space.shape or ()))


def describe(observation_space: Any, action_space: Any) -> Spaces:
    """The `Spaces` of a Gymnasium environment.

    Raises:
      BadInput: a space that is not supported, by name.
    """
    mask, inner = mask_in(observation_space)
    kind, shape = describe_observation(inner)
    if mask and kind == "float_image":
        raise BadInput("action_mask: a picture beside a mask has to be of bytes (uint8)")
    high = highest_byte(inner) if kind == "image" else 255.0
    action_kind, sizes = describe_action(action_space)
    parts = _structure(inner), _structure(action_space)
    bounded = action_kind != "continuous" or bool(bounded_components(action_space).all())
    spaces = Spaces(kind, shape, action_kind, sizes, *parts, high, bounded)
    if kind != "image" or mask:
        spaces = spaces._replace(pictures=tuple(map(_picture, _pictures_in(inner))))
    if not mask:
        return spaces
    kind, size = ("vector" if kind == "image" else kind), math.prod(shape) + mask
    return spaces._replace(
        observation_kind=kind, observation_shape=(size,), observation_high=255.0, mask=mask
    )


def _pictures_in(space: Any) -> list[Any]:
    """The spaces of the pictures of an observation that is more than one picture, in order."""
    if is_bytes(space):
        return [space]
    return [part for _, part in leaves(space) if is_picture(part)]


def _picture(space: Any) -> Picture:
    height, width, channels = channels_last(space.shape)
    return height, width, channels, highest_byte(space)


def describe_observation(space: Any) -> tuple[str, tuple[int, ...]]:
    """The kind of an observation and the shape of its array.

    Raises:
      BadInput: the space, or a part of it, cannot be learned from; its key is named.
    """
    from gymnasium import spaces as gym

    if is_bytes(space):
        return "image", channels_last(space.shape)
    if is_float_picture(space):
        return "float_image", channels_last(space.shape)
    _check_part(space, "")
    size = int(gym.utils.flatdim(space))
    if isinstance(space, gym.Discrete | gym.MultiDiscrete | gym.MultiBinary):
        return "one_hot", (size,)
    return "vector", (size,)


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
    if is_large(space) and not (key and is_picture(space)):
        raise BadInput(
            f"observation space{key}: pictures of shape {space.shape} and type {space.dtype} are "
            f"not supported {_instead(space, key)}"
        )


def _instead(space: Any, key: str) -> str:
    """What to write where a picture cannot be taken as it is."""
    flat = "gymnasium.wrappers.FlattenObservation makes one vector of it for an MLP"
    if key:
        return (
            "in a Dict or Tuple: give it as uint8 [H, W, C], "
            "or leave it out (gymnasium.wrappers.FilterObservation)"
        )
    if len(space.shape) > 3:
        return f"(more than three axes): give a stack as uint8 [H, W, frames x C]; {flat}"
    return (
        "(only uint8 is, and a Box of floats from 0 to 1): give bytes up to 255 as uint8 "
        f"[H, W, C]; {flat}"
    )


def describe_action(space: Any) -> tuple[str, tuple[int, ...]]:
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


def observation_reader(space: Any) -> Callable[[Any], np.ndarray]:
    """A function from the env's observation to the array of `Spaces.observation_shape`.

    Vectors keep the env's precision; the collector rounds them after normalising. What is flattened
    is refused (`ValueError`) if a part has another shape than its space.
    """
    from gymnasium import spaces as gym

    if mask_in(space)[0] or (not is_bytes(space) and _pictures_in(space)):
        return _packed_reader(space)
    if is_bytes(space) or is_float_picture(space):
        return picture_reader(space)
    if isinstance(space, gym.Box) and len(space.shape) == 1:
        return np.asarray

    check = shape_check(space)
    if isinstance(space, gym.Box):

        def read(observation: Any) -> np.ndarray:
            check(observation)
            return np.asarray(observation).reshape(-1)

        return read
    return flattener(space, check)


def _packed_reader(space: Any) -> Callable[[Any], np.ndarray]:
    """Of an observation of several parts: numbers, mask and pictures side by side, as float64."""
    from gymnasium import spaces as gym

    mask, inner = mask_in(space)
    check, parts = shape_check(space), list(leaves(inner))
    as_picture = is_bytes if is_bytes(inner) else is_picture
    numbers = [(path, part) for path, part in parts if not as_picture(part)]
    pictures = [(path, picture_reader(part)) for path, part in parts if as_picture(part)]

    def read(observation: Any) -> np.ndarray:
        check(observation)
        seen = observation["observation"] if mask else observation
        found = [gym.flatten(part, part_at(seen, path)) for path, part in numbers]
        if mask:
            found.append(observation["action_mask"])
        found += [
            np.asarray(picture(part_at(seen, path))).reshape(-1) for path, picture in pictures
        ]
        return np.concatenate(found, dtype=np.float64)

    return read


def bounded_components(space: Any) -> np.ndarray:
    """Which components `[A]` of a box of actions have both bounds."""
    low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
    return (low > -MAX_BOUND) & (high < MAX_BOUND) & (low < high)
