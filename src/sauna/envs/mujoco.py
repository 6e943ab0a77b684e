"""Gymnasium's MuJoCo v5 tasks without Gymnasium's cost per step.

Each environment is Gymnasium's own: it makes the model, draws the resets, and replays episodes.
Only `step` is short-circuited: `mj_step` on every environment's own `MjData`, then observations,
rewards and ends of all of them at once in numpy. The arithmetic keeps the order and the precision
of Gymnasium's, so that both give the same bits; what depends on a scalar routine (a power, a norm)
is left to the environment's own method.

Tasks whose physics dwarfs the rest (Ant, Humanoid, HumanoidStandup, Pusher) call the environment's
own `step` and save only the wrappers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.mujoco import (
    ant_v5,
    half_cheetah_v5,
    hopper_v5,
    humanoid_v5,
    humanoidstandup_v5,
    inverted_double_pendulum_v5,
    inverted_pendulum_v5,
    pusher_v5,
    reacher_v5,
    swimmer_v5,
    walker2d_v5,
)
from gymnasium.wrappers import OrderEnforcing, TimeLimit

from sauna.envs.contract import Snapshot, Step
from sauna.envs.gymnasium import EnvironmentFailure, GymnasiumEnvs, Slot
from sauna.errors import one_line


class Task:
    """M environments of one kind, stepped by their own methods.

    Attributes:
      envs: Gymnasium's environments, without wrappers.
    """

    def __init__(self, envs: list[Any]) -> None:
        self.envs = envs

    def gather(self, index: int) -> None:
        """Reads the state of environment `index`, which was reset or replayed."""

    def step(
        self,
        active: list[bool],
        action: np.ndarray,
        observation: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        """Steps the active ones with clipped actions `[M, A]`; writes the three other arrays."""
        for i, on in enumerate(active):
            if on:
                observation[i], reward[i], terminated[i], _, _ = self.envs[i].step(action[i])


class BatchTask(Task):
    """M environments whose states lie side by side in one array.

    Attributes:
      state: `[M, nq + nv]` positions and velocities; `qpos` and `qvel` are its two parts.
    """

    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        model = envs[0].model
        self.state = np.zeros((len(envs), model.nq + model.nv))
        self.qpos, self.qvel = self.state[:, : model.nq], self.state[:, model.nq :]
        self._frame_skip = envs[0].frame_skip
        # Persistent views into MuJoCo's memory: making one costs as much as copying it.
        self._physics = [(env.model, env.data, env.data.ctrl) for env in envs]
        self._parts = [part for env in envs for part in (env.data.qpos, env.data.qvel)]
        self._flat = self.state.reshape(-1)

    def gather(self, index: int) -> None:
        data = self.envs[index].data
        self.qpos[index], self.qvel[index] = data.qpos, data.qvel

    def step(
        self,
        active: list[bool],
        action: np.ndarray,
        observation: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        mj_step, frame_skip = mujoco.mj_step, self._frame_skip
        rows = action.astype(np.float64)
        for (model, data, ctrl), row, on in zip(self._physics, rows, active, strict=True):
            if on:
                ctrl[:] = row
                mj_step(model, data, frame_skip)
        np.concatenate(self._parts, out=self._flat)
        self.evaluate(action, observation, reward, terminated)

    def evaluate(
        self,
        action: np.ndarray,
        observation: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        """Writes what the new states come to; rows of environments that stood still are unused."""
        raise NotImplementedError


class Runner(BatchTask):
    """HalfCheetah and Swimmer: forward speed minus the cost of control, no end."""

    speed_limit: float | None = None  # bound of the velocities that are observed

    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        env = envs[0]
        self._before, self._now = np.zeros(len(envs)), self.qpos[:, 0]
        self._dt, self._weight = env.dt, env._forward_reward_weight
        self._cost = env._ctrl_cost_weight
        skipped = env.observation_structure["skipped_qpos"]
        self._position = self.qpos[:, skipped:]
        self._split = self._position.shape[1]

    def gather(self, index: int) -> None:
        super().gather(index)
        self._before[index] = self._now[index]

    def evaluate(
        self,
        action: np.ndarray,
        observation: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        forward = self._now - self._before
        forward /= self._dt
        forward *= self._weight
        self._before[:] = self._now
        cost = self._cost * np.add.reduce(np.square(action), 1)
        np.subtract(self._rewarded(forward, terminated), cost, out=reward)
        observation[:, : self._split] = self._position
        if self.speed_limit is None:
            observation[:, self._split :] = self.qvel
        else:
            limit = self.speed_limit
            speed = np.maximum(self.qvel, -limit)
            np.minimum(speed, limit, out=observation[:, self._split :])

    def _rewarded(self, forward: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        return forward


class Walker(Runner):
    """Hopper and Walker2d: the same with a reward for being healthy, and an end otherwise."""

    speed_limit = 10.0

    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        env = envs[0]
        low = np.full(self.state.shape[1] - 1, -np.inf)  # of all states but x
        high = np.full_like(low, np.inf)
        if hasattr(env, "_healthy_state_range"):  # Hopper's third condition
            low[1:], high[1:] = env._healthy_state_range
        low[0], high[0] = env._healthy_z_range
        low[1] = max(low[1], env._healthy_angle_range[0])
        high[1] = min(high[1], env._healthy_angle_range[1])
        columns = len(low) if hasattr(env, "_healthy_state_range") else 2
        self._low, self._high = low[:columns], high[:columns]
        self._judged = self.state[:, 1 : 1 + columns]
        self._healthy_reward, self._ends = env._healthy_reward, env._terminate_when_unhealthy

    def _rewarded(self, forward: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        inside = (self._judged > self._low) & (self._judged < self._high)
        healthy = np.logical_and.reduce(inside, 1)
        if self._ends:
            np.logical_not(healthy, out=terminated)
        return forward + healthy * self._healthy_reward


class InvertedPendulum(BatchTask):
    def evaluate(
        self,
        action: np.ndarray,
        observation: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        observation[:] = self.state
        finite = np.logical_and.reduce(np.isfinite(self.state), 1)
        terminated[:] = ~finite | (np.abs(self.state[:, 1]) > 0.2)
        np.logical_not(terminated, out=reward, casting="unsafe")


class InvertedDoublePendulum(BatchTask):
    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        self._tips = [env.data.site_xpos[0] for env in envs]
        self._constraints = [env.data.qfrc_constraint[:1] for env in envs]

    def evaluate(
        self,
        action: np.ndarray,
        observation: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        observation[:, :1] = self.qpos[:, :1]
        np.sin(self.qpos[:, 1:], out=observation[:, 1:3])
        np.cos(self.qpos[:, 1:], out=observation[:, 3:5])
        observation[:, 5:8] = self.qvel
        for i, tip in enumerate(self._tips):
            x, _, y = tip
            terminated[i] = y <= 1
            reward[i], _ = self.envs[i]._get_rew(x, y, bool(terminated[i]))
            observation[i, 8:] = self._constraints[i]
        np.maximum(observation[:, 5:], -10, out=observation[:, 5:])
        np.minimum(observation[:, 5:], 10, out=observation[:, 5:])


class Reacher(BatchTask):
    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        self._ends = [
            (env.data.body("fingertip").xpos, env.data.body("target").xpos) for env in envs
        ]
        self._distance_weight = envs[0]._reward_dist_weight
        self._control_weight = envs[0]._reward_control_weight

    def evaluate(
        self,
        action: np.ndarray,
        observation: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        theta = self.qpos[:, :2]
        np.cos(theta, out=observation[:, :2])
        np.sin(theta, out=observation[:, 2:4])
        observation[:, 4:6] = self.qpos[:, 2:]
        observation[:, 6:8] = self.qvel[:, :2]
        for i, (fingertip, target) in enumerate(self._ends):
            vector = fingertip - target
            observation[i, 8:] = vector[:2]
            reward[i] = -math.sqrt(vector.dot(vector)) * self._distance_weight
        control = -np.add.reduce(np.square(action), 1) * self._control_weight
        reward += control


TASKS: dict[type, type[Task]] = {
    ant_v5.AntEnv: Task,
    half_cheetah_v5.HalfCheetahEnv: Runner,
    hopper_v5.HopperEnv: Walker,
    humanoid_v5.HumanoidEnv: Task,
    humanoidstandup_v5.HumanoidStandupEnv: Task,
    inverted_double_pendulum_v5.InvertedDoublePendulumEnv: InvertedDoublePendulum,
    inverted_pendulum_v5.InvertedPendulumEnv: InvertedPendulum,
    pusher_v5.PusherEnv: Task,
    reacher_v5.ReacherEnv: Reacher,
    swimmer_v5.SwimmerEnv: Runner,
    walker2d_v5.Walker2dEnv: Walker,
}


def time_limit(env: Any) -> int | None:
    """Steps after which `env` is truncated, if it is one that the fast path can step; else None.

    It must be exactly Gymnasium's time limit around one of the eleven tasks: any other wrapper, or
    a subclass, may do something in `step` that would be lost.
    """
    if type(env) is not TimeLimit or type(env.env) is not OrderEnforcing:
        return None
    return env._max_episode_steps if type(env.env.env) in TASKS else None


class MujocoEnvs(GymnasiumEnvs):
    """M environments of one of the eleven tasks, stepped fast.

    Args:
      make: makes one environment, which `time_limit` must accept.
      seeds: `(member seed, env index)` of each environment.
    """

    def __init__(self, make: Callable[[], Any], seeds: Sequence[tuple[int, int]]) -> None:
        super().__init__(make, seeds)
        limit = time_limit(self._slots[0].env)
        assert limit is not None
        self._limit = limit
        envs = [slot.env.unwrapped for slot in self._slots]
        self._task = TASKS[type(envs[0])](envs)
        self._low, self._high = envs[0].action_space.low, envs[0].action_space.high
        # A product with zeros is 0 exactly if every number is finite: one call instead of several.
        self._flat = self._observation.reshape(-1)
        self._zeros = np.zeros(self._flat.size)

    def _start_episode(self, index: int, slot: Slot) -> None:
        super()._start_episode(index, slot)
        self._task.gather(index)

    def restore(self, index: int, snapshot: Snapshot) -> np.ndarray:
        observation = super().restore(index, snapshot)
        self._task.gather(index)
        return observation

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        which = active.tolist()
        clipped = np.minimum(np.maximum(action, self._low), self._high)
        self._terminated[:] = False
        try:
            self._task.step(which, clipped, self._observation, self._reward, self._terminated)
        except Exception as error:  # MuJoCo's fatal errors; which environment is not known
            names = ", ".join(slot.name for slot in self._slots)
            raise EnvironmentFailure(f"one of {names}: step raised {one_line(error)}") from error
        over = False
        for slot, on, row in zip(self._slots, which, action, strict=True):
            if on:
                slot.actions.append(row)
                over = over or len(slot.actions) >= self._limit
        if not self._is_finite():
            self._check_finite(active)
        ended = over or True in self._terminated.tolist()
        if ended:
            self._end(active)
        else:
            self._truncated[:] = False
        return self._told(ended)

    def _is_finite(self) -> bool:
        rewards = self._reward.dot(self._zeros[: len(self._reward)])
        return bool(self._flat.dot(self._zeros) == 0.0 and rewards == 0.0)

    def _end(self, active: np.ndarray) -> None:
        """Keeps the final observation of every ended episode and starts the next one."""
        self._terminated &= active
        self._truncated[:] = False
        for index in np.flatnonzero(active):
            slot = self._slots[index]
            over = len(slot.actions) >= self._limit
            if over or self._terminated[index]:
                self._truncated[index] = not self._terminated[index]
                self._final[index] = self._observation[index]
                self._start_episode(int(index), slot)
