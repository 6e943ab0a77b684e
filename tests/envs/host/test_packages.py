"""Environments of other packages, by their ids alone."""

from __future__ import annotations

import importlib.util

import gymnasium
import numpy as np
import pytest

from sauna.envs.host import packages
from sauna.envs.make import known_in_this_process_alone, make_env
from sauna.envs.probe import probe
from sauna.system.errors import BadInput


@pytest.mark.parametrize(
    "name, module",
    [
        ("MiniGrid-DoorKey-5x5-v0", "minigrid"),
        ("BabyAI-GoToRedBall-v0", "minigrid"),
        ("FetchReachDense-v4", "gymnasium_robotics"),
        ("PointMaze_UMazeDense-v3", "gymnasium_robotics"),
        ("Hopper-v5", None),
        ("Fetch-v1", "gymnasium_robotics"),
        ("MyMiniGrid-v0", None),
    ],
)
def test_the_package_of_an_id(name: str, module: str | None) -> None:
    found = packages.package_of(name)
    assert (found.module if found else None) == module


def test_an_extra_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"MiniGrid-X-v0 needs `pip install 'sauna-rl\[minigrid\]'`"):
        make_env("MiniGrid-X-v0", {})


def test_minigrid_is_one_vector_and_repeats_itself() -> None:
    pytest.importorskip("minigrid")
    found = probe("MiniGrid-Empty-5x5-v0", {})
    assert found.spaces.observation_kind == "vector" and found.spaces.action_sizes == (7,)
    assert found.spaces.observation_shape == (7 * 7 * 3 + 96 * 28,)  # picture, mission
    assert found.differs is None and found.time_limit is None
    assert "MiniGrid-Empty-5x5-v0" in gymnasium.registry
    assert not known_in_this_process_alone("MiniGrid-Empty-5x5-v0")
    with pytest.raises(BadInput, match="did you mean 'MiniGrid-Empty-5x5-v0'"):
        make_env("MiniGrid-Empty-5x5-v1", {})


def test_the_dense_maze_is_read_as_one_vector() -> None:
    pytest.importorskip("gymnasium_robotics")
    found = probe("PointMaze_UMazeDense-v3", {})
    assert found.spaces.observation_shape == (2 + 2 + 4,)
    assert found.spaces.action_kind == "continuous" and found.time_limit == 300


@pytest.mark.parametrize("module", ["", "gymnasium_robotics:"])
def test_fetch_can_be_made_and_shows_its_joints(module: str) -> None:
    pytest.importorskip("gymnasium_robotics")
    env = make_env(f"{module}FetchReachDense-v4", {})
    env.reset(seed=0)
    seen = env.step(np.zeros(4, np.float32))[0]["observation"]
    assert seen.shape == (10,)
    joint = env.unwrapped.data.joint("robot0:r_gripper_finger_joint").qpos[0]
    assert seen[3] == joint  # the gripper's first number
    env.close()


def test_other_environments_stay_as_they_are() -> None:
    env = gymnasium.make("CartPole-v1")
    assert packages.as_vector(env) is env
