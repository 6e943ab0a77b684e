"""Shapes of observations beside those of their space: one, a batch of them, or neither."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np


def shape_check(space: Any) -> Callable[[Any], None]:
    """Makes `check_shapes` of a space, fast if every part is an array of its shape, or a number."""
    parts = [(path, tuple(part.shape or ())) for path, part in leaves(space)]

    def check(observation: Any) -> None:
        try:
            for path, shape in parts:
                part = observation
                for name in path:
                    part = part[name]
                if type(part) is int:
                    if shape:
                        break
                elif part.shape != shape:
                    break
            else:
                return
        except (AttributeError, LookupError, TypeError):  # no array, or no such part
            pass
        check_shapes(space, observation)

    return check


def leaves(space: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """`(path, space)` of each part that is no Dict or Tuple."""
    from gymnasium import spaces as gym

    if isinstance(space, gym.Dict | gym.Tuple):
        parts = space.spaces.items() if isinstance(space, gym.Dict) else enumerate(space.spaces)
        for name, part in parts:
            yield from leaves(part, (*path, name))
    else:
        yield path, space


def mask_in(space: Any) -> tuple[int, Any]:
    """Entries of the action mask that observations hold (0: none), and the space of the rest."""
    mask = getattr(space, "mask_size", 0)
    return mask, space["observation"] if mask else space


def part_at(observation: Any, path: tuple[Any, ...]) -> Any:
    """The part that `leaves` gives a path for."""
    for name in path:
        observation = observation[name]
    return observation


def check_shapes(space: Any, observation: Any) -> None:
    """Refuses an observation whose parts have other shapes than the space says.

    A single number may have any shape of one number.

    Raises:
      ValueError: naming the key of the part.
    """
    for key, found, shape in _pairs(space, observation, "observation"):
        if found != shape and not (math.prod(found) == math.prod(shape) == 1):
            raise ValueError(f"{key} is of shape {found}, and its space of {shape}")


def batch_size(space: Any, observation: Any) -> int | None:
    """How many observations `observation` is: None for one, without a leading axis.

    Raises:
      ValueError: it is neither one nor a batch; what is expected is named.
    """
    try:
        pairs = list(_pairs(space, observation, ""))
    except ValueError as error:
        raise ValueError(_wanted(space, observation)) from error
    if all(found == shape for _, found, shape in pairs):
        return None
    sizes = {found[:1] for _, found, _ in pairs}
    if len(sizes) == 1 and all(found and found[1:] == shape for _, found, shape in pairs):
        return int(pairs[0][1][0])
    raise ValueError(_wanted(space, observation))


def one_of(space: Any, observation: Any, index: int) -> Any:
    """Takes one observation out of a batch, part by part."""
    from gymnasium import spaces as gym

    if isinstance(space, gym.Dict):
        return {name: one_of(part, observation[name], index) for name, part in space.items()}
    if isinstance(space, gym.Tuple):
        return tuple(one_of(p, observation[i], index) for i, p in enumerate(space.spaces))
    return np.asarray(observation)[index]


def _pairs(
    space: Any, observation: Any, key: str
) -> Iterator[tuple[str, tuple[int, ...], tuple[int, ...]]]:
    """`(key, shape, shape of the space)` of each part that is no Dict or Tuple.

    Raises:
      ValueError: a Dict or Tuple is something else, or a part is missing.
    """
    from gymnasium import spaces as gym

    if isinstance(space, gym.Dict):
        if not isinstance(observation, Mapping):
            raise ValueError(f"{key} is a {type(observation).__name__}, not a dict")
        for name, part in space.spaces.items():
            if name not in observation:
                raise ValueError(f"{key} has no {name!r}")
            yield from _pairs(part, observation[name], f"{key}[{name!r}]")
    elif isinstance(space, gym.Tuple):
        if not isinstance(observation, tuple | list) or len(observation) != len(space.spaces):
            raise ValueError(f"{key} is not a tuple of {len(space.spaces)} parts")
        for number, part in enumerate(space.spaces):
            yield from _pairs(part, observation[number], f"{key}[{number}]")
    else:
        yield key, np.shape(observation), tuple(space.shape or ())


def _wanted(space: Any, observation: Any) -> str:
    return (
        f"expected {_space_text(space)}, one observation or a batch of them; "
        f"got {_value_text(observation)}"
    )


def _space_text(space: Any) -> str:
    from gymnasium import spaces as gym

    name = type(space).__name__
    if isinstance(space, gym.Dict):
        parts = (f"{key} {_space_text(part)}" for key, part in space.spaces.items())
        return f"{name}({', '.join(parts)})"
    if isinstance(space, gym.Tuple):
        return f"{name}({', '.join(map(_space_text, space.spaces))})"
    return str(tuple(space.shape)) if space.shape else name


def _value_text(value: Any) -> str:
    if isinstance(value, Mapping):
        parts = (f"{key} {_value_text(part)}" for key, part in value.items())
        return f"{type(value).__name__}({', '.join(parts)})"
    if isinstance(value, tuple):
        return f"tuple({', '.join(map(_value_text, value))})"
    try:
        return str(np.shape(value))
    except ValueError:  # a list of lists of different lengths
        return type(value).__name__
