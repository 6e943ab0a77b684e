"""Pictures of the robot, the cube and the flag."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

WIDTH, HEIGHT = 640, 480


class Painter:
    """Draws states; the camera follows the robot and looks over it at the flag."""

    def __init__(self, model: Any) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.distance, self._camera.elevation = 4.0, -14.0

    def draw(self, qpos: np.ndarray, flag: np.ndarray) -> np.ndarray:
        """A picture `[HEIGHT, WIDTH, 3]` uint8."""
        data, camera = self._data, self._camera
        data.qpos[:] = qpos
        data.mocap_pos[0, :2] = flag
        mujoco.mj_forward(self._model, data)
        to_flag = flag - qpos[:2]
        # Aside by 15 degrees, where the robot does not hide the flag.
        camera.azimuth = math.degrees(math.atan2(to_flag[1], to_flag[0])) + 15.0
        camera.lookat[:] = [qpos[0], qpos[1], 0.9]
        self._renderer.update_scene(data, camera)
        return self._renderer.render()

    def close(self) -> None:
        self._renderer.close()
