"""What each of Gymnasium's MuJoCo v5 tasks makes of its physics, for M environments at once.

The arithmetic keeps the order and the precision of Gymnasium's, so that both give the same bits;
what depends on a scalar routine (a power, a norm) is left to the environment's own method.

Tasks whose physics dwarfs the rest (Ant, Humanoid, HumanoidStandup, Pusher) call the environment's
own `step` and save only the wrappers.
"""

from __future__ import annotations

import contextlib
import functools
import math
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
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
from numba import types

from sauna.system.compiled import compiled


class Outcome(NamedTuple):
    """Where a step of M environments is written to; rows of those that stood still are unused."""

    observation: np.ndarray  # [M, D] float64
    reward: np.ndarray  # [M] float64
    terminated: np.ndarray  # [M] bool


class Task:
    """M environments of one kind, stepped by their own methods.

    Attributes:
      envs: Gymnasium's environments, without wrappers.
    """

    def __init__(self, envs: list[Any]) -> None:
        self.envs = envs
        self._infos: list[dict[str, Any]] = [{} for _ in envs]  # of each one's last step

    def gather(self, index: int) -> None:
        """Reads the state of environment `index`, which was reset or replayed."""

    def step(self, active: np.ndarray, action: np.ndarray, out: Outcome) -> None:
        """Steps the active ones with clipped actions `[M, A]`; writes what came of it to `out`."""
        observation, reward, terminated = out
        for i, on in enumerate(active.tolist()):
            if on:
                observation[i], reward[i], terminated[i], _, info = self.envs[i].step(action[i])
                self._infos[i] = info

    def info(self, index: int, action: np.ndarray) -> dict[str, Any]:
        """Gymnasium's `info` of the step that environment `index` has just taken."""
        return self._infos[index]


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
        self._begun = np.zeros((len(envs), 2))  # first two positions before the last step
        self._control = np.zeros(model.nu)
        self._frame_skip = envs[0].frame_skip
        # Made alike, the environments have equal models: one is stepped, half a megabyte each saved
        # from passing through the caches.
        self._addresses = np.array([(model._address, env.data._address) for env in envs])

    def gather(self, index: int) -> None:
        data = self.envs[index].data
        self.qpos[index], self.qvel[index] = data.qpos, data.qvel

    def step(self, active: np.ndarray, action: np.ndarray, out: Outcome) -> None:
        _advance(
            self._addresses,
            self._frame_skip,
            _PARTS,
            active,
            action,
            self._control,
            self._begun,
            self.state,
        )
        self.evaluate(action, out)

    def info(self, index: int, action: np.ndarray) -> dict[str, Any]:
        """Lets the environment itself take its last step again, without the physics of it.

        Of where a step began, Gymnasium's tasks read the first two positions alone.
        """
        env, begun = self.envs[index], self._begun[index]
        positions = env.data.qpos
        reached = positions[: len(begun)].copy()

        def simulate(*_: Any) -> None:
            positions[: len(begun)] = reached

        positions[: len(begun)] = begun
        env.do_simulation = simulate
        try:
            return env.step(action)[4]
        finally:
            del env.do_simulation
            simulate()

    def evaluate(self, action: np.ndarray, out: Outcome) -> None:
        """Writes what the new states come to."""
        raise NotImplementedError


@functools.cache
def physics_is_linked() -> bool:
    """Makes MuJoCo's C functions known to compiled code; whether they could be found."""
    folder = Path(mujoco.__file__).parent
    for library in [*folder.glob("libmujoco*"), *folder.glob("mujoco.dll")]:
        with contextlib.suppress(RuntimeError):  # then the names are not found
            llvm.load_library_permanently(str(library))
    names = ("mj_step", "mj_getState", "mj_setState")
    return all(llvm.address_of_symbol(name) is not None for name in names)


_mj_step: Any = types.ExternalFunction("mj_step", types.void(types.intp, types.intp))
_mj_get_state: Any = types.ExternalFunction(
    "mj_getState", types.void(types.intp, types.intp, types.uintp, types.uint32)
)
_mj_set_state: Any = types.ExternalFunction(
    "mj_setState", types.void(types.intp, types.intp, types.uintp, types.uint32)
)
_PARTS = (  # of a state: what is written, what is read
    int(mujoco.mjtState.mjSTATE_CTRL),
    int(mujoco.mjtState.mjSTATE_QPOS) | int(mujoco.mjtState.mjSTATE_QVEL),
)


@compiled
def _advance(
    addresses: Any,
    frame_skip: int,
    parts: Any,
    active: Any,
    action: Any,
    control: Any,
    begun: Any,
    state: Any,
) -> None:
    """Steps the active environments' `MjData` and reads their positions and velocities.

    Args:
      addresses: `[M, 2]`, where each `MjModel` and `MjData` lies.
      parts: MuJoCo's names of what is written (controls) and read (motion).
      action: `[M, A]`; control: `[A]`, room for one row of it in double precision.
      begun: `[M, 2]` gets the first two positions before the step.
      state: `[M, nq + nv]`.
    """
    for i in range(len(addresses)):
        if active[i]:
            begun[i, 0], begun[i, 1] = state[i, 0], state[i, 1]
            model, data = addresses[i]
            for j in range(len(control)):
                control[j] = action[i, j]
            _mj_set_state(model, data, control.ctypes.data, parts[0])
            for _ in range(frame_skip):
                _mj_step(model, data)
            _mj_get_state(model, data, state[i].ctypes.data, parts[1])


class Runner(BatchTask):
    """HalfCheetah and Swimmer: forward speed minus the cost of control, no end.

    Hopper and Walker2d: the same with a reward for being healthy, an end otherwise, and velocities
    observed within +-10.
    """

    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        env = envs[0]
        self._before = np.zeros(len(envs))
        walks = hasattr(env, "_healthy_reward")
        low, high = _healthy_states(env) if walks else (np.zeros(0), np.zeros(0))
        self._constants = (
            env.observation_structure["skipped_qpos"],
            env.model.nq,
            10.0 if walks else math.inf,
            env.dt,
            float(env._forward_reward_weight),
            np.float32(env._ctrl_cost_weight),
            low,
            high,
            float(env._healthy_reward) if walks else 0.0,
            walks and bool(env._terminate_when_unhealthy),
        )

    def gather(self, index: int) -> None:
        super().gather(index)
        self._before[index] = self.state[index, 0]

    def evaluate(self, action: np.ndarray, out: Outcome) -> None:
        _run(self.state, action, self._before, *self._constants, *out)


def _healthy_states(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Open bounds of the states from z on (all of them for Hopper, z and angle for Walker2d)."""
    bounds = np.array([env._healthy_z_range, env._healthy_angle_range], float)
    if not hasattr(env, "_healthy_state_range"):
        return bounds[:, 0].copy(), bounds[:, 1].copy()
    number = env.model.nq + env.model.nv - 1
    states = np.array([env._healthy_state_range] * number, float)
    states[0] = bounds[0]
    states[1] = max(states[1, 0], bounds[1, 0]), min(states[1, 1], bounds[1, 1])
    return states[:, 0].copy(), states[:, 1].copy()


@compiled
def _run(
    state: Any,
    action: Any,
    before: Any,
    skipped: int,
    positions: int,
    speed_limit: float,
    dt: float,
    forward_weight: float,
    cost_weight: Any,
    low: Any,
    high: Any,
    healthy_reward: float,
    ends: bool,
    observation: Any,
    reward: Any,
    terminated: Any,
) -> None:
    """A `Runner`'s observations, rewards and ends from `state` `[M, nq + nv]`, x being first."""
    for i in range(len(state)):
        forward = (state[i, 0] - before[i]) / dt * forward_weight
        before[i] = state[i, 0]
        for j in range(skipped, positions):
            observation[i, j - skipped] = state[i, j]
        for j in range(positions, state.shape[1]):
            observation[i, j - skipped] = min(max(state[i, j], -speed_limit), speed_limit)
        if len(low) > 0:
            healthy = True
            for j in range(len(low)):
                healthy &= low[j] < state[i, j + 1] and state[i, j + 1] < high[j]
            forward += healthy * healthy_reward
            if ends:
                terminated[i] = not healthy
        cost = np.float32(0.0)
        for j in range(action.shape[1]):
            cost += action[i, j] * action[i, j]
        reward[i] = forward - cost_weight * cost


class InvertedPendulum(BatchTask):
    def evaluate(self, action: np.ndarray, out: Outcome) -> None:
        observation, reward, terminated = out
        observation[:] = self.state
        finite = np.logical_and.reduce(np.isfinite(self.state), 1)
        terminated[:] = ~finite | (np.abs(self.state[:, 1]) > 0.2)
        np.logical_not(terminated, out=reward, casting="unsafe")


class InvertedDoublePendulum(BatchTask):
    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        self._tips = [env.data.site_xpos[0] for env in envs]
        self._constraints = [env.data.qfrc_constraint[:1] for env in envs]

    def evaluate(self, action: np.ndarray, out: Outcome) -> None:
        observation, reward, terminated = out
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

    def evaluate(self, action: np.ndarray, out: Outcome) -> None:
        observation, reward, _ = out
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
    hopper_v5.HopperEnv: Runner,
    humanoid_v5.HumanoidEnv: Task,
    humanoidstandup_v5.HumanoidStandupEnv: Task,
    inverted_double_pendulum_v5.InvertedDoublePendulumEnv: InvertedDoublePendulum,
    inverted_pendulum_v5.InvertedPendulumEnv: InvertedPendulum,
    pusher_v5.PusherEnv: Task,
    reacher_v5.ReacherEnv: Reacher,
    swimmer_v5.SwimmerEnv: Runner,
    walker2d_v5.Walker2dEnv: Runner,
}


def make_task(envs: list[Any]) -> Task:
    """The fastest task for environments without wrappers, all made alike."""
    kind = TASKS[type(envs[0])]
    if kind is Runner and envs[0].model.nu > 7:  # a model of the user's
        return Task(envs)  # from eight numbers on numpy's sum is no plain loop
    return kind(envs) if physics_is_linked() else Task(envs)
