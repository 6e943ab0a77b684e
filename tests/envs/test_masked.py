"""Masks of valid actions: how they are read, what is refused, and where they stand."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from gymnasium import spaces as gym

import small_envs
from jax_envs import choosy
from sauna.envs.device.as_gymnasium import HostFace
from sauna.envs.device.contract import flat
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.envs.make import in_process_envs, make_env
from sauna.envs.masked import flat_mask, masked_space
from sauna.envs.probe import probe, probe_on_device
from sauna.envs.spaces import describe, observation_reader, read_spaces
from sauna.envs.wrapping import Wrapping
from sauna.system.errors import BadInput

MASKED = Wrapping(action_mask=True)


def test_a_mask_is_read_in_each_usual_form() -> None:
    wanted = [1, 0, 1, 0, 1]
    for given in (wanted, np.array(wanted, bool), ([1, 0, 1], np.array([False, True]))):
        np.testing.assert_array_equal(flat_mask(given, (3, 2)), wanted)


@pytest.mark.parametrize(
    "given, sizes, words",
    [
        ([1, 0], (3,), "2 entries instead of 3"),
        ([0, 0, 0], (3,), "leaves no valid action"),
        ([1, 0, 1, 0, 0], (3, 2), "no valid action of component 1"),
        ([1, 2, 0], (3,), "other values than 0 and 1"),
        ("abc", (3,), "1 entries instead of 3"),
        ([np.nan, 1, 1], (3,), "other values than 0 and 1"),
    ],
)
def test_what_is_no_mask_is_refused(given: Any, sizes: tuple[int, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        flat_mask(given, sizes)


def test_the_mask_stands_behind_the_numbers_and_before_pictures() -> None:
    two = gym.Discrete(2)
    picture = gym.Box(0, 9, (2, 3), np.uint8)
    bytes_ = np.arange(6, dtype=np.uint8).reshape(2, 3)
    cases = [
        (gym.Box(-1, 1, (2,)), np.array([0.5, -0.5]), "vector", 2, [0.5, -0.5, 0, 1]),
        (gym.Discrete(3), 2, "one_hot", 0, [0, 0, 1, 0, 1]),
        (picture, bytes_, "vector", 0, [0, 1, *range(6)]),
    ]
    for space, value, kind, normalized, expected in cases:
        masked = masked_space(space, two)
        found = describe(masked, two)
        assert (found.observation_kind, found.mask, found.normalized) == (kind, 2, normalized)
        assert found.observation_shape == (len(expected),)
        seen = observation_reader(masked)({"observation": value, "action_mask": np.array([0, 1])})
        np.testing.assert_array_equal(seen, expected)
        assert read_spaces(list(found)) == found
    assert describe(masked_space(picture, two), two).pictures == ((2, 3, 1, 9.0),)


@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("by", ["info", "method"])
def test_each_step_shows_the_mask_that_the_environment_gives(several: bool, by: str) -> None:
    kwargs = {"several": several, "by": by}
    envs = in_process_envs("small_envs:Choosy", kwargs, [(0, 0)], "auto", wrapping=MASKED)
    seen, action = envs.reset(), np.zeros((1, 1 + several), np.int32)
    inner = envs._slots[0].env
    for _ in range(8):  # over an end of an episode
        np.testing.assert_array_equal(seen[0, 3:], inner.valid)
        action[0, 0] = np.flatnonzero(inner.valid[: 3 if several else 5])[0]
        if several:
            action[0, 1] = np.flatnonzero(inner.valid[3:])[0]
        step = envs.step(action.copy(), np.ones(1, bool))
        seen = step.observation
        if step.ended:
            np.testing.assert_array_equal(step.final_observation[0, 3:], 1.0)
    snapshot = envs.snapshot(0)
    np.testing.assert_array_equal(envs.restore(0, snapshot), seen[0].copy())


def test_a_missing_or_empty_mask_is_an_error_that_names_the_environment() -> None:
    for wrong, words in (("missing", "gives none"), ("empty", "leaves no valid action")):
        kwargs = {"wrong": wrong}
        envs = in_process_envs("small_envs:Choosy", kwargs, [(4, 1)], "auto", wrapping=MASKED)
        seen = envs.reset()
        with pytest.raises(EnvironmentFailure, match=f"environment 1 of seed 4.*{words}"):
            for _ in range(3):
                action = np.argmax(seen[:, 3:], 1)[:, None].astype(np.int32)
                seen = envs.step(action, np.ones(1, bool)).observation


def test_what_gives_no_mask_or_takes_none_is_refused_at_the_start() -> None:
    for env, words in (
        ("small_envs:TwoSteps", "the environment gives none"),
        ("small_envs:Scripted", "needs Discrete or MultiDiscrete actions"),
    ):
        with pytest.raises(BadInput, match=f"^action_mask: .*{words}"):
            probe(env, {}, MASKED)
    with pytest.raises(BadInput, match="needs Discrete or MultiDiscrete"):
        probe_on_device("jax_envs:walk", {}, MASKED)
    assert probe("small_envs:Choosy", {"several": True}, MASKED).differs is None
    with pytest.raises(BadInput, match="is not valid"):  # it would raise without its mask
        probe("small_envs:Choosy", {"several": True})


def test_rows_that_are_stepped_together_take_no_masks() -> None:
    with pytest.raises(BadInput, match=r"^action_mask: the rows of make_vec"):
        probe("make_vec/CartPole-v1", {}, MASKED)


def test_a_picture_of_floats_beside_a_mask_is_refused() -> None:
    space = masked_space(gym.Box(0.0, 1.0, (40, 40)), gym.Discrete(2))
    with pytest.raises(BadInput, match=r"^action_mask: .* has to be of bytes"):
        describe(space, gym.Discrete(2))


def test_a_wrapped_environment_is_found_through_its_wrappers() -> None:
    import gymnasium

    env = make_env("small_envs:Choosy", {"by": "method"})
    wrapped = gymnasium.wrappers.TimeLimit(env, 5)
    from sauna.envs.masked import MaskedEnv

    masked = MaskedEnv(wrapped)
    seen, _ = masked.reset(seed=0)
    np.testing.assert_array_equal(seen["action_mask"], env.valid)
    assert masked.unwrapped is env and isinstance(env, small_envs.Choosy)


def test_the_device_shows_the_same_mask_as_its_gymnasium_interface() -> None:
    one, face = flat(choosy, masked=True), HostFace(choosy)
    face.reset(seed=3)
    state, seen = jax.jit(one.reset)(jax.random.fold_in(jax.random.key(3), 2**31))
    for _ in range(4):
        valid = face.action_masks()
        np.testing.assert_array_equal(seen[2:], valid)
        action = np.array([np.argmax(valid[:3]), np.argmax(valid[3:])], np.int32)
        face.step(action)
        transition = jax.jit(one.step)(state, action)
        state, seen = transition.state, transition.observation


def test_an_environment_that_raises_at_invalid_actions_gets_a_hint() -> None:
    with pytest.raises(
        BadInput, match=r"is not valid.*; it has action_masks\(\): give --action-mask"
    ):
        probe("small_envs:Choosy", {"by": "method"})
