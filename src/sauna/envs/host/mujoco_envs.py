"""MuJoCo's tasks without their cost per step: Gymnasium's v5, and HumanoidFlagrunHarder.

Each environment is Gymnasium's own: it makes the model, draws the resets, and replays episodes.
Only `step` is short-circuited: `mj_step` on every environment's own `MjData`, then observations,
rewards and ends of all of them at once; see `mujoco_tasks.py` and `flagrun_rows.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.wrappers import OrderEnforcing, TimeLimit

from sauna.envs.flagrun import task as rules
from sauna.envs.flagrun.host import HumanoidFlagrunHarder
from sauna.envs.host.contract import Snapshot, Step
from sauna.envs.host.flagrun_rows import FlagrunRows
from sauna.envs.host.gymnasium_envs import EnvironmentFailure, GymnasiumEnvs, Slot
from sauna.envs.host.mujoco_tasks import TASKS, Outcome, make_task
from sauna.envs.info import numbers_of
from sauna.system.compiled import compiled
from sauna.system.errors import one_line

CAPACITY = 1000  # steps of an episode that memory is taken for at the start


def is_flagrun(env: Any) -> bool:
    """Whether it is HumanoidFlagrunHarder itself, without wrappers."""
    return type(env) is HumanoidFlagrunHarder


def time_limit(env: Any) -> int | None:
    """Steps after which `env` is truncated, if it is one that the fast path can step; else None.

    It must be exactly Gymnasium's time limit around one of the eleven tasks, or the flag run, which
    keeps its own: any other wrapper, or a subclass, may do something in `step` that would be lost.
    """
    if type(env) is OrderEnforcing and is_flagrun(env.env):
        return rules.TIME_LIMIT
    if type(env) is not TimeLimit or type(env.env) is not OrderEnforcing:
        return None
    return env._max_episode_steps if type(env.env.env) in TASKS else None


class MujocoEnvs(GymnasiumEnvs):
    """M environments of one of these tasks, stepped fast.

    Args:
      make: makes one environment, which `time_limit` must accept.
      seeds: `(member seed, env index)` of each environment.
    """

    def __init__(self, make: Callable[[], Any], seeds: Sequence[tuple[int, int]]) -> None:
        super().__init__(make, seeds)
        limit = time_limit(self._slots[0].env)
        assert limit is not None
        envs = [slot.env.unwrapped for slot in self._slots]
        self._task = FlagrunRows(envs) if is_flagrun(envs[0]) else make_task(envs)
        self._limit, self._over = limit, False
        self._low, self._high = envs[0].action_space.low, envs[0].action_space.high
        self._clipped = np.zeros((len(envs), len(self._low)), np.float32)
        self._outcome = Outcome(self._observation, self._reward, self._terminated)
        # The actions of the running episodes `[M, capacity, A]`, of which `_steps` `[M]` are taken.
        self._actions = np.zeros((len(envs), min(limit, CAPACITY), len(self._low)), np.float32)
        self._steps = np.zeros(len(envs), np.int64)
        # Compiles the loops here, where no time limit of a step counts; nobody is active.
        self.step(np.zeros_like(self._clipped), np.zeros(len(envs), bool))

    def _start_episode(self, index: int, slot: Slot) -> None:
        super()._start_episode(index, slot)
        self._task.gather(index)
        self._steps[index] = 0

    def _steps_taken(self, index: int) -> int:
        return int(self._steps[index])

    def snapshot(self, index: int) -> Snapshot:
        actions = self._actions[index, : self._steps[index]].copy()
        return {"episode": np.asarray(self._slots[index].episode), "actions": actions}

    def restore(self, index: int, snapshot: Snapshot) -> np.ndarray:
        observation = super().restore(index, snapshot)
        self._task.gather(index)
        taken = len(snapshot["actions"])
        self._make_room(taken)
        self._actions[index, :taken], self._steps[index] = snapshot["actions"], taken
        return observation

    def _make_room(self, steps: int) -> None:
        """Doubles the capacity for actions until one more fits behind `steps` of them."""
        while self._actions.shape[1] <= steps:
            self._actions = np.concatenate([self._actions, np.zeros_like(self._actions)], 1)

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        if self._over:
            self._terminated[:] = False
            self._truncated[:] = False
            self._info = {}
        _clip(action, self._low, self._high, self._clipped)
        try:
            self._task.step(active, self._clipped, self._outcome)
        except Exception as error:  # which environment is not known
            names = ", ".join(slot.name for slot in self._slots)
            raise EnvironmentFailure(f"one of {names}: step raised {one_line(error)}") from error
        longest = _record(action, active, self._actions, self._steps)
        if not self._is_finite():
            self._check_finite(active)
        self._over = longest >= self._limit or True in self._terminated.tolist()
        if self._over:
            self._end(active)
        if longest < self._limit:
            self._make_room(longest)
        return self._told(self._over)

    def _is_finite(self) -> bool:
        return _all_finite(self._observation, self._reward)

    def _end(self, active: np.ndarray) -> None:
        """Keeps what every ended episode ended with, and starts the next one."""
        self._terminated &= active
        for index in np.flatnonzero(active).tolist():
            if self._terminated[index] or self._steps[index] >= self._limit:
                self._truncated[index] = not self._terminated[index]
                self._final[index] = self._observation[index]
                self._info[index] = numbers_of(self._task.info(index, self._clipped[index]))
                self._start_episode(index, self._slots[index])


@compiled
def _record(action: Any, active: Any, actions: Any, steps: Any) -> int:
    """Notes the actions of the active environments; the steps of the longest episode of these."""
    longest = 0
    for i in range(len(steps)):
        if active[i]:
            for j in range(action.shape[1]):
                actions[i, steps[i], j] = action[i, j]
            steps[i] += 1
            longest = max(longest, steps[i])
    return longest


@compiled
def _clip(action: Any, low: Any, high: Any, clipped: Any) -> None:
    for i in range(len(action)):
        for j in range(len(low)):
            clipped[i, j] = min(max(action[i, j], low[j]), high[j])


@compiled
def _all_finite(observation: Any, reward: Any) -> bool:
    total = 0.0  # of zeros, unless some number is not finite
    for i in range(len(reward)):
        total += 0.0 * reward[i]
        for j in range(observation.shape[1]):
            total += 0.0 * observation[i, j]
    return total == 0.0
