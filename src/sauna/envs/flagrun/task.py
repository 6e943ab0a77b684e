"""HumanoidFlagrunHarder but for its physics: what a robot sees, earns, runs to and is hit by.

Every function works on numpy and on jax.numpy arrays alike: it takes the module of its arrays as
`xp` and branches on no value. Whatever is random arrives as numbers in [0, 1) that the caller drew,
so that a host's generator and a device's key serve the same functions. A shape that begins with
`...` is that of one robot, or of many: `[3]` or `[M, 3]`.

The task is Roboschool's (Schulman et al. 2017, section 6.2), read from its first release and from
its port to Bullet; `docs/reference/flagrun.md` lists where this one differs.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

# Time: Roboschool's scene.
SUBSTEPS = 4
CONTROL_DT = 0.0165  # s
TIME_LIMIT = 1000  # control steps

# Observation: Roboschool's walkers.
JOINTS = 17
OBSERVATIONS = 8 + 2 * JOINTS + 2
OBSERVATION_CLIP = 5.0
UPRIGHT_Z = 0.8  # m, of the torso: zero of the observed height, and standing begins here
VELOCITY_SCALE = 0.3
JOINT_SPEED_SCALE = 0.1
GIMBAL_SINE = 0.99999  # Bullet reads roll as 0 beyond this sine of the pitch

# Start.
STANDING_Z = 1.4
STANDING_SHARE = 0.5
LYING = ((math.pi / 2, 0.45), (3 * math.pi / 2, 0.25))  # (pitch, z): face down, on the back
JOINT_START = 0.1  # rad, to either side
CUBE_START = (-1.5, 0.0, 0.05)

# Flag: half of the stadium, whose half lengths are 26.25 and 12.5 m.
FLAG_HALF_LENGTHS = (13.125, 6.25)
FLAG_REACHED = 1.0  # m
FLAG_STEPS = 150  # control steps, 600 substeps

# Cube.
THROW_EVERY = 30  # control steps
THROW_AFTER = 100
THROW_DISTANCE = 4.0  # m, on the ground
THROW_HEIGHT = 1.0  # m, above what it is aimed at
THROW_SPEED = (20.0, 30.0)  # m/s
THROW_NOISE = 1.0  # m/s, on each axis, to either side

# Reward. Roboschool's costs; 4.25 because 4 of 17 joints matter for walking, and electricity is
# divided by 4 in this task (the Bullet port's constructor loses that division).
ALIVE_AT_END = -1.0
POTENTIAL_OF_ALIVE = 100.0
ELECTRICITY = -2.0 * 4.25 / 4
STALL_TORQUE = -0.1 * 4.25
JOINT_AT_LIMIT = -0.1
AT_LIMIT = 0.99  # of a joint's range
GROUND_STEPS = 170  # control steps below UPRIGHT_Z, less those above it: the end

# How many numbers in [0, 1) a reset and a step take.
RESET_DRAWS = 3 + JOINTS + 2
STEP_DRAWS = 2 + 5

Array = Any  # of numpy or of jax.numpy


class Robot(NamedTuple):
    """What the task reads of the physics."""

    position: Array  # [..., 3] mean x and y of the bodies, z of the torso
    quaternion: Array  # [..., 4] of the torso: w, x, y, z
    velocity: Array  # [..., 3] of the torso, in the world
    joints: Array  # [..., 17] positions, -1 to 1 within their ranges
    joint_speeds: Array  # [..., 17] scaled by JOINT_SPEED_SCALE
    feet: Array  # [..., 2] 1 where the foot (right, left) touches the ground, else 0


class Task(NamedTuple):
    """What the task itself remembers of an episode."""

    frame: Array  # [...] int32, control steps taken
    ground: Array  # [...] int32, the on-ground counter
    flag: Array  # [..., 2] x, y
    flag_age: Array  # [...] int32, control steps since it was placed
    potential: Array  # [...] float
    crawling: Array  # [...] bool, whether the torso was below UPRIGHT_Z
    crawl_start: Array  # [...] float, the potential to which a crawling robot is held
    crawl_ignored: Array  # [...] float, progress made by crawling, never paid


class Start(NamedTuple):
    """Where an episode begins."""

    position: Array  # [3] of the torso
    quaternion: Array  # [4]
    joints: Array  # [17] rad
    flag: Array  # [2]


class Reward(NamedTuple):
    """The terms of a step's reward, which is their sum."""

    alive: Array
    progress: Array
    electricity: Array
    stall_torque: Array
    joints_at_limit: Array


class Throw(NamedTuple):
    """The cube, where it is thrown."""

    now: Array  # [...] bool
    position: Array  # [..., 3]
    velocity: Array  # [..., 3]


class Outcome(NamedTuple):
    """What a control step leads to."""

    task: Task
    observation: Array  # [..., 44]
    reward: Reward
    throw: Throw  # to be carried out before the next step
    terminated: Array  # [...] bool
    truncated: Array  # [...] bool, and not terminated


def start(xp: Any, draws: Array) -> Start:
    """Standing or lying, facing anywhere; `draws` `[RESET_DRAWS]`."""
    yaw, lean, side = xp.pi * (2 * draws[0] - 1), draws[1], draws[2]
    (down_pitch, down_z), (back_pitch, back_z) = LYING
    standing, face_down = lean < STANDING_SHARE, side < 0.5
    pitch = xp.where(standing, 0.0, xp.where(face_down, down_pitch, back_pitch))
    z = xp.where(standing, STANDING_Z, xp.where(face_down, down_z, back_z))
    cy, sy, cp, sp = xp.cos(yaw / 2), xp.sin(yaw / 2), xp.cos(pitch / 2), xp.sin(pitch / 2)
    quaternion = xp.stack([cy * cp, -sy * sp, cy * sp, sy * cp])  # yaw after pitch
    joints = JOINT_START * (2 * draws[3 : 3 + JOINTS] - 1)
    position = xp.stack([0.0 * z, 0.0 * z, z])
    return Start(position, quaternion, joints, place_flag(xp, draws[-2:]))


def over_rows(xp: Any, condition: Array, then: Array, otherwise: Array) -> Array:
    """`where` with a condition `[...]` for parts `[...]` or `[..., K]`."""
    whole = xp.ndim(then) == xp.ndim(condition)
    return xp.where(condition if whole else condition[..., None], then, otherwise)


def place_flag(xp: Any, draws: Array) -> Array:
    """A place for the flag `[..., 2]`, uniform in the field; `draws` `[..., 2]`."""
    return xp.asarray(FLAG_HALF_LENGTHS, dtype=draws.dtype) * (2 * draws - 1)


def components(vectors: Array) -> tuple[Array, ...]:
    """The numbers of vectors `[..., K]`, each `[...]`."""
    return tuple(vectors[..., k] for k in range(vectors.shape[-1]))


def roll_pitch_yaw(xp: Any, quaternion: Array) -> tuple[Array, Array, Array]:
    """Angles about x, y and z, applied in that order, as Bullet reads them."""
    w, x, y, z = components(quaternion)
    sine = 2 * (w * y - z * x)
    gimbal = xp.abs(sine) >= GIMBAL_SINE
    sign = xp.where(sine < 0, -1.0, 1.0)
    pitch = xp.where(gimbal, sign * (xp.pi / 2), xp.arcsin(xp.clip(sine, -1.0, 1.0)))
    roll = xp.where(gimbal, 0.0, xp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    free = xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    yaw = xp.where(gimbal, 2 * xp.arctan2(-sign * x, sign * y), free)
    return roll, pitch, yaw


def observe(xp: Any, robot: Robot, flag: Array) -> Array:
    """The observation `[..., 44]`."""
    roll, pitch, yaw = roll_pitch_yaw(xp, robot.quaternion)
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    to_flag = flag - robot.position[..., :2]
    angle = xp.arctan2(to_flag[..., 1], to_flag[..., 0]) - yaw
    vx, vy, vz = components(robot.velocity)
    body = [
        robot.position[..., 2] - UPRIGHT_Z,
        xp.sin(angle),
        xp.cos(angle),
        VELOCITY_SCALE * (cos * vx + sin * vy),
        VELOCITY_SCALE * (cos * vy - sin * vx),
        VELOCITY_SCALE * vz,
        roll,
        pitch,
    ]
    joints = xp.stack([robot.joints, robot.joint_speeds], axis=-1)
    joints = joints.reshape(*robot.joints.shape[:-1], 2 * JOINTS)
    observation = xp.concatenate([xp.stack(body, axis=-1), joints, robot.feet], axis=-1)
    return xp.clip(observation, -OBSERVATION_CLIP, OBSERVATION_CLIP)


def flag_distance(xp: Any, robot: Robot, flag: Array) -> Array:
    dx, dy = components(flag - robot.position[..., :2])
    return xp.sqrt(dx**2 + dy**2)


def alive_bonus(xp: Any, z: Array) -> Array:
    """1 on the ground to 2 standing."""
    return 1 + xp.clip(z, 0.0, UPRIGHT_Z) / UPRIGHT_Z


def with_potential(xp: Any, task: Task, robot: Robot) -> Task:
    """The task with its potential here: nearness to the flag, and 100 times the alive bonus.

    While the robot is down its progress is not paid: the potential stays where the crawling began,
    and what was crawled is subtracted for the rest of the episode.
    """
    progress = -flag_distance(xp, robot, task.flag) / CONTROL_DT
    z = robot.position[..., 2]
    down = z < UPRIGHT_Z
    begins = xp.logical_and(down, xp.logical_not(task.crawling))
    crawl_start = xp.where(begins, progress - task.crawl_ignored, task.crawl_start)
    ignored = xp.where(down, progress - crawl_start, task.crawl_ignored)
    paid = progress - ignored
    potential = paid + POTENTIAL_OF_ALIVE * alive_bonus(xp, z)
    return task._replace(
        potential=potential, crawling=down, crawl_start=crawl_start, crawl_ignored=ignored
    )


def begin(xp: Any, robot: Robot, flag: Array) -> tuple[Task, Array]:
    """The task at an episode's first state, and the first observation."""
    zero = 0.0 * robot.position[..., 2]
    none, standing = xp.zeros_like(zero, dtype=xp.int32), xp.zeros_like(zero, dtype=bool)
    task = Task(none, none, flag, none, zero, standing, zero, zero)
    return with_potential(xp, task, robot), observe(xp, robot, flag)


def moved_flag(xp: Any, task: Task, robot: Robot, draws: Array) -> Task:
    """The flag somewhere else where it was reached or missed for too long; `draws` `[..., 2]`.

    The potential is taken anew there, so that a step that moves the flag pays no progress.
    """
    reached = flag_distance(xp, robot, task.flag) < FLAG_REACHED
    moves = xp.logical_or(reached, task.flag_age >= FLAG_STEPS)
    age = xp.where(moves, xp.zeros_like(task.flag_age), task.flag_age)
    flag = over_rows(xp, moves, place_flag(xp, draws), task.flag)
    moved = task._replace(flag=flag, flag_age=age)
    fresh = with_potential(xp, moved, robot)
    return Task(*(over_rows(xp, moves, *parts) for parts in zip(fresh, moved, strict=True)))


def throw(xp: Any, task: Task, robot: Robot, draws: Array) -> Throw:
    """The cube, aimed at where the robot will be when it arrives; `draws` `[..., 5]`."""
    due = xp.logical_and(task.frame % THROW_EVERY == 0, task.frame > THROW_AFTER)
    now = xp.logical_and(due, task.ground == 0)
    angle = xp.pi * (2 * draws[..., 0] - 1)
    speed = THROW_SPEED[0] + (THROW_SPEED[1] - THROW_SPEED[0]) * draws[..., 1:2]
    target = robot.position + robot.velocity * (THROW_DISTANCE / speed)
    height = xp.full_like(angle, THROW_HEIGHT)
    around = [THROW_DISTANCE * xp.cos(angle), THROW_DISTANCE * xp.sin(angle)]
    away = xp.stack([*around, height], axis=-1)
    straight = -away * (speed / math.hypot(THROW_DISTANCE, THROW_HEIGHT))
    return Throw(now, target + away, straight + THROW_NOISE * (2 * draws[..., 2:5] - 1))


def count_ground(xp: Any, ground: Array, z: Array) -> Array:
    """The on-ground counter after a step that ends with the torso at height `z`."""
    return xp.where(z < UPRIGHT_Z, ground + 1, xp.maximum(ground - 1, 0))


def costs(xp: Any, robot: Robot, action: Array) -> tuple[Array, Array, Array]:
    """Electricity, stall torque and joints at their limits; `action` `[..., 17]`, clipped."""
    electricity = ELECTRICITY * xp.mean(xp.abs(action * robot.joint_speeds), axis=-1)
    stall_torque = STALL_TORQUE * xp.mean(action * action, axis=-1)
    at_limit = JOINT_AT_LIMIT * xp.sum(xp.abs(robot.joints) > AT_LIMIT, axis=-1)
    return electricity, stall_torque, at_limit


def advance(xp: Any, task: Task, robot: Robot, action: Array, draws: Array) -> Outcome:
    """What the physics' control step with `action` led to; `draws` `[..., STEP_DRAWS]`.

    A state that is not finite ends the episode, as in both ports, and is shown as zeros.
    """
    finite = xp.isfinite(sum(xp.sum(part, axis=-1) for part in robot))
    robot = Robot(*(over_rows(xp, finite, part, xp.zeros_like(part)) for part in robot))
    z = robot.position[..., 2]
    aged = task._replace(flag_age=task.flag_age + 1)
    before = moved_flag(xp, aged, robot, draws[..., :2])
    thrown = throw(xp, before, robot, draws[..., 2:])
    after = with_potential(xp, before, robot)
    ground = count_ground(xp, task.ground, z)
    terminated = xp.logical_or(ground >= GROUND_STEPS, xp.logical_not(finite))
    frame = task.frame + 1
    alive = xp.where(terminated, ALIVE_AT_END, alive_bonus(xp, z))
    reward = Reward(alive, after.potential - before.potential, *costs(xp, robot, action))
    return Outcome(
        after._replace(frame=frame, ground=ground),
        observe(xp, robot, after.flag),
        reward,
        thrown,
        terminated,
        xp.logical_and(frame >= TIME_LIMIT, xp.logical_not(terminated)),
    )
