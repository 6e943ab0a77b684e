"""Many HumanoidFlagrunHarder on a CPU: one physics after the other, the rules of all at once."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from sauna.envs.flagrun import task as rules
from sauna.envs.flagrun.physics import after_throw, anatomy, read_robot
from sauna.envs.host.mujoco_tasks import Outcome, Task


class Seen(NamedTuple):
    """What the rules read of one environment's physics, or of many: `[...]` is nothing or M."""

    qpos: np.ndarray  # [..., nq]
    qvel: np.ndarray  # [..., nv]
    xpos: np.ndarray  # [..., bodies, 3] m
    geom_xmat: np.ndarray  # [..., geoms, 9]
    geom_xpos: np.ndarray  # [..., geoms, 3] m


class FlagrunRows(Task):
    """M environments of `sauna/HumanoidFlagrunHarder-v0`; their own `step` gives the same bits.

    Args:
      envs: without wrappers, made alike. They draw what is random, and begin episodes.
    """

    def __init__(self, envs: list[Any]) -> None:
        super().__init__(envs)
        self._anatomy = anatomy(envs[0].model)
        # One model serves all, as in `BatchTask`. A view of an environment's physics stays valid.
        self._model, self._datas = envs[0].model, [env.data for env in envs]
        self._views = [
            Seen(*(getattr(data, name) for name in Seen._fields)) for data in self._datas
        ]
        self._seen = Seen(*map(np.stack, zip(*self._views, strict=True)))
        self._draws = np.zeros((len(envs), rules.STEP_DRAWS))
        first, _ = rules.begin(np, self._robots(self._seen), np.zeros((len(envs), 2)))
        self._tasks = rules.Task(*map(np.array, first))
        self._rows: np.ndarray  # that the last step took, and what it gave each
        self._reward: rules.Reward

    def gather(self, index: int) -> None:
        for mine, its in zip(self._tasks, self.envs[index].task, strict=True):
            mine[index] = its

    def step(self, active: np.ndarray, action: np.ndarray, out: Outcome) -> None:
        rows = np.flatnonzero(active)
        if len(rows) == 0:
            return
        control = action[rows].astype(np.float64)
        for row, its in zip(rows.tolist(), control, strict=True):
            self._simulate(row, its)
        seen = Seen(*(part[rows] for part in self._seen))
        tasks = rules.Task(*(part[rows] for part in self._tasks))
        outcome = rules.advance(np, tasks, self._robots(seen), control, self._draws[rows])
        for mine, new in zip(self._tasks, outcome.task, strict=True):
            mine[rows] = new
        self._throw(rows, outcome.throw)
        out.observation[rows] = outcome.observation.astype(np.float32)
        out.reward[rows] = sum(outcome.reward)
        out.terminated[rows] = outcome.terminated
        self._rows, self._reward = rows, outcome.reward

    def _simulate(self, row: int, control: np.ndarray) -> None:
        """Draws what a step needs, takes it, and notes what is seen then; see the environment."""
        self._draws[row] = self.envs[row].np_random.random(rules.STEP_DRAWS)
        data = self._datas[row]
        data.ctrl[:] = control
        mujoco.mj_step(self._model, data, nstep=rules.SUBSTEPS)
        mujoco.mj_kinematics(self._model, data)
        for all_rows, its in zip(self._seen, self._views[row], strict=True):
            all_rows[row] = its

    def _robots(self, seen: Seen) -> rules.Robot:
        return read_robot(np, self._anatomy, seen.qpos, seen.qvel, seen)

    def _throw(self, rows: np.ndarray, throw: rules.Throw) -> None:
        """Puts the cubes that are thrown where they are thrown from."""
        for k in np.flatnonzero(throw.now):
            thrown, its = rules.Throw(*(part[k] for part in throw)), self._views[rows[k]]
            its.qpos[:], its.qvel[:] = after_throw(np, thrown, its.qpos, its.qvel)

    def info(self, index: int, action: np.ndarray) -> dict[str, Any]:
        row = int(np.searchsorted(self._rows, index))
        return {name: float(term[row]) for name, term in self._reward._asdict().items()}
