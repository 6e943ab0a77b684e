"""Environments whose rows are stepped together: a vector environment, or several agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sauna.envs.actions import action_writer
from sauna.envs.host.answers import close
from sauna.envs.host.contract import HostEnvs, Snapshot, Step
from sauna.envs.host.gymnasium_envs import LARGEST, EnvironmentFailure
from sauna.envs.spaces import describe, observation_reader
from sauna.system.errors import one_line


@dataclass
class Group:
    """Rows that one object steps.

    Attributes:
      env: that object.
      seeds: `(member seed, env index)` of its first row.
      rows: its place among all rows.
      episode: how often it was reset, less one.
      actions: those since then, if it can be replayed.
    """

    env: Any
    seeds: tuple[int, int]
    rows: slice
    episode: int = -1
    actions: list[np.ndarray] = field(default_factory=list)

    @property
    def number(self) -> int:
        """Counts its rows."""
        return int(self.rows.stop - self.rows.start)


class GroupedEnvs(HostEnvs):
    """M rows in groups. What a group does is for its kind: `_begin` and `_step_group`.

    Args:
      groups: in the order of their rows.
      observation_space, action_space: of one row.
      rescale: as of `action_writer`.
    """

    kind = "group"  # of environments, for messages

    def __init__(
        self, groups: Sequence[Group], observation_space: Any, action_space: Any, rescale: bool
    ) -> None:
        self._groups = groups
        self.spaces = describe(observation_space, action_space)
        self._read = observation_reader(observation_space)
        self._write = action_writer(action_space, rescale)
        self._is_plain = self.spaces.observation_structure == (
            "Box",
            *self.spaces.observation_shape,
        )
        number = groups[-1].rows.stop
        shape = (number, *self.spaces.observation_shape)
        dtype = np.uint8 if self.spaces.observation_kind == "image" else np.float64
        self._observation, self._final = np.zeros(shape, dtype), np.zeros(shape, dtype)
        self._reward = np.zeros(number)
        self._terminated, self._truncated, self._life_lost = np.zeros((3, number), bool)
        self._waiting = np.zeros(number, bool)
        self.waiting = self._waiting  # the same array, which is never None here
        self._info: dict[int, dict[str, float]] = {}

    def _begin(self, group: Group) -> None:
        """Begins the next episode in all rows of a group."""
        raise NotImplementedError

    def _step_group(self, group: Group, action: np.ndarray) -> None:
        """Takes a step with the actions `[N, A]`, and begins episodes anew if that is due."""
        raise NotImplementedError

    def reset(self) -> np.ndarray:
        for group in self._groups:
            group.episode = -1
            self._restart(group)
        return self._observation.copy()

    def _restart(self, group: Group) -> None:
        try:
            self._begin(group)
        except Exception as error:
            raise self._failure(group, f"reset raised {one_line(error)}") from error

    def _failure(self, group: Group, what: str) -> EnvironmentFailure:
        seed, index = group.seeds
        return EnvironmentFailure(f"{self.kind} {index} of seed {seed}: {what}")

    def _put(self, rows: np.ndarray, row: int, observation: Any) -> None:
        """Writes one observation to its row.

        Raises:
          ValueError: it is of another shape than its space, not finite, or too large.
        """
        read = np.asarray(self._read(observation))
        if read.shape != rows.shape[1:]:
            raise ValueError(f"an observation is of shape {read.shape}, not {rows.shape[1:]}")
        if not (np.abs(read) <= LARGEST).all():
            raise ValueError(f"the observation of row {row} is not finite, or too large")
        rows[row] = read

    def _put_all(self, rows: np.ndarray, group: Group, batch: Any) -> bool:
        """Writes the plain vectors of all rows of a group at once; False for other observations."""
        if not self._is_plain:
            return False
        read = np.asarray(batch)
        if read.shape != rows[group.rows].shape or not (np.abs(read) <= LARGEST).all():
            return False  # row by row it is found which
        rows[group.rows] = read
        return True

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        self._terminated[:], self._truncated[:], self._reward[:] = False, False, 0.0
        self._info = {}
        for group in self._groups:
            acting = active[group.rows]
            if acting.any() and not acting.all():
                raise self._failure(
                    group,
                    f"all rows of one {self.kind} must step together; some are active and some "
                    "are not",
                )
            if not acting.any():
                continue
            try:
                self._step_group(group, action[group.rows])
                if not (np.abs(self._reward[group.rows]) <= LARGEST).all():
                    raise ValueError("a reward is not finite, or too large")
            except Exception as error:
                raise self._failure(group, f"step raised {one_line(error)}") from error
        ended = bool((self._terminated | self._truncated).any())
        return Step(
            self._observation,
            self._reward,
            self._terminated,
            self._truncated,
            self._life_lost,
            self._final,
            ended,
            self._info,
        )

    def snapshot(self, index: int) -> Snapshot:
        """What all rows of a group did since its reset, with its first row only.

        None can be brought back alone.
        """
        group = self._of(index)
        taken = group.actions if index == group.rows.start else []
        width = (len(taken), group.number, self.spaces.action_width)
        actions = np.asarray(taken, self.spaces.action_dtype).reshape(width)
        return {"episode": np.asarray(group.episode), "actions": actions}

    def restore(self, index: int, snapshot: Snapshot) -> np.ndarray:
        group = self._of(index)
        if index == group.rows.start:
            group.episode = int(snapshot["episode"]) - 1
            self._restart(group)
            for action in snapshot["actions"]:
                self._step_group(group, action)
        return self._observation[index].copy()

    def start_after(self, index: int, snapshot: Snapshot) -> np.ndarray:
        group = self._of(index)
        if index == group.rows.start:
            group.episode = int(snapshot["episode"])
            self._restart(group)
        return self._observation[index].copy()

    def _of(self, index: int) -> Group:
        return next(group for group in self._groups if index < group.rows.stop)

    def close(self) -> None:
        for group in self._groups:
            close(group.env, f"{self.kind} {group.seeds[1]} of seed {group.seeds[0]}")
