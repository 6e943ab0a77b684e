"""The Gymnasium environment `sauna/HumanoidFlagrunHarder-v0`."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np

from sauna.envs.flagrun import task as rules
from sauna.envs.flagrun.physics import (
    after_throw,
    anatomy,
    first_qpos,
    load_model,
    read_robot,
    spaces,
)
from sauna.envs.flagrun.picture import Painter


class HumanoidFlagrunHarder(gymnasium.Env):
    """The task on MuJoCo, in double precision; observations are rounded to single.

    An episode follows from the seed of its reset and its actions. `info` holds the reward's terms.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / rules.CONTROL_DT),
    }

    frame_skip = rules.SUBSTEPS

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space, self.action_space = spaces()
        self.model = load_model()
        self.data = mujoco.MjData(self.model)
        self._anatomy = anatomy(self.model)
        self._painter: Painter | None = None
        self.task: rules.Task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        start = rules.start(np, self.np_random.random(rules.RESET_DRAWS))
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = first_qpos(np, start)
        self.task, observation = rules.begin(np, self._robot(), start.flag)
        return observation.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        draws = self.np_random.random(rules.STEP_DRAWS)
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=rules.SUBSTEPS)
        outcome = rules.advance(np, self.task, self._robot(), action, draws)
        self.task = outcome.task
        if outcome.throw.now:
            qpos, qvel = after_throw(np, outcome.throw, self.data.qpos, self.data.qvel)
            self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        terms = {name: float(value) for name, value in outcome.reward._asdict().items()}
        ends = bool(outcome.terminated), bool(outcome.truncated)
        observation = outcome.observation.astype(np.float32)
        return observation, sum(terms.values()), *ends, terms

    def _robot(self) -> rules.Robot:
        # `mj_step` leaves bodies where they were before its last substep.
        mujoco.mj_kinematics(self.model, self.data)
        return read_robot(np, self._anatomy, self.data.qpos, self.data.qvel, self.data)

    def render(self) -> np.ndarray | None:
        if self.render_mode is None:
            return None
        if self._painter is None:
            self._painter = Painter(self.model)
        return self._painter.draw(self.data.qpos, self.task.flag)

    def close(self) -> None:
        if self._painter is not None:
            self._painter.close()
            self._painter = None
