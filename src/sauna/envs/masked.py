"""Environments that say which actions are valid: the mask becomes a part of the observation.

A mask is what `env.action_masks()` returns (sb3-contrib's name), or else `info["action_mask"]` of
each reset and step (Gymnasium's).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from sauna.system.errors import BadInput

OBSERVATION, MASK = "observation", "action_mask"
NONE_GIVEN = "action_mask: the environment gives none (action_masks(), or info['action_mask'])"


class MaskedSpace(gym.Dict):
    """An observation together with the mask of the actions that are valid there."""

    def __init__(self, observation_space: Any, action_space: Any) -> None:
        self.sizes = choices(action_space)
        self.mask_size = sum(self.sizes)
        super().__init__({OBSERVATION: observation_space, MASK: gym.MultiBinary(self.mask_size)})


def masked_space(observation_space: Any, action_space: Any) -> MaskedSpace:
    """Adds the mask to an observation space, unless it is there already."""
    if isinstance(observation_space, MaskedSpace):
        return observation_space
    return MaskedSpace(observation_space, action_space)


def choices(action_space: Any) -> tuple[int, ...]:
    """Counts the choices of each component of an action.

    Raises:
      BadInput: an action is no choice, so that nothing can be masked.
    """
    if isinstance(action_space, gym.Discrete):
        return (int(action_space.n),)
    if isinstance(action_space, gym.MultiDiscrete) and action_space.nvec.ndim == 1:
        return tuple(int(n) for n in action_space.nvec)
    raise BadInput(
        "action_mask: needs Discrete or MultiDiscrete actions, not "
        f"{' '.join(str(action_space).split())}"
    )


def flat_mask(given: Any, sizes: tuple[int, ...]) -> np.ndarray:
    """Reads a mask as `[sum(sizes)]` int8, 1 for a valid choice; component after component.

    Args:
      given: an array of that many truth values or zeros and ones, or one array for each component.

    Raises:
      ValueError: it is no mask, has another number of entries, or leaves a component no choice.
    """
    parts = given if isinstance(given, tuple | list) else (given,)
    try:
        mask = np.concatenate([np.asarray(part).reshape(-1) for part in parts])
    except ValueError as error:
        raise ValueError("the action mask is no array") from error
    if mask.size != sum(sizes):
        raise ValueError(f"the action mask has {mask.size} entries instead of {sum(sizes)}")
    if mask.dtype.kind not in "biuf" or not ((mask == 0) | (mask == 1)).all():
        raise ValueError("the action mask holds other values than 0 and 1, or False and True")
    mask = mask.astype(np.int8)
    starts = np.cumsum((0, *sizes))[:-1]
    if not np.maximum.reduceat(mask, starts).all():
        which = f" of component {_first_empty(mask, starts)}" if len(sizes) > 1 else ""
        raise ValueError(f"the action mask leaves no valid action{which}")
    return mask


def flat_masks(given: Any, sizes: tuple[int, ...]) -> np.ndarray:
    """Reads one mask `[K]`, or a batch of them `[n, K]`.

    Raises:
      ValueError: as `flat_mask`.
    """
    if isinstance(given, tuple | list) or np.ndim(given) != 2:
        return flat_mask(given, sizes)
    return np.stack([flat_mask(one, sizes) for one in given])


def is_masked(observation: Any) -> bool:
    """Whether an observation comes with its mask, as `MaskedEnv` gives it."""
    return isinstance(observation, Mapping) and set(observation) == {OBSERVATION, MASK}


def _first_empty(mask: np.ndarray, starts: np.ndarray) -> int:
    return int(np.flatnonzero(np.maximum.reduceat(mask, starts) == 0)[0])


def mask_method(env: Any) -> Callable[[], Any] | None:
    """Finds `action_masks` of an environment or of what it wraps; None if there is none."""
    while env is not None:
        method = getattr(env, "action_masks", None)
        if callable(method):
            return method
        env = getattr(env, "env", None)
    return None


class MaskedEnv:
    """An environment whose observation is a dict of the observation and the mask.

    Where an episode ends nobody acts, and every action counts as valid.

    Raises:
      BadInput: its actions are no choices.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self.observation_space = MaskedSpace(env.observation_space, env.action_space)
        self._method = mask_method(env)

    def reset(self, **how: Any) -> Any:
        answer = self._env.reset(**how)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            return answer  # refused by who reads it
        return self._with_mask(*answer), answer[1]

    def step(self, action: Any) -> Any:
        answer = self._env.step(action)
        if not (isinstance(answer, tuple) and len(answer) == 5):
            return answer
        observation, _, terminated, truncated, info = answer
        if terminated or truncated:
            mask = np.ones(self.observation_space.mask_size, np.int8)
            return {OBSERVATION: observation, MASK: mask}, *answer[1:]
        return self._with_mask(observation, info), *answer[1:]

    def _with_mask(self, observation: Any, info: Any) -> dict[str, Any]:
        given = self._method() if self._method else (info or {}).get(MASK)
        if given is None:
            raise BadInput(NONE_GIVEN)
        return {OBSERVATION: observation, MASK: flat_mask(given, self.observation_space.sizes)}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # also of a copy that is not complete yet
            raise AttributeError(name)
        return getattr(self._env, name)


def sample_valid(space: gymnasium.Space, mask: np.ndarray) -> Any:
    """Draws a valid action by the space's own generator."""
    if isinstance(space, gym.Discrete):
        return space.sample(mask=mask)
    sizes = choices(space)
    return space.sample(mask=tuple(np.split(mask, np.cumsum(sizes)[:-1])))
