"""Recorded episodes, as the environment saw them, and what a learner makes of them."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from sauna.envs.actions import action_reader
from sauna.envs.spaces import Spaces, difference, seen_spaces
from sauna.system.errors import BadInput
from sauna.training.data.masks import check_taken

MINARI = "minari:"  # before the name of a Minari dataset; anything else is a Parquet file


class Recorded(NamedTuple):
    """One episode of `L` env steps, as the environment gave and took it."""

    seed: int
    observation: Any  # L + 1 observations, each part of a Dict or Tuple stacked for itself
    action: np.ndarray  # [L, ...] what `env.step` took
    reward: np.ndarray  # [L] float64
    terminated: bool
    truncated: bool  # also if it was cut
    mask: np.ndarray | None = None  # [L + 1, K] int8 of the valid actions, beside the observations


Add = Callable[[Recorded], None]


class Stored(NamedTuple):
    """One episode of a file, its observations read as a learner reads them, masks among them."""

    observation: np.ndarray  # [L, *obs] at each env step
    final: np.ndarray  # [*obs] behind the last step; without it, the last one before
    action: np.ndarray  # [L, ...] what `env.step` took
    reward: np.ndarray  # [L]
    terminated: bool


class Demonstrations(NamedTuple):
    """`E` episodes of `M` env steps in all, one behind the other."""

    observation: np.ndarray  # [M, *obs] raw
    action: np.ndarray  # [M, A] as the network gives it
    reward: np.ndarray  # [M] float64, raw
    final: np.ndarray  # [E, *obs] raw, behind the last step of each episode
    length: np.ndarray  # [E] env steps
    terminated: np.ndarray  # [E] bool

    @property
    def digest(self) -> str:
        """SHA-256 of everything that is learned from."""
        found = hashlib.sha256()
        for array in self:
            found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()


def demonstrations(
    episodes: Iterable[Stored], spaces: Spaces, action_space: Any, rescale: bool, name: str
) -> Demonstrations:
    """Gathers episodes, with actions as a network gives them.

    Args:
      spaces: of the environment; action_space: its own, whose bounds are read.
      rescale: actions in [-1, 1] are stretched to the bounds of a box.
      name: of the data, for messages.

    Raises:
      BadInput: there are fewer than two episodes, or one is not of these spaces, not finite, or
        took an action that its mask calls invalid.
    """
    read = action_reader(action_space, rescale)
    found = [episode for episode in episodes if len(episode.reward)]
    if len(found) < 2:
        raise BadInput(
            f"{name}: {len(found)} episodes; at least 2 are needed, as one in ten is held out"
        )
    try:
        action = np.concatenate([read(episode.action) for episode in found])
    except ValueError as error:
        raise BadInput(f"{name}: {error}") from error
    data = Demonstrations(
        np.concatenate([episode.observation for episode in found]),
        action.astype(spaces.action_dtype),
        np.concatenate([episode.reward for episode in found]).astype(np.float64),
        np.stack([episode.final for episode in found]),
        np.array([len(episode.reward) for episode in found]),
        np.array([episode.terminated for episode in found]),
    )
    shapes = data.observation.shape[1:], data.action.shape[1:]
    expected = tuple(spaces.observation_shape), (spaces.action_width,)
    for kind, here, there in zip(("observations", "actions"), shapes, expected, strict=True):
        if here != there:
            raise BadInput(f"{name}: its {kind} are of shape {here}, and {there} is needed")
    for kind in ("observation", "action", "reward", "final"):
        if not np.isfinite(getattr(data, kind)).all():
            raise BadInput(f"{name}: not every {kind} is finite")
    check_taken(data.observation, data.action, spaces, name)
    return data


def check_same(theirs: Spaces, ours: Spaces, name: str, env: str) -> None:
    """Refuses data of other spaces. Masks are no part of them.

    Raises:
      BadInput: naming the part that differs.
    """
    if differs := difference(seen_spaces(theirs), seen_spaces(ours)):
        raise BadInput(f"{name} has other spaces than {env}: {differs}")


def check_installed(name: str, extra: str, *modules: str) -> None:
    """Refuses a kind of file whose library is missing.

    Raises:
      BadInput: with the extra to install.
    """
    if any(importlib.util.find_spec(module) is None for module in modules):
        raise BadInput(f"{name} needs `pip install 'sauna-rl[{extra}]'`")
