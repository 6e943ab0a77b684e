"""HumanoidFlagrunHarder: the task's constants and rules, by hand and against a plain restatement.

`test_flagrun_faces.py` tests the environments that are made of it.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sauna.envs.flagrun import task as rules
from sauna.envs.flagrun.physics import load_model
from sauna.envs.flagrun.task import Robot, Task

GEAR = {
    "abdomen": 100,
    "hip_x": 100,
    "hip_z": 100,
    "hip_y": 300,
    "knee": 200,
    "shoulder": 75,
    "elbow": 75,
}
NO_DRAWS = np.full(rules.STEP_DRAWS, 0.5)
IDLE = np.zeros(17)


def robot(x=0.0, y=0.0, z=1.2, yaw=0.0, velocity=(0.0, 0.0, 0.0), joints=0.0, speeds=0.0) -> Robot:
    quaternion = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    return Robot(
        np.array([x, y, z]),
        quaternion,
        np.array(velocity),
        np.full(17, joints),
        np.full(17, speeds),
        np.zeros(2),
    )


def begun(at: Robot, flag=(5.0, 0.0), **changes: object) -> Task:
    return rules.begin(np, at, np.array(flag))[0]._replace(**changes)


def advance(task: Task, at: Robot, action=IDLE, draws=NO_DRAWS) -> rules.Outcome:
    return rules.advance(np, task, at, action, draws)


def test_many_robots_are_judged_as_each_alone() -> None:
    """To the bit: near the flag, upside down, at a throw, and with a state that is not finite."""
    random, many = np.random.default_rng(0), 60
    quaternion = random.normal(size=(many, 4))
    quaternion[:5] = np.array([1.0, 0.0, 1.0, 0.0])  # pitched by a right angle
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    parts = [random.normal(size=(many, n)) for n in (3, 3, 17, 17)]
    parts[0][:, 2] = random.uniform(0.2, 1.4, many)
    robots = Robot(parts[0], quaternion, parts[1], parts[2], parts[3], np.ones((many, 2)))
    robots.velocity[7] = np.nan
    tasks, seen = rules.begin(np, robots, random.normal(size=(many, 2)))
    frames = np.where(np.arange(many) % 2, 120, 121).astype(np.int32)
    tasks = tasks._replace(frame=frames, flag_age=random.integers(140, 150, many))
    action, draws = random.uniform(-1, 1, (many, 17)), random.random((many, rules.STEP_DRAWS))
    outcome = rules.advance(np, tasks, robots, action, draws)
    alone = lambda whole, k: type(whole)(*(part[k] for part in whole))  # noqa: E731
    for k in range(many):
        one, task = alone(robots, k), alone(tasks, k)
        np.testing.assert_array_equal(rules.begin(np, one, task.flag)[1], seen[k])
        its = rules.advance(np, task, one, action[k], draws[k])
        for single, row in zip(flat(its), flat(outcome), strict=True):
            assert np.asarray(single).tobytes() == np.ascontiguousarray(row[k]).tobytes()
    assert outcome.throw.now.sum() > 5 and outcome.terminated.tolist().index(True) == 7


def flat(outcome: rules.Outcome) -> list[np.ndarray]:
    parts = [part if isinstance(part, tuple) else (part,) for part in outcome]
    return [array for part in parts for array in part]


def test_the_model_has_roboschools_motors_and_cube() -> None:
    model = load_model()
    assert model.nu == rules.JOINTS == 17
    assert rules.SUBSTEPS * model.opt.timestep == pytest.approx(0.0165) == rules.CONTROL_DT
    names = [model.actuator(i).name for i in range(17)]
    legs = [
        f"{side}_{part}"
        for side in ("right", "left")
        for part in ("hip_x", "hip_z", "hip_y", "knee")
    ]
    arms = [
        f"{side}_{part}"
        for side in ("right", "left")
        for part in ("shoulder1", "shoulder2", "elbow")
    ]
    assert names == ["abdomen_z", "abdomen_y", "abdomen_x", *legs, *arms]
    for i, name in enumerate(names):
        strength = next(v for part, v in GEAR.items() if part in name)
        assert model.actuator_gear[i, 0] == pytest.approx(0.41 * strength)
        assert model.joint(model.actuator_trnid[i, 0]).name == name == model.joint(i + 1).name
        assert model.jnt_limited[i + 1]
    cube = model.geom("cube")
    assert model.body("cube").mass[0] == 1.2
    assert cube.size.tolist() == [0.05] * 3  # half of its edges
    assert model.opt.gravity.tolist() == [0, 0, -9.8]


def test_the_flag_touches_nothing_and_is_not_needed() -> None:
    model = load_model()
    flag = model.body("flag")
    geoms = range(flag.geomadr[0], flag.geomadr[0] + flag.geomnum[0])
    assert flag.mocapid[0] == 0
    assert not any(model.geom_contype[g] or model.geom_conaffinity[g] for g in geoms)
    assert load_model(flag=False).nq == model.nq == 31


def test_starts_are_half_standing_and_half_lying() -> None:
    rng = np.random.default_rng(0)
    starts = [rules.start(np, rng.random(rules.RESET_DRAWS)) for _ in range(4000)]
    z = np.array([s.position[2] for s in starts])
    roll, pitch, yaw = np.array([rules.roll_pitch_yaw(np, s.quaternion) for s in starts]).T
    assert np.mean(z == 1.4) == pytest.approx(0.5, abs=0.03)
    assert np.mean(z == 0.45) == pytest.approx(0.25, abs=0.03)
    assert np.mean(z == 0.25) == pytest.approx(0.25, abs=0.03)
    np.testing.assert_allclose(roll, 0, atol=1e-12)
    np.testing.assert_allclose(pitch[z == 1.4], 0, atol=1e-12)
    np.testing.assert_allclose(pitch[z == 0.45], math.pi / 2)
    np.testing.assert_allclose(pitch[z == 0.25], -math.pi / 2)  # 3 pi / 2
    uniform = np.sort(yaw[z == 1.4]) / math.pi
    np.testing.assert_allclose(uniform, np.linspace(-1, 1, len(uniform)), atol=0.06)
    joints = np.array([s.joints for s in starts])
    assert -0.1 <= joints.min() < -0.0999 and 0.0999 < joints.max() < 0.1
    flags = np.array([s.flag for s in starts])
    assert (np.abs(flags) <= [13.125, 6.25]).all() and (np.abs(flags).max(0) > [13.1, 6.2]).all()
    np.testing.assert_allclose(flags.mean(0), 0, atol=0.4)
    assert not any(s.position[:2].any() for s in starts)


def test_angles_are_those_of_another_library() -> None:
    for spin in Rotation.random(200, rng=np.random.default_rng(1)):
        x, y, z, w = spin.as_quat()
        ours = np.array(rules.roll_pitch_yaw(np, np.array([w, x, y, z])))
        np.testing.assert_allclose(ours, spin.as_euler("xyz"), atol=1e-9)


def test_the_observation_by_hand() -> None:
    """Facing +y, the flag 3 m ahead and 3 m to the right; moving 1 m/s ahead, 2 to the left."""
    at = robot(1.0, 2.0, 1.1, yaw=math.pi / 2, velocity=(-2.0, 1.0, 0.5), joints=0.3, speeds=0.2)
    at = at._replace(joints=np.linspace(-1, 1, 17), feet=np.array([1.0, 0.0]))
    seen = rules.observe(np, at, np.array([4.0, 5.0]))
    half = math.sqrt(0.5)
    assert seen.shape == (44,) == (rules.OBSERVATIONS,)
    np.testing.assert_allclose(seen[:8], [0.3, -half, half, 0.3, 0.6, 0.15, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(seen[8:42:2], np.linspace(-1, 1, 17))
    np.testing.assert_array_equal(seen[9:42:2], 0.2)
    np.testing.assert_array_equal(seen[42:], [1.0, 0.0])


def test_observations_are_clipped_at_5() -> None:
    seen = rules.observe(np, robot(velocity=(100.0, -100.0, 0.0), speeds=-9.0), np.ones(2))
    assert seen[3] == 5.0 and seen[4] == -5.0 and seen[9] == -5.0


def test_reward_terms_by_hand() -> None:
    before, after = robot(x=0.0, z=1.2), robot(x=0.1, z=0.9, joints=0.5, speeds=0.4)
    after = after._replace(joints=np.array([1.0, -0.995, 0.99] + [0.0] * 14))
    action = np.array([1.0, -0.5] + [0.0] * 15)
    reward = advance(begun(before), after, action).reward
    assert reward.alive == 2.0
    assert reward.progress == pytest.approx(0.1 / 0.0165)
    assert reward.electricity == pytest.approx(-2 * 4.25 / 4 * 0.4 * 1.5 / 17)
    assert reward.stall_torque == pytest.approx(-0.1 * 4.25 * 1.25 / 17)
    assert reward.joints_at_limit == pytest.approx(-0.2)


@pytest.mark.parametrize("z, bonus", [(-0.1, 1.0), (0.4, 1.5), (0.8, 2.0), (1.3, 2.0)])
def test_the_alive_bonus_grows_up_to_standing(z: float, bonus: float) -> None:
    reward = advance(begun(robot(z=1.2)), robot(z=z)).reward
    assert reward.alive == pytest.approx(bonus)
    assert reward.progress == pytest.approx(100 * (bonus - 2.0))


class PortsPotential:
    """The rule against crawling, restated with None and branches."""

    def __init__(self) -> None:
        self.start: float | None = None
        self.ignored = 0.0

    def __call__(self, x: float, z: float, flag: float) -> float:
        progress = -abs(flag - x) / 0.0165
        if z < 0.8:
            if self.start is None:
                self.start = progress - self.ignored
            self.ignored = progress - self.start
            progress = self.start
        else:
            progress -= self.ignored
            self.start = None
        return progress + 100 * (1 + min(max(z, 0.0), 0.8) / 0.8)


def test_progress_is_the_ports_also_where_the_robot_crawls() -> None:
    rng = np.random.default_rng(2)
    x, z, seen = 0.0, 1.2, []
    task = begun(robot(x, z=z), (13.0, 0.0))
    port = PortsPotential()
    potential = port(x, z, 13.0)
    for _ in range(140):
        x, z = x + rng.uniform(-0.05, 0.1), rng.uniform(0.3, 1.3) if rng.random() < 0.2 else z
        outcome = advance(task, robot(x, z=z))
        task, old = outcome.task, potential
        potential = port(x, z, 13.0)
        assert outcome.reward.progress == pytest.approx(potential - old)
        seen.append(z < 0.8)
    assert 20 < sum(seen) < 120


def test_crawling_pays_nothing_and_walking_does() -> None:
    lying, task = robot(0.0, z=0.4), begun(robot(0.0, z=0.4))
    assert advance(task, robot(1.0, z=0.4)).reward.progress == 0.0
    up = advance(advance(task, robot(1.0, z=0.4)).task, robot(1.0, z=0.8))
    assert up.reward.progress == pytest.approx(50.0)  # for standing up, not for the metre
    assert advance(
        begun(lying._replace(position=np.array([0, 0, 0.8]))), robot(1.0, z=0.8)
    ).reward.progress == pytest.approx(1 / 0.0165)


@pytest.mark.parametrize("z", [1.2, 0.4])
def test_the_flag_moves_when_reached_and_pays_no_jump(z: float) -> None:
    draws = NO_DRAWS.copy()
    draws[:2] = 1.0, 0.25
    outcome = advance(begun(robot(0.0, z=z)), robot(4.01, z=z), draws=draws)
    np.testing.assert_allclose(outcome.task.flag, [13.125, -3.125])
    assert outcome.task.flag_age == 0 and outcome.reward.progress == 0.0
    np.testing.assert_array_equal(
        outcome.observation, rules.observe(np, robot(4.01, z=z), outcome.task.flag)
    )
    stays = advance(begun(robot(0.0, z=z)), robot(3.99, z=z), draws=draws)
    np.testing.assert_array_equal(stays.task.flag, [5.0, 0.0])


def test_the_flag_moves_every_150_steps() -> None:
    task, at, moved = begun(robot()), robot(), []
    rng = np.random.default_rng(3)
    for step in range(1, 460):
        flag = task.flag
        draws = np.append(0.8 + 0.2 * rng.random(2), [0.5] * 5)  # out of reach
        task = advance(task, at, draws=draws).task
        if (task.flag != flag).any():
            moved.append(step)
    assert moved == [150, 300, 450]


def test_cubes_fly_every_30_steps_after_the_100th_while_the_robot_is_up() -> None:
    task = begun(robot())
    thrown = []
    for step in range(300):
        at = robot(z=0.7) if 180 <= step < 190 else robot()
        outcome = advance(task, at)
        thrown += [step] if outcome.throw.now else []
        task = outcome.task
    assert thrown == [120, 150, 180, 210, 240, 270]  # at 180 the robot was up until then
    down = begun(robot(), frame=np.int32(210), ground=np.int32(1))
    assert not advance(down, robot()).throw.now


def test_a_cube_is_aimed_at_where_the_robot_will_be() -> None:
    at, rng = robot(1.0, -2.0, 1.1, velocity=(2.0, 1.0, 0.0)), np.random.default_rng(4)
    task, speeds, angles = begun(at, frame=np.int32(120)), [], []
    for _ in range(500):
        draws = np.append(rng.random(4), [0.5] * 3)  # without noise
        cube = rules.throw(np, task, at, draws[2:])
        speed = np.linalg.norm(cube.velocity)
        target = np.array([1.0, -2.0, 1.1]) + np.array([2.0, 1.0, 0.0]) * 4 / speed
        away = cube.position - target
        assert np.hypot(*away[:2]) == pytest.approx(4.0) and away[2] == pytest.approx(1.0)
        np.testing.assert_allclose(-cube.velocity / speed, away / np.linalg.norm(away))
        speeds.append(speed), angles.append(math.atan2(away[1], away[0]))
        noisy = rules.throw(np, task, at, np.append(draws[2:4], rng.random(3)))
        assert (np.abs(noisy.velocity - cube.velocity) <= 1.0).all()
    assert 20 <= min(speeds) < 20.2 and 29.8 < max(speeds) <= 30
    assert min(angles) < -3.1 and max(angles) > 3.1
    edge = rules.throw(np, task, at, np.array([0.5, 0.5, 1.0, 0.0, 1.0])).velocity
    middle = rules.throw(np, task, at, np.full(5, 0.5)).velocity
    np.testing.assert_allclose(edge - middle, [1.0, -1.0, 1.0])


def test_the_ground_counter() -> None:
    task, counted = begun(robot()), []
    for z in [0.7, 0.79, 0.8, 0.7, 1.2, 1.2, 1.2, 1.2]:
        task = advance(task, robot(z=z)).task
        counted.append(int(task.ground))
    assert counted == [1, 2, 1, 2, 1, 0, 0, 0]


def test_170_steps_on_the_ground_end_the_episode() -> None:
    at = robot(z=0.3)
    task = begun(at)
    for step in range(1, 171):
        outcome = advance(task, at)
        assert outcome.terminated == (step == 170)
        assert outcome.reward.alive == (-1.0 if step == 170 else 1.375)
        task = outcome.task


def test_the_time_limit_truncates_and_a_fall_at_that_step_does_not() -> None:
    for frame, ground, ends in [(998, 0, (0, 0)), (999, 0, (0, 1)), (999, 169, (1, 0))]:
        task = begun(robot(), frame=np.int32(frame), ground=np.int32(ground))
        outcome = advance(task, robot(z=0.5))
        assert (outcome.terminated, outcome.truncated) == ends


def test_a_state_that_is_not_finite_ends_the_episode() -> None:
    outcome = advance(begun(robot()), robot(z=math.nan))
    assert outcome.terminated and outcome.reward.alive == -1.0
    assert np.isfinite(outcome.observation).all() and np.isfinite(sum(outcome.reward))
