"""The conformance suite: what every host backend must do, on every kind of space."""

from __future__ import annotations

import json
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest

from helpers import assert_same_step
from sauna.envs.actions import action_writer
from sauna.envs.host.contract import HostEnvs, episode_seed
from sauna.envs.host.gymnasium_envs import EnvironmentFailure, GymnasiumEnvs
from sauna.envs.make import env_maker, make_drawn_env
from sauna.envs.probe import probe
from sauna.envs.spaces import describe, observation_reader
from sauna.envs.workers import ProcessEnvs
from sauna.system.errors import BadInput
from small_envs import Scripted, Spaced

SEEDS = [(3, 0), (3, 1), (5, 0)]
Make = Callable[..., HostEnvs]


def in_process(env: str, kwargs: dict, seeds: list = SEEDS) -> HostEnvs:
    return GymnasiumEnvs(env_maker(env, kwargs), seeds)


def in_workers(env: str, kwargs: dict, seeds: list = SEEDS) -> HostEnvs:
    return ProcessEnvs(env, kwargs, seeds, processes=2, timeout=30.0)


backends = pytest.mark.parametrize("make", [in_process, in_workers])


def actions(number: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(number, len(SEEDS), 2)).astype(np.float32)


@backends
def test_steps_are_the_environments_own(make: Make) -> None:
    """Against plain Gymnasium loops: observations, rewards, both kinds of end, final
    observations, and the seeds of the episodes."""
    envs, plain = make("small_envs:Scripted", {}), [Scripted() for _ in SEEDS]
    episodes = [0] * len(SEEDS)
    expected = [e.reset(seed=episode_seed(*s, 0))[0] for e, s in zip(plain, SEEDS, strict=True)]
    np.testing.assert_array_equal(envs.reset(), expected)
    seen = {"terminated": 0, "truncated": 0}
    everyone = np.ones(len(SEEDS), bool)
    for row in actions(80):
        got = envs.step(row, everyone)
        for i, env in enumerate(plain):
            observation, reward, terminated, truncated, _ = env.step(np.clip(row[i], -1, 1))
            assert (got.reward[i], got.terminated[i], got.truncated[i]) == (
                reward,
                terminated,
                truncated,
            )
            if terminated or truncated:
                seen["terminated" if terminated else "truncated"] += 1
                np.testing.assert_array_equal(got.final_observation[i], observation)
                episodes[i] += 1
                observation, _ = env.reset(seed=episode_seed(*SEEDS[i], episodes[i]))
            np.testing.assert_array_equal(got.observation[i], observation)
    envs.close()
    assert min(seen.values()) > 5


@backends
def test_inactive_environments_stand_still(make: Make) -> None:
    envs, other = make("small_envs:Scripted", {}), in_process("small_envs:Scripted", {})
    before = envs.reset()
    other.reset()
    everyone, two = np.ones(3, bool), np.array([True, False, True])
    first = envs.step(actions(1)[0], two)
    np.testing.assert_array_equal(first.observation[1], before[1])
    assert not first.terminated[1] and not first.truncated[1]
    got = np.array(envs.step(actions(1, 9)[0], everyone).observation[1])
    np.testing.assert_array_equal(got, other.step(actions(1, 9)[0], everyone).observation[1])
    envs.close()


@backends
def test_a_restored_environment_goes_on_bit_for_bit(make: Make) -> None:
    everyone = np.ones(3, bool)
    envs, again = make("small_envs:Scripted", {}), make("small_envs:Scripted", {})
    envs.reset()
    again.reset()
    for row in actions(37):
        last = np.array(envs.step(row, everyone).observation)
    for i in range(3):
        np.testing.assert_array_equal(again.restore(i, envs.snapshot(i)), last[i])
    for row in actions(40, 1):
        one, two = envs.step(row, everyone), again.step(row, everyone)
        assert_same_step(one, two)
    envs.close()
    again.close()


@pytest.mark.parametrize(
    "name",
    [
        "HalfCheetah-v5",
        "Hopper-v5",
        "Ant-v5",
        "Humanoid-v5",
        "InvertedPendulum-v5",
        "Reacher-v5",
        "Swimmer-v5",
    ],
)
def test_mujoco_tasks_are_restored_bit_for_bit(name: str) -> None:
    seeds = [(0, 0)]
    envs, again = in_process(name, {}, seeds), in_process(name, {}, seeds)
    width = envs.spaces.action_width  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    envs.reset()
    again.reset()
    for _ in range(80):
        envs.step(rng.normal(size=(1, width)).astype(np.float32), np.ones(1, bool))
    again.restore(0, envs.snapshot(0))
    for _ in range(80):
        action = rng.normal(size=(1, width)).astype(np.float32)
        one = envs.step(action, np.ones(1, bool))
        two = again.step(action, np.ones(1, bool))
        assert_same_step(one, two)


@backends
@pytest.mark.parametrize("action", ["box", "discrete", "multi_discrete", "multi_binary"])
@pytest.mark.parametrize("observation", ["box", "discrete", "dict"])
def test_every_supported_space(make: Make, observation: str, action: str) -> None:
    """The environment itself asserts that each action belongs to its space."""
    if make is in_workers and (observation, action) != ("dict", "multi_discrete"):
        pytest.skip("one combination is enough to cover the worker's conversions")
    envs = make("small_envs:Spaced", {"observation": observation, "action": action})
    spaces = envs.spaces  # type: ignore[attr-defined]
    assert envs.reset().shape == (3, *spaces.observation_shape)
    rng = np.random.default_rng(0)
    for _ in range(12):
        if action == "box":
            chosen = rng.normal(size=(3, 4)).astype(np.float32) * 3
        else:
            high = spaces.action_sizes if action.endswith("discrete") else [2] * 4
            chosen = rng.integers(0, high, size=(3, spaces.action_width)).astype(np.int32)
        assert envs.step(chosen, np.ones(3, bool)).reward.tolist() == [1.0] * 3
    envs.close()


def test_conversions_by_hand() -> None:
    spaced = Spaced("dict", "multi_discrete")
    read = observation_reader(spaced.observation_space)
    seen = read({"a": np.array([0.25, 0.5], np.float32), "b": 2})
    np.testing.assert_allclose(seen, [0.25, 0.5, 0, 0, 1])
    write = action_writer(spaced.action_space)
    np.testing.assert_array_equal(write(np.array([1, 2], np.int32)), [2, 6])
    assert action_writer(Spaced("box", "discrete").action_space)(np.array([0])) == -1
    read = observation_reader(gymnasium.spaces.Box(0, 255, (2, 40, 50), np.uint8))
    assert read(np.zeros((2, 40, 50), np.uint8)).shape == (40, 50, 2)
    kind, shape = describe(
        gymnasium.spaces.Box(0, 255, (96, 96, 3), np.uint8), gymnasium.spaces.Discrete(2)
    )[:2]
    assert (kind, shape) == ("image", (96, 96, 3))


@pytest.mark.parametrize("kwargs", [{"observation": "text"}, {"action": "tuple"}])
def test_unsupported_spaces_are_named(kwargs: dict) -> None:
    with pytest.raises(BadInput, match="not supported"):
        probe("small_envs:Spaced", kwargs)


def test_the_probe_sees_what_does_not_repeat() -> None:
    assert probe("small_envs:Scripted", {}).differs is None
    assert probe("Hopper-v5", {}).differs is None
    assert "observations differ" in str(probe("small_envs:Forgetful", {}).differs)
    assert "observations differ" in str(probe("small_envs:Lingering", {}).differs)


@pytest.mark.parametrize(
    "env, message",
    [
        ("NoSuch-v0", "unknown environment"),
        ("small_envs:NoSuch", "has no 'NoSuch'"),
        ("nowhere:Scripted", "cannot import"),
        ("nowhere:Thing-v0", "cannot import"),
    ],
)
def test_environments_that_do_not_exist(env: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        probe(env, {})


def test_wrong_keywords_are_bad_input() -> None:
    with pytest.raises(BadInput, match="cannot be made"):
        probe("small_envs:Scripted", json.loads('{"speed": 3}'))


@pytest.mark.parametrize(
    "env, kwargs, camera",
    [
        ("HalfCheetah-v5", {}, 0),  # its model's own camera, which follows it
        ("HalfCheetah-v5", {"camera_id": -1}, -1),  # the user's choice
        ("InvertedPendulum-v5", {}, -1),  # has none, and stays where it is
    ],
)
def test_pictures_follow_the_robot(env: str, kwargs: dict, camera: int) -> None:
    assert make_drawn_env(env, kwargs).unwrapped.mujoco_renderer.camera_id == camera


@backends
def test_non_finite_numbers_are_refused_with_their_place(make: Make) -> None:
    envs = make("small_envs:NotANumber", {})
    envs.reset()
    with pytest.raises(EnvironmentFailure, match=r"seed \d.*episode 2, step 1.*\[1\] is nan"):
        for row in actions(60):
            envs.step(row, np.ones(3, bool))
    envs.close()


@backends
def test_an_observation_of_another_shape_is_not_stretched(make: Make) -> None:
    """One number would fill a row of three. The probe looks at the first episodes only."""
    envs = make("small_envs:Misshapen", {"first": 2})
    envs.reset()
    with pytest.raises(
        EnvironmentFailure, match=r"episode 2, step 0.*shape \(1,\) instead of \(3,"
    ):
        for row in actions(60):
            envs.step(row, np.ones(3, bool))
    envs.close()


@backends
def test_an_exception_names_the_environment(make: Make) -> None:
    envs = make("small_envs:Raising", {})
    envs.reset()
    with pytest.raises(EnvironmentFailure, match=r"environment 0 of seed 3.*on fire"):
        envs.step(actions(1)[0], np.ones(3, bool))
    envs.close()


def test_a_dead_worker_is_named_with_its_exit_code() -> None:
    envs = in_workers("small_envs:Dying", {})
    envs.reset()
    with pytest.raises(EnvironmentFailure, match=r"worker 0 \(process \d+\) ended .* code 7"):
        envs.step(actions(1)[0], np.ones(3, bool))
    envs.close()


def test_a_worker_killed_between_steps_is_named() -> None:
    envs = in_workers("small_envs:Scripted", {})
    envs.reset()
    envs._workers[1].process.kill()  # type: ignore[attr-defined]
    envs._workers[1].process.wait()  # type: ignore[attr-defined]
    with pytest.raises(EnvironmentFailure, match=r"worker 1 \(process \d+\) ended .* code -9"):
        envs.step(actions(1)[0], np.ones(3, bool))
    envs.close()


@backends
def test_an_episode_can_be_skipped(make: Make) -> None:
    """What an inexact resume does: the episode after the one of the snapshot."""
    envs = make("small_envs:Scripted", {})
    envs.reset()
    got = envs.start_after(1, {"episode": np.asarray(4), "actions": np.zeros((0, 2))})
    expected, _ = Scripted().reset(seed=episode_seed(3, 1, 5))
    np.testing.assert_array_equal(got, expected)
    envs.close()


def test_a_non_finite_first_observation_is_refused() -> None:
    with pytest.raises(EnvironmentFailure, match="episode 0, step 0"):
        in_process("small_envs:NotANumber", {"first": 1, "step": 0}).reset()


@pytest.mark.parametrize("kwargs", [{"broken": "reset"}, {"broken": "step"}])
def test_an_environment_that_cannot_be_played_is_bad_input(kwargs: dict) -> None:
    with pytest.raises(BadInput, match="small_envs:Broken cannot be played: TypeError: two lines"):
        probe("small_envs:Broken", kwargs)


def test_a_hung_worker_is_named_and_killed() -> None:
    envs = ProcessEnvs("small_envs:Hanging", {}, SEEDS, processes=1, timeout=20.0)
    envs.reset()
    envs._timeout = 0.5
    with pytest.raises(EnvironmentFailure, match=r"did not answer within 0\.5 s"):
        envs.step(actions(1)[0], np.ones(3, bool))
    assert envs._workers[0].process.wait() != 0
    envs.close()
