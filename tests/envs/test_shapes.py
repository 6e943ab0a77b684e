"""Observations of the wrong shape are refused by the key; batches have one more axis in front."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces as gym

import small_envs
from jax_envs import walk
from sauna.envs.host.gymnasium_envs import EnvironmentFailure, GymnasiumEnvs
from sauna.envs.probe import probe, probe_on_device
from sauna.envs.shapes import batch_size, check_shapes, one_of
from sauna.envs.spaces import observation_reader
from sauna.system.errors import BadInput

GOAL = gym.Dict({"goal": gym.Box(-1, 1, (2,)), "position": gym.Box(-1, 1, (2,))})
NESTED = gym.Dict({"a": gym.Tuple((gym.Discrete(3), gym.Box(0, 1, (2, 3)))), "b": GOAL})
ONE = {
    "a": (np.int64(1), np.zeros((2, 3))),
    "b": {"goal": np.zeros(2), "position": np.ones(2)},
}


def stacked(observation: Any, number: int) -> Any:
    if isinstance(observation, dict):
        return {name: stacked(part, number) for name, part in observation.items()}
    if isinstance(observation, tuple):
        return tuple(stacked(part, number) for part in observation)
    return np.stack([observation] * number)


def test_one_observation_and_batches_are_told_apart() -> None:
    cases = [(NESTED, ONE), (gym.Discrete(4), 2), (gym.Box(0, 255, (3, 40, 40), np.uint8), None)]
    for space, given in cases:
        one = space.sample() if given is None else given
        assert batch_size(space, one) is None
        for number in (1, 2, 3, 40):
            many = stacked(one, number)
            assert batch_size(space, many) == number
            read = observation_reader(space)
            np.testing.assert_array_equal(read(one_of(space, many, number - 1)), read(one))


@pytest.mark.parametrize(
    "observation, got",
    [
        (np.zeros(2), "(2,)"),
        ({"position": np.zeros(2)}, "dict(position (2,))"),
        ({"goal": np.zeros(3), "position": np.zeros(2)}, "dict(goal (3,), position (2,))"),
        ({"goal": np.zeros((4, 2)), "position": np.zeros(2)}, "dict(goal (4, 2), position (2,))"),
        ({"goal": np.zeros((4, 2)), "position": np.zeros((5, 2))}, "dict(goal (4, 2), position (5"),
        ({"goal": [[1], [1, 2]], "position": np.zeros(2)}, "dict(goal list, position (2,))"),
        (None, "()"),
    ],
)
def test_what_is_neither_is_refused_with_what_is_expected(observation: Any, got: str) -> None:
    with pytest.raises(ValueError) as caught:
        batch_size(GOAL, observation)
    wanted = "expected Dict(goal (2,), position (2,)), one observation or a batch of them; got "
    assert str(caught.value).startswith(wanted + got)


def test_the_key_of_the_part_is_named() -> None:
    check_shapes(NESTED, ONE)
    check_shapes(GOAL, {**ONE["b"], "more": 3})  # type: ignore[dict-item]
    check_shapes(gym.Dict({"x": gym.Box(0, 1, (1,)), "n": gym.Discrete(3)}), {"x": 0.5, "n": [1]})
    wrong = {**ONE, "b": {"goal": np.zeros((1, 2)), "position": np.zeros(2)}}
    with pytest.raises(ValueError, match=r"\['b'\]\['goal'\] is of shape \(1, 2\), and .* \(2,\)"):
        observation_reader(NESTED)(wrong)
    with pytest.raises(ValueError, match=r"observation\['a'\] is not a tuple of 2 parts"):
        check_shapes(NESTED, {**ONE, "a": 3})
    with pytest.raises(ValueError, match="observation has no 'position'"):
        check_shapes(GOAL, {"goal": np.zeros(2)})
    with pytest.raises(ValueError, match=r"of shape \(3, 2\), and its space of \(2, 3\)"):
        observation_reader(gym.Box(0, 1, (2, 3)))(np.zeros((3, 2)))


class Tall(small_envs.Parts):
    """Its speed has a leading axis from step `since` on."""

    since = 0

    def observe(self) -> Any:
        seen = super().observe()
        return {**seen, "speed": seen["speed"][None]} if self.t >= self.since else seen


class TallLater(Tall):
    since = 2


def test_a_leading_axis_never_trains_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    said = r"observation\['speed'\] is of shape \(1, 2\), and its space of \(2,\)"
    monkeypatch.setattr(small_envs, "Tall", Tall, raising=False)
    with pytest.raises(BadInput, match=said):
        probe("small_envs:Tall", {})
    envs = GymnasiumEnvs(TallLater, [(0, 0)])
    envs.reset()
    action, all_ = (
        np.zeros((1, envs.spaces.action_width), envs.spaces.action_dtype),
        np.ones(1, bool),
    )
    envs.step(action, all_)
    with pytest.raises(EnvironmentFailure, match=said):
        envs.step(action, all_)


def test_on_the_device_another_shape_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be flattened without a word."""
    tall = walk._replace(observation_space=gym.Box(-1, 1, (*walk.observation_space.shape, 1)))
    monkeypatch.setattr(small_envs, "tall_walk", tall, raising=False)
    with pytest.raises(BadInput, match="observation is of shape"):
        probe_on_device("small_envs:tall_walk", {})
