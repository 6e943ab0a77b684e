"""Any Gymnasium environment as a host backend.

An environment is restored by replaying: its episode's seed and the actions since the reset are
the snapshot. That is exact for every environment that is deterministic given them, which
`probe.py` checks before a run starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sauna.envs.actions import action_writer
from sauna.envs.host.answers import close, five_of, life_lost, one_number, reset_with
from sauna.envs.host.contract import EVALUATION, HostEnvs, Snapshot, Step, episode_seed
from sauna.envs.info import numbers_of
from sauna.envs.spaces import describe, observation_reader
from sauna.system.errors import SaunaError, one_line

LARGEST = 1e38  # of an observation or a reward: float32 and the running moments hold no more


class EnvironmentFailure(SaunaError):
    """An environment raised, or gave numbers that cannot be learned from."""


def _square(x: np.ndarray) -> float:
    """The sum of squares: NaN or infinite where a number is, or is too large to be squared."""
    return float(np.vdot(x, x))


class Slot:
    """One environment, its running episode, and the actions taken in it."""

    __slots__ = ("actions", "env", "episode", "name", "seeds")

    def __init__(self, env: Any, seeds: tuple[int, int]) -> None:
        self.env, self.seeds, self.episode = env, seeds, -1
        self.actions: list[np.ndarray] = []
        number = "" if seeds[1] == EVALUATION else f" {seeds[1]}"
        self.name = f"environment{number} of seed {seeds[0]}"


class GymnasiumEnvs(HostEnvs):
    """M Gymnasium environments stepped one after the other in this process.

    Args:
      make: makes one environment.
      seeds: `(member seed, env index)` of each environment.
      rescale: as of `action_writer`.
    """

    def __init__(
        self, make: Callable[[], Any], seeds: Sequence[tuple[int, int]], rescale: bool = False
    ) -> None:
        self._slots = [Slot(make(), pair) for pair in seeds]
        env = self._slots[0].env
        self.spaces = describe(env.observation_space, env.action_space)
        self._read = observation_reader(env.observation_space)
        self._write = action_writer(env.action_space, rescale)
        self._shape = self.spaces.observation_shape
        number, shape = len(self._slots), self._shape
        dtype = np.uint8 if self.spaces.observation_kind == "image" else np.float64
        self._observation = np.zeros((number, *shape), dtype)
        self._final = np.zeros((number, *shape), dtype)
        self._final_sum = 0.0
        self._reward = np.zeros(number)
        self._terminated = np.zeros(number, bool)
        self._truncated = np.zeros(number, bool)
        self._life_lost = np.zeros(number, bool)
        self._info: dict[int, dict[str, float]] = {}  # of this step
        self._uneventful = Step(  # made once, as its arrays stay
            self._observation,
            self._reward,
            self._terminated,
            self._truncated,
            self._life_lost,
            self._final,
            ended=False,
        )

    def reset(self) -> np.ndarray:
        for index, slot in enumerate(self._slots):
            slot.episode = -1
            self._start_episode(index, slot)
        self._check_finite(np.ones(len(self._slots), bool))
        return self._observation.copy()

    def _start_episode(self, index: int, slot: Slot) -> None:
        slot.episode += 1
        slot.actions = []
        try:
            seed = episode_seed(*slot.seeds, slot.episode)
            observation = reset_with(slot.env, seed)
        except Exception as error:
            raise EnvironmentFailure(f"{slot.name}: reset raised {one_line(error)}") from error
        self._put(self._observation, index, observation)

    def _put(self, rows: np.ndarray, index: int, observation: Any) -> None:
        """Copies an observation into its row; another shape must not be stretched to fit."""
        try:
            read = self._read(observation)
            if read.shape != self._shape:
                raise ValueError(f"shape {read.shape} instead of {self._shape}")
        except Exception as error:
            slot = self._slots[index]
            raise EnvironmentFailure(
                f"{slot.name}, episode {slot.episode}, step {self._steps_taken(index)}: "
                f"observation cannot be read: {one_line(error)}"
            ) from error
        rows[index] = read

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        self._terminated[:] = False
        self._truncated[:] = False
        self._life_lost[:] = False
        self._info = {}
        ended = False
        for index in np.flatnonzero(active).tolist():
            ended |= self._step_one(index, self._slots[index], action[index])
        self._check_finite(active)
        return self._told(ended)

    def _told(self, ended: bool) -> Step:
        return self._uneventful._replace(ended=True, info=self._info) if ended else self._uneventful

    def _take(self, slot: Slot, action: np.ndarray) -> Any:
        """One step of one environment, as Gymnasium gives it."""
        return slot.env.step(self._write(action))

    def _step_one(self, index: int, slot: Slot, action: np.ndarray) -> bool:
        """Steps one environment; whether its episode ended, or a life of it was lost."""
        slot.actions.append(action)
        try:
            observation, given, terminated, truncated, info = five_of(self._take(slot, action))
            self._reward[index] = one_number(given)
            lost = life_lost(info)
        except Exception as error:
            raise EnvironmentFailure(f"{slot.name}: step raised {one_line(error)}") from error
        if terminated or truncated:
            self._terminated[index] = terminated
            self._truncated[index] = truncated and not terminated
            if numbers := numbers_of(info):
                self._info[index] = numbers
            self._put(self._final, index, observation)
            self._final_sum = _square(self._final)
            self._check_finite(np.arange(len(self._slots)) == index)
            self._start_episode(index, slot)
            return True
        self._put(self._observation, index, observation)
        self._life_lost[index] = lost
        return lost

    def _check_finite(self, active: np.ndarray) -> None:
        """Refuses what is not finite, or too large: one sum tells; then the culprit is looked for.

        Raises:
          EnvironmentFailure: naming the environment, the step and the number.
        """
        if self._is_finite():
            return
        for index in np.flatnonzero(active).tolist():
            slot = self._slots[index]
            where = f"{slot.name}, episode {slot.episode}, step {self._steps_taken(index)}"
            if not abs(self._reward[index]) <= LARGEST:
                raise EnvironmentFailure(f"{where}: reward is {self._reward[index]}")
            for row in (self._observation[index], self._final[index]):
                usable = np.abs(row) <= LARGEST
                if not usable.all():
                    component = int(np.flatnonzero(~usable)[0])
                    value = row.reshape(-1)[component]
                    raise EnvironmentFailure(f"{where}: observation[{component}] is {value}")

    def _steps_taken(self, index: int) -> int:
        """Env steps of the running episode."""
        return len(self._slots[index].actions)

    def _is_finite(self) -> bool:
        if self.spaces.observation_kind == "image":  # bytes are finite, and many
            return _square(self._reward) <= LARGEST**2
        squares = _square(self._observation) + _square(self._reward) + self._final_sum
        return squares <= LARGEST**2

    def snapshot(self, index: int) -> Snapshot:
        slot = self._slots[index]
        width = (len(slot.actions), self.spaces.action_width)
        actions = np.asarray(slot.actions, self.spaces.action_dtype).reshape(width)
        return {"episode": np.asarray(slot.episode), "actions": actions}

    def restore(self, index: int, snapshot: Snapshot) -> np.ndarray:
        slot = self._slots[index]
        slot.episode = int(snapshot["episode"]) - 1
        self._start_episode(index, slot)
        for action in snapshot["actions"]:
            slot.actions.append(action)
            observation = slot.env.step(self._write(action))[0]
            self._put(self._observation, index, observation)
        return self._observation[index].copy()

    def start_after(self, index: int, snapshot: Snapshot) -> np.ndarray:
        slot = self._slots[index]
        slot.episode = int(snapshot["episode"])
        self._start_episode(index, slot)
        self._check_finite(np.arange(len(self._slots)) == index)
        return self._observation[index].copy()

    def close(self) -> None:
        for slot in self._slots:
            close(slot.env, slot.name)
