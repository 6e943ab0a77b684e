"""Action masks of recorded episodes: a file has them apart, a learner in its observations."""

from __future__ import annotations

from typing import Any

import numpy as np

from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput

COLUMN = "action_mask"  # of a Parquet file, and in the infos of a Minari dataset


def read_masks(given: Any, length: int, spaces: Spaces, name: str) -> np.ndarray | None:
    """Reads the masks of `length` env steps as `[length, K]` int8; None if nobody acts by them.

    Args:
      given: what the data hold, a mask for each env step and perhaps more; None if nothing.
      spaces: of the environment that is trained on; name: of the data, for messages.

    Raises:
      BadInput: there are none, one is no mask, or one leaves no valid action.
    """
    if not spaces.mask:
        return None
    if given is None:
        raise BadInput(f"{name} has no {COLUMN}, which this policy acts by")
    from sauna.envs.masked import flat_masks  # imports Gymnasium

    masks = np.asarray(given)[:length]
    if masks.ndim != 2 or len(masks) != length:
        raise BadInput(f"{name}: its {COLUMN} is of shape {masks.shape}: one mask per env step")
    try:
        return flat_masks(masks, spaces.action_sizes)
    except ValueError as error:
        raise BadInput(f"{name}: {error}") from error


def with_masks(seen: np.ndarray, masks: np.ndarray | None, spaces: Spaces) -> np.ndarray:
    """Puts masks where `Spaces` has them: behind an observation's numbers, before its pictures.

    Args:
      seen: `[L, ...]` without masks; masks: `[L, K]`, or None: `seen` is complete.
    """
    if masks is None:
        return seen
    flat = seen.reshape(len(seen), -1)
    before, behind = flat[:, : spaces.numbers], flat[:, spaces.numbers :]
    return np.concatenate([before, masks, behind], axis=1, dtype=np.float64)


def with_every_action(seen: np.ndarray, spaces: Spaces) -> np.ndarray:
    """The observation behind an episode's end, where nobody acts: every action counts as valid."""
    every = np.ones((1, spaces.mask), np.int8) if spaces.mask else None
    return with_masks(seen[None], every, spaces)[0]


def check_taken(observation: np.ndarray, action: np.ndarray, spaces: Spaces, name: str) -> None:
    """Refuses recorded actions that their masks call invalid: no policy gives them.

    Args:
      observation: `[M, D]` with masks; action: `[M, A]` choices that count from 0.

    Raises:
      BadInput: naming the first env step.
    """
    if not spaces.mask:
        return
    first = spaces.numbers + np.cumsum((0, *spaces.action_sizes))[:-1]
    valid = np.take_along_axis(observation, first + action, 1).all(1)
    if not valid.all():
        step = int(np.argmin(valid))
        raise BadInput(f"{name}: the action of row {step} is not valid by its {COLUMN}")
