"""A number too large to learn from is named at once, and an environment may go where it likes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from helpers import SMALL
from sauna.algorithm.rollout.device import _finite_rows
from sauna.envs.host.gymnasium_envs import LARGEST, EnvironmentFailure, GymnasiumEnvs
from small_envs import Scripted


class Large(Scripted):
    """Shows or gives a number from the third step on."""

    def __init__(self, observation: float = 0.0, reward: float = 0.0) -> None:
        self.large, self.extra, self.taken = observation, reward, 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        observation, reward, terminated, truncated, info = super().step(action)
        self.taken += 1
        if self.taken >= 3:
            observation = np.array([self.large, -self.large, 0.0])
            reward += self.extra
        return observation, reward, terminated, truncated, info


class Wandering(Scripted):
    """Changes the working folder wherever it can."""

    def __init__(self) -> None:
        os.chdir("/")

    def reset(self, **more: Any) -> tuple[Any, dict]:
        os.chdir("/usr")
        return super().reset(**more)


def stepped(**large: float) -> GymnasiumEnvs:
    envs = GymnasiumEnvs(lambda: Large(**large), [(0, 0)])
    envs.reset()
    for _ in range(4):
        envs.step(np.zeros((1, 2), np.float32), np.ones(1, bool))
    return envs


@pytest.mark.parametrize("large", [1e200, -1e200, 1.1 * LARGEST, np.inf, np.nan])
def test_the_number_its_step_and_its_component_are_named(large: float) -> None:
    with pytest.raises(EnvironmentFailure, match=r"seed 0, episode 0, step 3: observation\[0\] is"):
        stepped(observation=large)
    with pytest.raises(EnvironmentFailure, match=r"step 3: reward is"):
        stepped(reward=large)


def test_large_numbers_that_can_be_learned_from_are_taken() -> None:
    stepped(observation=1e30, reward=-1e30)


def test_the_device_looks_for_what_float32_cannot_square() -> None:
    rows = np.array([[1.0, 2.0], [1e19, 0.0], [np.nan, 0.0], [0.0, -1e17]], np.float32)
    assert np.asarray(_finite_rows(rows)).tolist() == [True, False, False, True]


def test_an_environment_that_goes_elsewhere_does_not_take_the_run_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sauna.train(lambda: Wandering(), out="run", quiet=True, **{**SMALL, "arm": "ppo"})
    os.chdir(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"run"}
    assert (tmp_path / "run" / "summary.json").exists()
    sauna.evaluate("run", episodes=1)
    assert (tmp_path / "run" / "evaluation_sampled.json").exists()
    assert Path.cwd() == tmp_path
