"""What every environment on the accelerator is: a pair of pure functions of one environment.

Nothing here resets by itself and nothing is batched: `collect/device.py` maps over environments,
and begins the next episode where one ended, so that no backend can lose the observation that an
episode ended with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

State = Any  # a pytree of arrays; whatever is random in an environment keeps its key in there


class Transition(NamedTuple):
    """One env step of one environment."""

    state: State
    observation: Array  # [*obs] that this very step reached, also where the episode ended
    reward: Array  # [] float32
    terminated: Array  # [] bool
    truncated: Array  # [] bool: a time limit, and not terminated


class JaxEnv(NamedTuple):
    """An environment as `reset(key) -> (state, observation)` and `step(state, action)`.

    Both are pure and can be compiled and vmapped; the state has the same structure, shapes and
    dtypes always. A time limit is the environment's own: it counts in its state and says
    `truncated`.

    Attributes:
      reset: `key -> (state, observation [*obs])`.
      step: `(state, action) -> Transition`; actions arrive as the action space has them.
      observation_space, action_space: Gymnasium spaces.
      render: `state -> image [H, W, 3] uint8` on the host, where there is one.
      frames_per_second: of `render`'s pictures, one per env step.
    """

    reset: Callable[[Array], tuple[State, Array]]
    step: Callable[[State, Array], Transition]
    observation_space: Any
    action_space: Any
    render: Callable[[State], Any] | None = None
    frames_per_second: float = 30.0
