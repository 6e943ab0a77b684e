"""The model, and what the task reads of its state; serves MuJoCo's arrays and MJX's alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from sauna.envs.flagrun.task import (
    CUBE_START,
    JOINT_SPEED_SCALE,
    JOINTS,
    OBSERVATION_CLIP,
    OBSERVATIONS,
    Array,
    Robot,
    Start,
    Throw,
    components,
)

MODEL = Path(__file__).parent / "humanoid.xml"
FEET = ("right_foot", "left_foot")

# Where the parts are in `qpos` and `qvel`: the torso's free joint, the motors', the cube's.
POSITION, QUATERNION, JOINT = slice(0, 3), slice(3, 7), slice(7, 7 + JOINTS)
CUBE_POSITION, CUBE_QUATERNION = slice(24, 27), slice(27, 31)
VELOCITY, JOINT_VELOCITY = slice(0, 3), slice(6, 6 + JOINTS)
CUBE_VELOCITY, CUBE_SPIN = slice(23, 26), slice(26, 29)


class Anatomy(NamedTuple):
    """Constants of the model that observations are made of."""

    bodies: slice  # the robot's, of all bodies
    low: np.ndarray  # [17] rad, the joints' ranges
    high: np.ndarray  # [17]
    feet: np.ndarray  # [2] geoms, capsules
    foot_radius: np.ndarray  # [2] m
    foot_half_length: np.ndarray  # [2] m


def load_model(flag: bool = True) -> Any:
    """The model; without the flag, which physics does not feel, MJX compiles it sooner."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    if not flag:
        spec.delete(spec.body("flag"))
    return spec.compile()


def anatomy(model: Any) -> Anatomy:
    feet = np.array([model.geom(name).id for name in FEET])
    joints = model.jnt_range[1 : 1 + JOINTS]
    bodies = slice(model.body("torso").id, model.body("cube").id)
    sizes = model.geom_size[feet]
    return Anatomy(bodies, joints[:, 0], joints[:, 1], feet, sizes[:, 0], sizes[:, 1])


def read_robot(xp: Any, body: Anatomy, qpos: Array, qvel: Array, data: Any) -> Robot:
    """The robot, or many; `data` holds the places of bodies and geoms that belong to `qpos`.

    A foot touches the ground where its lowest point is below it.
    """
    x, y = components(xp.mean(data.xpos[..., body.bodies, :2], axis=-2))
    position = xp.stack([x, y, qpos[..., 2]], axis=-1)
    joints = 2 * (qpos[..., JOINT] - body.low) / (body.high - body.low) - 1
    turned = data.geom_xmat.reshape(*qpos.shape[:-1], -1, 9)
    steepness = turned[..., body.feet, 8]  # of a capsule's axis
    reach = body.foot_radius + body.foot_half_length * xp.abs(steepness)
    touches = data.geom_xpos[..., body.feet, 2] < reach
    return Robot(
        position,
        qpos[..., QUATERNION],
        qvel[..., VELOCITY],
        joints,
        JOINT_SPEED_SCALE * qvel[..., JOINT_VELOCITY],
        xp.where(touches, xp.ones_like(reach), xp.zeros_like(reach)),
    )


def first_qpos(xp: Any, start: Start) -> Array:
    """`qpos` at the start of an episode."""
    cube = xp.asarray([*CUBE_START, 1.0, 0.0, 0.0, 0.0], dtype=start.position.dtype)
    return xp.concatenate([start.position, start.quaternion, start.joints, cube])


def after_throw(xp: Any, thrown: Throw, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """`qpos` and `qvel` with the cube where it is thrown from, if it is."""
    still = xp.zeros_like(thrown.velocity)
    placed = xp.concatenate([qpos[: CUBE_POSITION.start], thrown.position, qpos[CUBE_QUATERNION]])
    sent = xp.concatenate([qvel[: CUBE_VELOCITY.start], thrown.velocity, still])
    return xp.where(thrown.now, placed, qpos), xp.where(thrown.now, sent, qvel)


def spaces() -> tuple[Any, Any]:
    """The observation and the action space, of both forms."""
    from gymnasium.spaces import Box

    observation = Box(-OBSERVATION_CLIP, OBSERVATION_CLIP, (OBSERVATIONS,), np.float32)
    return observation, Box(-1.0, 1.0, (JOINTS,), np.float32)
