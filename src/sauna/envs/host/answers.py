"""What an environment answers, read with the obvious meaning or refused in a line."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from sauna.system.errors import SaunaError, one_line

MAX_SIGNED = 2**31 - 1  # the largest seed of a simulator that keeps it in a signed int
_SAID: set[str] = set()  # warnings of this process


def one_number(reward: Any) -> float:
    """A reward as a number; an array of a single number, of any shape, is that number.

    Raises:
      ValueError: it is several numbers, or none.
    """
    if type(reward) is float:  # asked first: it costs least, at every env step
        return reward
    if isinstance(reward, float | int):
        return float(reward)
    found = np.asarray(reward)
    number = found.size == 1 and found.dtype.kind != "c"
    if not number or not hasattr(found.reshape(-1)[0], "__float__"):
        what = f"of shape {found.shape}" if found.ndim else f"{reward!r:.40}"
        raise ValueError(f"the reward from step() is {what}, not one number")
    return float(found.reshape(-1)[0])


def life_lost(info: Any) -> bool:
    """Whether `info` says that a life was lost; `None` says nothing.

    Raises:
      ValueError: `info` is no dict, or says more than yes or no.
    """
    if info is None or (type(info) is dict and "life_lost" not in info):
        return False
    if not isinstance(info, Mapping):
        raise ValueError(f"info is a {type(info).__name__}, not a dict")
    lost = info.get("life_lost", False)
    if np.size(lost) != 1:
        raise ValueError(f"info['life_lost'] is of shape {np.shape(lost)}, not yes or no")
    return bool(np.asarray(lost).reshape(()))


def five_of(answer: Any) -> tuple[Any, Any, Any, Any, Any]:
    """What `step()` returned, which must be Gymnasium's five values.

    Raises:
      ValueError: it is something else.
    """
    if isinstance(answer, tuple) and len(answer) == 5:
        return answer
    raise ValueError(
        "step() must return observation, reward, terminated, truncated, info; it returned "
        f"{_counted(answer)}"
    )


def first_of(answer: Any) -> Any:
    """The observation of what `reset()` returned, which must be Gymnasium's two values.

    Raises:
      ValueError: it is something else.
    """
    if isinstance(answer, tuple) and len(answer) == 2:
        return answer[0]
    raise ValueError(f"reset() must return observation, info; it returned {_counted(answer)}")


def _counted(answer: Any) -> str:
    if isinstance(answer, tuple):
        return f"{len(answer)} value{'' if len(answer) == 1 else 's'}"
    return "nothing" if answer is None else f"one {type(answer).__name__}"


def reset_with(env: Any, seed: int) -> Any:
    """The first observation of the episode of `seed`, a number below 2^32.

    A simulator that keeps its seed in a signed int refuses half of these; it gets the lower 31
    bits instead.
    """
    try:
        answer = env.reset(seed=seed)
    except Exception as error:
        if seed <= MAX_SIGNED or isinstance(error, SaunaError) or not _is_of_seed(error, seed):
            raise  # one of ours comes from a worker, which has tried the lower bits already
        answer = env.reset(seed=seed & MAX_SIGNED)
    return first_of(answer)


def _is_of_seed(error: Exception, seed: int) -> bool:
    """Whether an exception says that a seed is too large."""
    text = str(error).lower()
    return isinstance(error, OverflowError) or "seed" in text or str(seed) in text


def close(env: Any, name: str = "the environment") -> None:
    """Closes an environment; a failure to close prints one line, once, and costs nothing else."""
    try:
        env.close()
    except (Exception, SystemExit) as error:
        text = f"warning: {name} cannot be closed: {one_line(error)}"
        if text not in _SAID:
            print(text, file=sys.stderr)
        _SAID.add(text)
