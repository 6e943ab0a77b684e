"""Environments of other packages, by their ids alone."""

from __future__ import annotations

import importlib.util
import sys
from types import SimpleNamespace

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
    assert packages.as_vector(env) is env and packages.forget_worlds(env) is env


def test_a_walker_has_a_new_world_in_each_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    class Walker(gymnasium.Env):  # as Gymnasium's: the world of `__init__` stays
        def __init__(self) -> None:
            self.world, self.destroyed = object(), []

        def _destroy(self) -> None:
            self.destroyed.append(self.world)

        def reset(self, **how):
            self._destroy()
            return self.world, {}

    box2d = SimpleNamespace(b2World=object)
    module = SimpleNamespace(BipedalWalker=Walker, Box2D=box2d)
    monkeypatch.setitem(sys.modules, "gymnasium.envs.box2d.bipedal_walker", module)
    walker = Walker()
    env = packages.forget_worlds(gymnasium.Wrapper(walker))
    worlds = [walker.world, env.reset()[0], env.reset()[0]]
    assert len(set(map(id, worlds))) == 3 and walker.destroyed == worlds[:2]


@pytest.mark.slow
@pytest.mark.parametrize("maker, differ", [(make_env, False), (gymnasium.make, True)])
def test_an_episode_of_the_walker_does_not_depend_on_those_before(maker, differ: bool) -> None:
    pytest.importorskip("Box2D", reason="needs `pip install 'sauna-rl[box2d]'`")
    name, kwargs = "BipedalWalker-v3", {} if maker is gymnasium.make else {"env_kwargs": {}}
    actions = np.random.default_rng(0).uniform(-1, 1, (400, 4)).astype(np.float32)

    def end(episodes_before: int) -> bytes:
        env = maker(name, **kwargs)
        for seed in range(episodes_before):
            env.reset(seed=seed)
        seen = env.reset(seed=0)[0]
        for action in actions:
            seen, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
        return seen.tobytes()

    assert (len({end(before) for before in range(4)}) > 1) == differ
