"""Environments whose values are known by hand: each arm must learn them, with every seed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from helpers import make_job, policy_output, train_here

# The paper's arm is the corrected one with another target: its probes are slow tests.
ARMS = ["ppo", "sauna", "sauna-reference", pytest.param("sauna-paper", marks=pytest.mark.slow)]
SEEDS = 2
GAMMA = 0.8


def learn(env: str, arm: str, **settings: Any) -> Any:
    """Trains both seeds; a function from observations to each seed's network output."""
    given = {
        "rollout_steps": 64,
        "minibatches": 4,
        "epochs": 8,
        "hidden": "16",
        "steps": 64 * 40,
        "learning_rate": 0.02,
        "learning_rate_schedule": "linear",
        "seeds": SEEDS,
        "gamma": GAMMA,
        "normalize_observations": False,
        "normalize_rewards": False,
        "clip_value": False,
        **settings,
    }
    job = make_job(f"small_envs:{env}", arm=arm, **given)
    recorder = train_here(job)

    def outputs(observations: list[float]) -> list[Any]:
        column = np.array(observations)[:, None]
        return [policy_output(job, recorder.final, f"{arm}/{s}", column) for s in range(SEEDS)]

    return outputs


def unfiltered(arm: str) -> dict[str, Any]:
    """Lets the reference arm drop nothing. Where one observation is all there is, its head learns
    Vex = 0; eq. 7 divides by that, nearly every step is dropped, and the budget counts the kept."""
    return {"threshold": 0.0} if arm == "sauna-reference" else {}


every_arm = pytest.mark.parametrize("arm", ARMS)


@every_arm
def test_constant_reward(arm: str) -> None:
    for output in learn("ConstantReward", arm, **unfiltered(arm))([0.0]):
        np.testing.assert_allclose(output.value, [1.0], atol=0.05)


@every_arm
def test_reward_that_is_observed(arm: str) -> None:
    for output in learn("ObservedReward", arm)([1.0, -1.0]):
        np.testing.assert_allclose(output.value, [1.0, -1.0], atol=0.1)


@every_arm
def test_discount_over_two_steps(arm: str) -> None:
    """The reference arm drops nothing here: when its filter drops every second step, the released
    rules lose every episode end, and V can grow beyond what an episode pays (algorithm.md)."""
    for output in learn("TwoSteps", arm, **unfiltered(arm))([0.0, 1.0]):
        np.testing.assert_allclose(output.value, [GAMMA, 1.0], atol=0.1)


@every_arm
def test_the_action_that_pays(arm: str) -> None:
    for output in learn("GoodAction", arm, **unfiltered(arm))([0.0]):
        assert probability_of_1(output.policy)[0] > 0.95
        np.testing.assert_allclose(output.value, [1.0], atol=0.15)


@pytest.mark.parametrize(
    "arm", [*ARMS[:2], pytest.param("sauna-reference", marks=pytest.mark.slow), ARMS[-1]]
)
def test_the_action_that_pays_here(arm: str) -> None:
    for output in learn("MatchingAction", arm)([1.0, -1.0]):
        p = probability_of_1(output.policy)
        assert p[0] > 0.95 and p[1] < 0.05
        np.testing.assert_allclose(output.value, [1.0, 1.0], atol=0.15)


@every_arm
def test_a_time_limit_is_not_an_end(arm: str) -> None:
    """Bootstrapped, V is the endless sum; the reference arm treats the limit as an end and must
    miss it: the mean over the five steps of what is left is well below."""
    for output in learn("Endless", arm, gae_lambda=0.9, steps=64 * 80)([0.0]):
        if arm == "sauna-reference":
            assert output.value[0] < 3.4
        else:
            np.testing.assert_allclose(output.value, [1 / (1 - GAMMA)], atol=0.25)


@every_arm
def test_an_end_is_not_a_time_limit(arm: str) -> None:
    expected = [sum(GAMMA**k for k in range(5 - t)) for t in (0, 2, 4)]
    for output in learn("Finite", arm)([0.0, 2.0, 4.0]):
        np.testing.assert_allclose(output.value, expected, atol=0.3)


def probability_of_1(logits: Any) -> np.ndarray:
    exponents = np.exp(np.asarray(logits))
    return exponents[:, 1] / exponents.sum(1)
