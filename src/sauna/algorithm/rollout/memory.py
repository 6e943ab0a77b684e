"""The states of recurrent policies while host environments are stepped, for P members."""

from __future__ import annotations

from typing import Any

import numpy as np

from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.types import Memory
from sauna.config.settings import Config


class HostMemory:
    """States `[P, N, H]`, zero at the start of each episode, and what learning needs of them.

    A policy that is not recurrent has H = 0, and nothing here does anything.

    Attributes:
      state: `[P, N, H]` before the coming row; it persists between rollouts.
      acting: `[P, N]` bool; the states of the other environments stay. Behind a row in which one
        does not act, it starts an episode, if it acts at all.
      rollout: `Memory` of the rollout, arrays with a leading axis P; None if nothing is remembered.
    """

    def __init__(self, config: Config, policy: Policy, members: int, rows: int) -> None:
        self._length, self._row = config.sequence_length, 0
        shape = (members, config.envs, policy.state_size)
        self.state = np.zeros(shape, np.float32)
        self.acting = np.zeros(shape[:2], bool)
        self._segment = np.zeros(shape, np.float32)
        self.rollout: Any = None
        if policy.state_size:
            start = np.zeros((members, rows, config.envs), bool)
            chunks = (members, rows // self._length, *shape[1:])
            self.rollout = Memory(start, np.zeros(chunks, np.float32))

    def begin(self) -> None:
        """Goes back to the first row of a rollout."""
        self._row = 0
        if self.rollout is not None:
            self.rollout.start[:] = False

    def begin_segment(self, member: int) -> None:
        """Notes the states with which a member's next segment begins."""
        self._segment[member] = self.state[member]

    def of_segment(self, member: int, rows: slice) -> list[np.ndarray]:
        """Where episodes start in a segment `[L, N]`, and the states before it `[N, H]`, if any."""
        if self.rollout is None:
            return []
        return [self.rollout.start[member, rows], self._segment[member]]

    def now(self, member: int) -> list[np.ndarray]:
        """A member's states `[N, H]`, if it has any."""
        return [] if self.rollout is None else [self.state[member]]

    def advance(self, state: np.ndarray) -> None:
        """Goes to the next row: the acting environments have the new states."""
        if self._row % self._length == 0:
            self.rollout.state[:, self._row // self._length] = self.state
        np.copyto(self.state, state, where=self.acting[..., None])
        self._row += 1
        if self._row < self.rollout.start.shape[1]:
            self.rollout.start[:, self._row] = ~self.acting

    def forget(self, over: np.ndarray) -> None:
        """Forgets the episodes that are over (`[P, N]`) with the row before."""
        if self.rollout is None:
            return
        self.state[over] = 0.0
        if self._row < self.rollout.start.shape[1]:
            self.rollout.start[:, self._row] |= over
