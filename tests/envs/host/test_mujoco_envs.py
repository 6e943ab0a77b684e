"""The MuJoCo fast path against Gymnasium's own environments, bit for bit."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from sauna.envs.flagrun import host
from sauna.envs.flagrun import task as rules
from sauna.envs.flagrun.physics import after_throw
from sauna.envs.host import flagrun_rows
from sauna.envs.host.contract import episode_seed
from sauna.envs.host.gymnasium_envs import EnvironmentFailure, GymnasiumEnvs
from sauna.envs.host.mujoco_envs import MujocoEnvs
from sauna.envs.host.mujoco_tasks import TASKS, Runner, Task, make_task
from sauna.envs.make import in_process_envs

FLAGRUN = "sauna/HumanoidFlagrunHarder-v0"
SEEDS = [(3, 0), (3, 1), (7, 0)]
NAMES = sorted(
    name
    for name, spec in gymnasium.registry.items()
    if str(spec.entry_point).startswith("gymnasium.envs.mujoco") and name.endswith("-v5")
)
KWARGS = [
    ("Hopper-v5", {"terminate_when_unhealthy": False, "forward_reward_weight": 2.5}),
    ("Walker2d-v5", {"exclude_current_positions_from_observation": False, "frame_skip": 3}),
    ("HalfCheetah-v5", {"ctrl_cost_weight": 0.7, "reset_noise_scale": 0.5}),
    ("Hopper-v5", {"healthy_state_range": [-1.0, 1.0], "healthy_angle_range": [-2.0, 2.0]}),
    ("Hopper-v5", {"healthy_state_range": [-100, 100]}),  # the default, in whole numbers
    ("Reacher-v5", {"reward_dist_weight": 3}),
]


def wide_actions(env: MujocoEnvs | GymnasiumEnvs, steps: int, seed: int) -> np.ndarray:
    """Actions of which many lie outside the bounds."""
    width = env.spaces.action_width
    shape = (steps, len(SEEDS), width)
    return np.random.default_rng(seed).normal(0, 0.7, shape).astype(np.float32)


def test_these_are_the_eleven_tasks() -> None:
    assert len(NAMES) == len(TASKS) == 11


def assert_equals_gymnasium(name: str, kwargs: dict, steps: int) -> int:
    """Plays both, with rows that stand still for a while; returns how many episodes ended."""
    fast = in_process_envs(name, kwargs, SEEDS, "auto")
    plain = in_process_envs(name, kwargs, SEEDS, "gymnasium")
    assert type(fast) is MujocoEnvs and type(plain) is GymnasiumEnvs
    np.testing.assert_array_equal(fast.reset(), plain.reset())
    ends = 0
    for t, action in enumerate(wide_actions(fast, steps, seed=1)):
        active = np.array([True, t % 50 != 7, not 100 < t < 105])
        one, two = fast.step(action, active), plain.step(action, active)
        ended = active & (two.terminated | two.truncated)
        assert one.ended == two.ended == ended.any()
        for a, b in zip(one[:4], two[:4], strict=True):
            assert a[active].tobytes() == b[active].tobytes(), f"step {t}"
        assert one.info == two.info and set(one.info) == set(np.flatnonzero(ended)), f"step {t}"
        np.testing.assert_array_equal(one.final_observation[ended], two.final_observation[ended])
        ends += ended.sum()
    fast.close(), plain.close()
    return ends


@pytest.mark.parametrize(
    "name, kwargs",
    [
        pytest.param(name, {}, marks=[pytest.mark.slow] * name.startswith("Humanoid"))
        for name in NAMES
    ]
    + KWARGS,
)
def test_equals_gymnasium(name: str, kwargs: dict) -> None:
    """Every task through falls, or to a time limit that comes twice."""
    limit = {"max_episode_steps": 90}
    assert assert_equals_gymnasium(name, {**limit, **kwargs}, steps=190) >= 3


def test_the_flag_run_equals_its_own_environment(monkeypatch) -> None:
    """Through falls and time limits; flags move and cubes fly sooner than they do."""
    sooner = {"TIME_LIMIT": 60, "GROUND_STEPS": 40, "FLAG_STEPS": 7}
    for name, value in {**sooner, "THROW_EVERY": 3, "THROW_AFTER": 0}.items():
        monkeypatch.setattr(rules, name, value)
    thrown = []
    throw = lambda *arguments: thrown.append(1) or after_throw(*arguments)  # noqa: E731
    for module in (host, flagrun_rows):
        monkeypatch.setattr(module, "after_throw", throw)
    assert assert_equals_gymnasium(FLAGRUN, {}, steps=190) >= 9
    assert len(thrown) > 20 and len(thrown) % 2 == 0  # as often here as there


@pytest.mark.slow
@pytest.mark.parametrize("name, kwargs", [(name, {}) for name in (*NAMES, FLAGRUN)] + KWARGS)
def test_equals_gymnasium_over_full_episodes(name: str, kwargs: dict) -> None:
    """Every task to its own time limit, or through tens of falls."""
    ends = assert_equals_gymnasium(name, kwargs, steps=1030)
    assert ends >= 3 if kwargs == {} else ends >= 1


@pytest.mark.parametrize("name", [*NAMES, FLAGRUN])
def test_a_restored_environment_goes_on_bit_for_bit(name: str) -> None:
    envs, again = (in_process_envs(name, {}, SEEDS, "auto") for _ in range(2))
    actions = wide_actions(envs, 60, seed=2)
    every = np.ones(len(SEEDS), bool)
    envs.reset(), again.reset()
    for action in actions[:41]:
        step = envs.step(action, every)
    for i in range(len(SEEDS)):
        seen = again.restore(i, {k: v.copy() for k, v in envs.snapshot(i).items()})
        np.testing.assert_array_equal(seen, step.observation[i])
    for action in actions[41:]:
        one, two = envs.step(action, every), again.step(action, every)
        for a, b in zip(one[:4], two[:4], strict=True):
            assert a.tobytes() == b.tobytes()
    envs.close(), again.close()


def test_what_the_fast_path_does_not_know_is_left_to_gymnasium() -> None:
    """A wrapper, a subclass or an older version may do something in `step` that would be lost."""
    for name, kwargs in [("Hopper-v4", {}), ("CartPole-v1", {}), ("small_envs:Scripted", {})]:
        if name in gymnasium.registry or ":" in name:
            envs = in_process_envs(name, kwargs, SEEDS, "auto")
            assert type(envs) is GymnasiumEnvs
            envs.close()
    gymnasium.register(
        "WrappedHopper-v0",
        "gymnasium.envs.mujoco.hopper_v5:HopperEnv",
        max_episode_steps=1000,
        additional_wrappers=(gymnasium.wrappers.ClipReward.wrapper_spec(min_reward=-1),),
    )
    try:
        assert type(in_process_envs("WrappedHopper-v0", {}, SEEDS, "auto")) is GymnasiumEnvs
    finally:
        del gymnasium.registry["WrappedHopper-v0"]


def test_a_model_of_many_motors_is_stepped_by_its_own_method(monkeypatch) -> None:
    """numpy adds eight numbers and more pairwise, so the compiled loop would round differently."""
    env = SimpleNamespace(model=SimpleNamespace(nu=8))
    monkeypatch.setitem(TASKS, SimpleNamespace, Runner)
    assert type(make_task([env])) is Task


def test_non_finite_states_are_named(monkeypatch) -> None:
    """MuJoCo resets a state that explodes by itself; here it is kept from doing so."""
    envs = in_process_envs("HalfCheetah-v5", {}, SEEDS, "auto")
    envs.reset()

    def explode(*arguments: object) -> None:
        envs._task.qvel[1, 4] = np.nan

    monkeypatch.setattr("sauna.envs.host.mujoco_tasks._advance", explode)
    with pytest.raises(
        EnvironmentFailure, match=r"1 of seed 3, episode 0, step 1: observation.12. is"
    ):
        envs.step(np.zeros((3, 6), np.float32), np.ones(3, bool))
    envs.close()


def test_episodes_longer_than_the_first_room_for_actions(monkeypatch) -> None:
    monkeypatch.setattr("sauna.envs.host.mujoco_envs.CAPACITY", 8)
    envs, again = (in_process_envs("Swimmer-v5", {}, SEEDS, "auto") for _ in range(2))
    actions = wide_actions(envs, 40, seed=3)
    envs.reset(), again.reset()
    for action in actions:
        step = envs.step(action, np.ones(len(SEEDS), bool))
    np.testing.assert_array_equal(envs.snapshot(2)["actions"], actions[:, 2])
    np.testing.assert_array_equal(again.restore(2, envs.snapshot(2)), step.observation[2])
    np.testing.assert_array_equal(again.snapshot(2)["actions"], actions[:, 2])
    envs.close(), again.close()


def test_room_is_made_when_another_episode_ends(monkeypatch) -> None:
    monkeypatch.setattr("sauna.envs.host.mujoco_envs.CAPACITY", 3)
    envs = in_process_envs("InvertedPendulum-v5", {"max_episode_steps": 50}, SEEDS, "auto")
    envs.reset()
    every, action = np.ones(len(SEEDS), bool), np.zeros((len(SEEDS), 1), np.float32)
    envs.step(action, every), envs.step(action, every)
    envs._slots[0].env.unwrapped.data.qpos[1] = 1.0  # falls as the others take their third step
    assert envs.step(action, every).terminated.tolist() == [True, False, False]
    for _ in range(5):
        envs.step(action, every)
    assert [len(envs.snapshot(i)["actions"]) for i in range(3)] == [5, 8, 8]
    assert envs._actions.shape[1] == 12
    envs.close()


def test_without_mujocos_library_tasks_step_themselves(monkeypatch) -> None:
    monkeypatch.setattr("sauna.envs.host.mujoco_tasks.physics_is_linked", lambda: False)
    envs = in_process_envs("Hopper-v5", {}, SEEDS, "auto")
    assert type(envs) is MujocoEnvs and type(envs._task) is Task
    envs.close()


def test_the_seed_of_an_episode_is_the_contracts() -> None:
    envs = in_process_envs("Swimmer-v5", {}, SEEDS, "auto")
    expected, _ = gymnasium.make("Swimmer-v5").reset(seed=episode_seed(3, 1, 0))
    np.testing.assert_array_equal(envs.reset()[1], expected)
    envs.close()
