"""What environments answer: with the obvious meaning, or one clear line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import small_envs
from sauna.envs.host.answers import close, first_of, five_of, life_lost, one_number, reset_with
from sauna.envs.host.contract import episode_seed
from sauna.envs.host.gymnasium_envs import EnvironmentFailure, GymnasiumEnvs
from sauna.envs.probe import probe
from sauna.system.errors import BadInput

ALL = np.ones(1, bool)
ACTION = np.zeros((1, 2), np.float32)


@pytest.mark.parametrize(
    "reward", [2, 2.0, np.float32(2), np.array([2.0]), np.array([[2]]), np.array(2)]
)
def test_one_number_in_any_form_is_that_number(reward: Any) -> None:
    assert one_number(reward) == 2.0 and type(one_number(reward)) is float


@pytest.mark.parametrize("reward", [None, np.zeros(2), [], {}, 2j])
def test_a_reward_that_is_not_one_number_is_refused(reward: Any) -> None:
    with pytest.raises(ValueError, match=r"the reward from step\(\) is .*, not one number"):
        one_number(reward)


def test_step_and_reset_that_return_too_little_name_the_contract() -> None:
    five = (0.0, 1.0, False, False, {})
    assert five_of(five) == five and first_of((0.5, {})) == 0.5
    with pytest.raises(ValueError, match=r"step\(\) must return obs.*, info; it returned 4 values"):
        five_of(five[:4])
    for answer, words in ((np.zeros(2), "one ndarray"), (None, "nothing"), (([],), "1 value")):
        with pytest.raises(ValueError, match=rf"reset\(\) must .*, info; it returned {words}$"):
            first_of(answer)


def test_info_says_that_a_life_was_lost_or_nothing() -> None:
    assert not life_lost(None) and not life_lost({}) and not life_lost({"life_lost": np.zeros(1)})
    assert life_lost({"life_lost": np.array([True])})
    with pytest.raises(ValueError, match="info is a list, not a dict"):
        life_lost([])
    with pytest.raises(ValueError, match=r"'life_lost'\] is of shape \(2,\), not yes or no"):
        life_lost({"life_lost": np.array([True, False])})


def playing(**settings: Any) -> GymnasiumEnvs:
    return GymnasiumEnvs(lambda: small_envs.Answering(**settings), [(0, 0)])


def test_rewards_and_infos_reach_a_step() -> None:
    envs = playing(reward=[1.5], info=None)
    envs.reset()
    step = envs.step(ACTION, ALL)
    assert step.reward.tolist() == [1.5] and not step.life_lost[0]
    for wrong, words in (({"reward": [1, 2]}, r"shape \(2,\)"), ({"info": []}, "info is a list")):
        envs = playing(**wrong)
        envs.reset()
        with pytest.raises(EnvironmentFailure, match=words):
            envs.step(ACTION, ALL)
        with pytest.raises(BadInput, match=words):
            probe("small_envs:Answering", wrong)


def test_a_simulator_with_a_signed_seed_is_reset_with_the_lower_bits() -> None:
    small, large = 7, 2**31 + 9
    env = small_envs.SignedSeed()
    assert reset_with(env, small)[0] == small and reset_with(env, large)[0] == 9
    assert reset_with(small_envs.SignedSeed(error="OverflowError"), large)[0] == 9
    with pytest.raises(ValueError, match="on fire"):  # has nothing to do with the seed
        reset_with(small_envs.SignedSeed(error="fire"), large)


def test_other_environments_get_the_seed_as_it_is() -> None:
    numbers = [n for n in range(20) if episode_seed(0, 0, n) >= 2**31]
    assert numbers
    for n in numbers[:3]:
        got = GymnasiumEnvs(small_envs.Scripted, [(0, 0)]).start_after(
            0, {"episode": np.asarray(n - 1)}
        )
        expected, _ = small_envs.Scripted().reset(seed=episode_seed(0, 0, n))
        np.testing.assert_array_equal(got, expected)


def test_what_cannot_be_closed_is_said_and_costs_nothing(capsys) -> None:
    for error in ("RuntimeError", "SystemExit"):
        close(small_envs.Unclosable(error), "environment 0")
        said = capsys.readouterr().err
        assert said.startswith("warning: environment 0 cannot be closed: ") and error in said
    probe("small_envs:Unclosable", {})


def test_a_step_that_fails_is_not_hidden_by_close() -> None:
    with pytest.raises(BadInput, match="cannot be played: ValueError: the motor is on fire"):
        probe("small_envs:Unclosable", {"raises": True})
