"""What is inside an observation of several parts: numbers, a mask of valid actions, pictures."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from sauna.algorithm.types import Array
from sauna.envs.spaces import Spaces, picture_size

INVALID = -1e9  # a masked action's logit: its probability is exactly 0 in float32


class Parts(NamedTuple):
    """What a `Combined` trunk sees."""

    numbers: Array  # [..., D] normalised
    pictures: tuple[Array, ...]  # [..., H, W, C] uint8 each


def seen_of(spaces: Spaces, observation: Array) -> Any:
    """What the trunk sees of observations `[..., *obs]`: all but the mask.

    It is one array, of numbers `[..., D]` or of a picture `[..., H, W, C]` uint8, or `Parts`.
    """
    if not spaces.mask and not spaces.pictures:
        return observation
    numbers, pictures = observation[..., : spaces.numbers], []
    start = spaces.numbers + spaces.mask
    for picture in spaces.pictures:
        end = start + picture_size(picture)
        flat = observation[..., start:end].astype(jnp.uint8)
        pictures.append(flat.reshape((*flat.shape[:-1], *picture[:3])))
        start = end
    if not pictures:
        return numbers
    if len(pictures) == 1 and not spaces.numbers:
        return pictures[0]
    return Parts(numbers, tuple(pictures))


def valid_logits(spaces: Spaces, observation: Array, logits: Array) -> Array:
    """The logits `[..., K]` with those of masked actions at `INVALID`, and without a gradient."""
    if not spaces.mask:
        return logits
    mask = observation[..., spaces.numbers : spaces.numbers + spaces.mask]
    return jnp.where(mask > 0, logits, INVALID)
