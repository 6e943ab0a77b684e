"""What every host backend is: M environments stepped together, each of them restorable.

Resets happen inside `step`: where an episode ends, the returned observation is the first of the
next episode and `final_observation` holds the one that the ended episode really reached.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np

from sauna.envs.spaces import Spaces

Snapshot = dict[str, np.ndarray]
EVALUATION = 2**31  # the env index of evaluations' episodes: no environment of training has it
NO_INFO: Mapping[int, Mapping[str, float]] = MappingProxyType({})


class Step(NamedTuple):
    """One env step of M environments. Rows of environments that were not active are meaningless.

    The arrays may be reused by the next step.
    """

    observation: np.ndarray  # [M, *obs] what the policy sees next
    reward: np.ndarray  # [M] float64
    terminated: np.ndarray  # [M] bool
    truncated: np.ndarray  # [M] bool, never together with terminated
    life_lost: np.ndarray  # [M] bool, an end for learning alone: the episode goes on
    final_observation: np.ndarray  # [M, *obs], meaningful where an episode ended
    ended: bool  # whether any episode ended or life was lost: what most steps have to look at
    # The numbers of `info` where an episode ended, by the environment's row and their name.
    info: Mapping[int, Mapping[str, float]] = NO_INFO


class HostEnvs(Protocol):
    """M environments behind one interface.

    Attributes:
      spaces: of one environment.
      waiting: `[M]` bool, rows that wait for their next episode: whatever action they get, they
        take no env step, and what they show is no observation. None: no row ever waits.
    """

    spaces: Spaces
    waiting: np.ndarray | None = None

    def reset(self) -> np.ndarray:
        """Starts episode 0 everywhere; observations `[M, *obs]`."""

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        """Steps the active environments (`[M]` bool) with actions `[M, A]`, unclipped.

        Raises:
          EnvironmentFailure: an environment raised, returned non-finite numbers, or its worker
            died; the message names it.
        """

    def snapshot(self, index: int) -> Snapshot:
        """All that is needed to bring environment `index` back to where it is."""

    def restore(self, index: int, snapshot: Snapshot) -> np.ndarray:
        """Brings environment `index` to a snapshot's state; its observation `[*obs]` there."""

    def start_after(self, index: int, snapshot: Snapshot) -> np.ndarray:
        """Starts the episode after a snapshot's instead; its first observation `[*obs]`."""

    def close(self) -> None: ...


def episode_seed(member_seed: int, env_index: int, episode: int) -> int:
    """The seed that an episode is reset with: a function of nothing but these three."""
    sequence = np.random.SeedSequence([member_seed, env_index, episode])
    return int(sequence.generate_state(1)[0])
