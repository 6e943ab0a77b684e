"""HumanoidFlagrunHarder in Gymnasium and in MJX: one model, one task, two interfaces."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sauna.envs.device.contract import JaxEnv
from sauna.envs.flagrun import ID
from sauna.envs.flagrun import task as rules
from sauna.envs.flagrun.host import HumanoidFlagrunHarder
from sauna.envs.flagrun.physics import anatomy, first_qpos, load_model, read_robot
from sauna.envs.host.mujoco_envs import MujocoEnvs
from sauna.envs.make import env_maker, in_process_envs
from sauna.envs.probe import probe
from sauna.system.errors import BadInput

HOME = np.concatenate([[0, 0, 1.29, 1, 0, 0, 0], np.zeros(17)])  # upright, soles in the ground


def play(env: Any, seed: int, steps: int) -> list[tuple]:
    rng = np.random.default_rng(seed)
    seen: list[tuple] = [(env.reset(seed=seed)[0].tobytes(),)]
    for _ in range(steps):
        observation, *rest, _ = env.step(rng.uniform(-1, 1, 17))
        seen.append((observation.tobytes(), *rest))
        if rest[1] or rest[2]:
            break
    return seen


def seed_of(z: float) -> int:
    """A seed whose episode begins at this height."""
    env = HumanoidFlagrunHarder()
    return next(s for s in range(50) if abs(env.reset(seed=s)[0][0] + 0.8 - z) < 1e-6)


def test_gymnasium_accepts_the_environment() -> None:
    env = gymnasium.make(f"sauna.envs.flagrun:{ID}")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == (44,) and env.action_space.shape == (17,)
    assert env.metadata["render_fps"] == 61
    env.close()


def test_both_faces_have_the_same_spaces() -> None:
    ours, theirs = HumanoidFlagrunHarder(), device_env()
    assert str(ours.observation_space) == str(theirs.observation_space)
    assert str(ours.action_space) == str(theirs.action_space)
    assert ours.reset(seed=0)[0].dtype == ours.observation_space.dtype


def test_a_name_that_is_close_is_named() -> None:
    with pytest.raises(BadInput, match=r"did you mean 'sauna/HumanoidFlagrunHarder-v0'"):
        env_maker("sauna/HumanoidFlagrun-v0", {})


def test_an_episode_follows_from_its_seed_and_actions() -> None:
    """Long enough for flags that move and cubes that are thrown; one env has played before."""
    first, second = HumanoidFlagrunHarder(), HumanoidFlagrunHarder()
    play(first, 5, 60)
    seed = seed_of(1.4)
    assert play(first, seed, 400) == play(second, seed, 400)
    assert play(first, seed + 1, 3) != play(second, seed, 3)
    assert probe(ID, {}).differs is None


def test_a_restored_environment_goes_on_bit_for_bit() -> None:
    envs, again = (in_process_envs(ID, {}, [(3, 0)], "auto") for _ in range(2))
    assert type(envs) is MujocoEnvs
    rng, active = np.random.default_rng(8), np.ones(1, bool)
    actions = rng.normal(0, 0.7, (260, 1, 17)).astype(np.float32)
    envs.reset(), again.reset()
    for action in actions[:230]:  # into the second episode
        step = envs.step(action, active)
    np.testing.assert_array_equal(again.restore(0, envs.snapshot(0)), step.observation[0])
    for action in actions[230:]:
        one, two = envs.step(action, active), again.step(action, active)
        for a, b in zip(one[:4], two[:4], strict=True):
            assert a.tobytes() == b.tobytes()
    assert envs.snapshot(0)["episode"] == 1


def test_actions_are_clipped_to_1() -> None:
    env = HumanoidFlagrunHarder()
    results = []
    for size in (1.0, 7.0, 0.9):
        env.reset(seed=1)
        results.append(env.step(np.full(17, size))[:2])
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert results[0][1] == results[1][1] != results[2][1]


def test_a_fallen_robot_ends_after_170_steps() -> None:
    for z in (0.45, 0.25):
        env = HumanoidFlagrunHarder()
        env.reset(seed=seed_of(z))
        steps = [env.step(np.zeros(17)) for _ in range(170)]
        assert [s[2] for s in steps] == [False] * 169 + [True]
        assert not any(s[3] for s in steps)
        assert steps[-1][4]["alive"] == -1.0
        assert steps[-1][1] == pytest.approx(sum(steps[-1][4].values()))


def test_1000_steps_truncate(monkeypatch) -> None:
    monkeypatch.setattr(rules, "GROUND_STEPS", 10_000)
    env = HumanoidFlagrunHarder()
    env.reset(seed=0)
    ends = [env.step(np.zeros(17))[2:4] for _ in range(1000)]
    assert ends == [(False, False)] * 999 + [(False, True)]


def hardest_hit(env: HumanoidFlagrunHarder, seed: int, ground: int) -> float:
    """The cube's largest force on a robot held upright, over the flight after step 120."""
    model, data = env.model, env.data
    cube, floor, force, largest = model.geom("cube").id, model.geom("floor").id, np.zeros(6), 0.0
    env.reset(seed=seed)
    data.qpos[:24], data.qvel[:] = HOME, 0
    env.task = env.task._replace(frame=np.int32(120), ground=np.int32(ground))
    env.step(np.zeros(17))
    for _ in range(80):
        data.qpos[:24], data.qvel[:23] = HOME, 0
        mujoco.mj_step(model, data)
        for i in range(data.ncon):
            pair = data.contact[i].geom
            if cube in pair and floor not in pair:
                mujoco.mj_contactForce(model, data, i, force)
                largest = max(largest, force[0])
    return largest


def test_a_thrown_cube_hits_a_standing_robot() -> None:
    """1.2 kg at 20 m/s that are stopped within a control step are more than 1000 N."""
    env = HumanoidFlagrunHarder()
    forces = [hardest_hit(env, seed, ground=0) for seed in range(10)]
    assert np.mean(np.array(forces) > 1000) >= 0.7
    assert hardest_hit(env, 0, ground=40) == 0.0  # none is thrown at a robot that is down


def test_a_cube_in_flight_has_the_speed_it_was_thrown_with() -> None:
    env = HumanoidFlagrunHarder()
    env.reset(seed=seed_of(1.4))
    env.task = env.task._replace(frame=np.int32(120))
    assert np.linalg.norm(env.data.qvel[23:26]) == 0.0
    env.step(np.zeros(17))
    assert 18 < np.linalg.norm(env.data.qvel[23:26]) < 32
    assert np.hypot(*(env.data.qpos[24:26] - env.data.qpos[:2])) == pytest.approx(4, abs=0.3)


def test_feet_touch_the_ground_that_they_stand_on() -> None:
    env = HumanoidFlagrunHarder()
    assert env.reset(seed=seed_of(1.4))[0][42:].tolist() == [0.0, 0.0]  # 8 cm above it
    env.data.qpos[:24], env.data.qvel[:] = HOME, 0
    assert env.step(np.zeros(17))[0][42:].tolist() == [1.0, 1.0]
    env.data.qpos[10] = -0.5  # the right hip aside
    assert env.step(np.zeros(17))[0][42:].tolist() == [0.0, 1.0]


PICTURE = f"""
from sauna.experiments.evaluate.video import choose_renderer
choose_renderer()
from sauna.envs.make import make_env
env = make_env({ID!r}, {{}}, render_mode="rgb_array")
env.reset(seed=0)
picture = env.render()
assert picture.shape == (480, 640, 3) and picture.dtype == "uint8"
red, green, blue = picture.reshape(-1, 3).astype(int).T
print(((red > 100) & (green < 60) & (blue < 60)).sum())
print(((red > 170) & (abs(red - blue) < 20) & (abs(red - green) < 20)).sum())
env.close()
"""


def test_pictures_show_the_flag_and_the_cube() -> None:
    done = subprocess.run([sys.executable, "-c", PICTURE], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"cannot render here: {done.stderr[-200:]}")
    flag, cube = map(int, done.stdout.split())
    assert flag > 20 and cube > 20


def test_the_host_face_needs_no_jax() -> None:
    made = f"import sys; from sauna.envs.make import make_env; make_env({ID!r}, {{}})"
    code = made + "; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def states(steps: int) -> list[tuple]:
    """States along an episode, and what follows on the host: `(task, robot, action, draws)`."""
    env = HumanoidFlagrunHarder()
    env.reset(seed=seed_of(1.4))
    rng, found = np.random.default_rng(6), []
    for _ in range(steps):
        task, action = env.task, rng.uniform(-1, 1, 17)
        env.step(action)
        robot = read_robot(np, anatomy(env.model), env.data.qpos, env.data.qvel, env.data)
        found.append((task, robot, action, rng.random(rules.STEP_DRAWS)))
    return found


def test_both_kinds_of_arrays_agree_on_the_task() -> None:
    """Float32 against float64: observations to 1e-4, progress to what 800 in float32 can hold."""
    on_device = jax.jit(lambda *given: rules.advance(jnp, *given))
    for given in states(190):
        host = rules.advance(np, *given)
        device = on_device(*jax.tree.map(jnp.asarray, given))
        np.testing.assert_allclose(device.observation, host.observation, atol=1e-4)
        np.testing.assert_allclose(device.reward, host.reward, atol=5e-3)
        for one, two in zip(device.task, host.task, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(device.throw.velocity, host.throw.velocity, atol=1e-3)
        assert device.throw.now == host.throw.now and device.terminated == host.terminated
    assert on_device._cache_size() == 1


@cache
def device_env() -> JaxEnv:
    from sauna.envs.flagrun.device import flagrun_mjx

    return flagrun_mjx()


def host_at(state: Any) -> HumanoidFlagrunHarder:
    """The host's environment in a state of the device's."""
    env = HumanoidFlagrunHarder()
    env.reset(seed=0)
    env.data.qpos[:], env.data.qvel[:] = state.qpos, state.qvel
    env.data.qacc_warmstart[:] = state.warmstart
    env.task = rules.Task(*map(np.asarray, state.task))
    return env


@pytest.mark.slow
def test_a_reset_on_the_device_is_the_hosts() -> None:
    env = device_env()
    key = jax.random.key(3)
    state, observation = jax.jit(env.reset)(key)
    draws = np.asarray(jax.random.uniform(jax.random.split(key)[1], (rules.RESET_DRAWS,)))
    start = rules.start(np, draws.astype(np.float64))
    model = load_model()
    data = mujoco.MjData(model)
    data.qpos[:] = first_qpos(np, start)
    mujoco.mj_kinematics(model, data)
    robot = read_robot(np, anatomy(model), data.qpos, data.qvel, data)
    task, expected = rules.begin(np, robot, start.flag)
    np.testing.assert_allclose(observation, expected, atol=1e-4)
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-6)
    for one, two in zip(state.task, task, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-3)
    assert observation.dtype == env.observation_space.dtype == np.float32
    assert env.frames_per_second == pytest.approx(60.6, abs=0.01)


@pytest.mark.slow
def test_a_step_on_the_device_is_the_hosts() -> None:
    """From states along eight episodes, one control step each: MuJoCo against MJX.

    Contacts make a step sensitive to float32: nine steps of ten must agree closely, not all.
    """
    env = device_env()
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    state, _ = reset(jax.random.split(jax.random.key(0), 8))
    soon = jnp.full(8, 115, jnp.int32)  # the next cube flies before the robots fall
    state = state._replace(task=state.task._replace(frame=soon))
    rng, apart, rewards, thrown = np.random.default_rng(7), [], [], 0
    for _ in range(180):
        action = rng.uniform(-1, 1, (8, 17)).astype(np.float32)
        after = step(state, jnp.asarray(action))
        for i in range(8):
            before = jax.tree.map(lambda x, i=i: x[i], state._replace(key=None))
            host = host_at(before)
            observation, reward, *_ = host.step(action[i])
            moved = (host.task.flag != np.asarray(after.state.task.flag[i])).any()
            thrown += bool(after.state.qvel[i, 23:26].max() > 10)
            if not moved:  # the two draw different places for a flag that moves
                apart.append(np.abs(observation - after.observation[i]).max())
                rewards.append(abs(reward - float(after.reward[i])))
        state = after.state
    assert len(apart) > 1000 and thrown
    print(
        f"observations apart: {np.quantile(apart, [0.5, 0.9, 0.99, 1.0])}, "
        f"rewards: {np.quantile(rewards, [0.5, 0.9, 0.99, 1.0])}"
    )
    assert np.quantile(apart, 0.5) < 1e-4 and np.quantile(apart, 0.9) < 3e-2
    assert np.quantile(rewards, 0.5) < 5e-3 and np.quantile(rewards, 0.9) < 5e-2
    shapes = jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), state, after.state)
    assert all(jax.tree.leaves(shapes)) and step._cache_size() == 1
