"""Large coloured pictures made small and grey."""

from __future__ import annotations

import numpy as np
import pytest

from sauna.config.trust import named_code
from sauna.envs.make import make_env
from sauna.envs.small_grey import SIDE, SmallGrey, shares
from sauna.envs.wrapping import Wrapping, wrapped
from sauna.system.errors import BadInput
from small_envs import Colours

PATH = "sauna.envs.small_grey:SmallGrey"


def test_a_pixel_is_the_mean_of_what_it_covers() -> None:
    expected = np.array([[2, 1, 0], [0, 1, 2]]) / 3
    np.testing.assert_allclose(shares(3, 2), expected, atol=1e-7)
    np.testing.assert_array_equal(shares(4, 2), [[0.5, 0.5, 0, 0], [0, 0, 0.5, 0.5]])
    np.testing.assert_array_equal(shares(5, 5), np.eye(5))
    for before in (96, 100, 210):
        np.testing.assert_allclose(shares(before, SIDE).sum(1), 1.0, rtol=1e-6)
        of_each = SIDE / before  # no pixel of the longer line counts more than another
        np.testing.assert_allclose(shares(before, SIDE).sum(0), of_each, rtol=1e-6)


def test_an_action_is_taken_twice_and_pictures_are_grey() -> None:
    env = SmallGrey(Colours())
    for _ in range(2):
        seen, _ = env.reset(seed=0)
        assert env.observation_space.contains(seen) and seen.max() == 0
        rewards, ends = [], []
        for t in (2, 4, 5):
            seen, reward, *ended, _ = env.step(0)
            rewards.append(reward)
            ends.append(tuple(ended))
            assert np.unique(seen[:32]).tolist() == [round(0.299 * 10 * t)]
            assert np.unique(seen[32:]).tolist() == [round(0.114 * 10 * t)]
        assert ends[:2] == [(False, False)] * 2 and any(ends[2])
    plain, by_hand = Colours(), []
    plain.reset(seed=0)
    for _ in range(5):
        by_hand.append(plain.step(0)[1])
    assert rewards == [by_hand[0] + by_hand[1], by_hand[2] + by_hand[3], by_hand[4]]


def test_other_observations_are_refused_in_a_line() -> None:
    with pytest.raises(BadInput, match=f"wrap: {PATH} cannot wrap .*no pictures") as error:
        make_env("CartPole-v1", {}, Wrapping((PATH,)))
    assert "\n" not in str(error.value)


def test_a_video_of_it_is_as_fast_as_the_game() -> None:
    assert "render_fps" not in SmallGrey(Colours()).metadata
    colours = Colours()
    colours.metadata = {"render_fps": 50}
    assert SmallGrey(colours).metadata["render_fps"] == 25
    assert colours.metadata["render_fps"] == 50


def test_nobody_has_to_trust_it_and_pictures_can_be_stacked() -> None:
    assert named_code({"config": {"wrap": [PATH], "env": PATH}}) == [["env", PATH]]
    env = wrapped(Colours(), Wrapping((PATH,), 2))
    assert env.reset(seed=0)[0].shape == (SIDE, SIDE, 2)
