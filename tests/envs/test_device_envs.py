"""Every backend of the device keeps one contract."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import Recorder, make_job
from sauna.envs.device.contract import flat
from sauna.envs.device.make import make_jax_env
from sauna.envs.make import make_env
from sauna.envs.probe import probe_on_device
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.training.worker import train_members

slow = pytest.mark.slow
# An environment of each backend, and how long its episodes may last here.
BACKENDS = [
    ("jax_envs:walk", {}, 12),
    ("jax_envs:make_walk", {"limit": 1e9}, 12),
    ("gymnax/Pendulum-v1", {"max_steps_in_episode": 7}, 7),
    ("gymnax/Breakout-MinAtar", {"max_steps_in_episode": 7}, 7),
    *(
        pytest.param(f"gymnax/{game}-MinAtar", {"max_steps_in_episode": 7}, 7, marks=slow)
        for game in ("Asterix", "Freeway", "SpaceInvaders", "Seaquest")
    ),
    pytest.param("mjx/InvertedPendulum-v5", {"time_limit": 4}, 4, marks=slow),
    pytest.param("playground/CheetahRun", {"episode_length": 3}, 3, marks=slow),
    pytest.param("brax/inverted_pendulum", {"episode_length": 4}, 4, marks=slow),
    pytest.param("mjx/HalfCheetah-v5", {"time_limit": 3}, 3, marks=slow),
    pytest.param("mjx/Hopper-v5", {"time_limit": 3}, 3, marks=slow),
]


def shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree)


@pytest.mark.parametrize("name, kwargs, limit", BACKENDS)
def test_a_backend_keeps_the_contract(name: str, kwargs: dict[str, Any], limit: int) -> None:
    env = flat(make_jax_env(name, kwargs))
    spaces = probe_on_device(name, kwargs).spaces
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    keys = jax.random.split(jax.random.key(0), 2)
    state, observation = reset(keys)
    assert observation.shape == (2, *spaces.observation_shape)
    assert observation.dtype == spaces.observation_dtype
    assert equal_trees(reset(keys), (state, observation)), "the same key, the same episode"
    action = jnp.zeros((2, spaces.action_width), spaces.action_dtype)
    first = step(state, action)
    assert equal_trees(step(state, action), first), "the same action, the same step"
    transition, length = first, 1
    while not bool((transition.terminated | transition.truncated)[0]):
        assert shapes(transition.state) == shapes(state), "a state of the same shapes for ever"
        assert shapes(transition.observation) == shapes(observation)
        assert np.isfinite(transition.reward).all() and np.isfinite(transition.observation).all()
        transition, length = step(transition.state, action), length + 1
        assert length <= limit
    assert not bool((transition.terminated & transition.truncated).any())
    if length == limit:
        assert bool(transition.truncated[0]), "a time limit is no termination"


def equal_trees(one: Any, other: Any) -> bool:
    def data(x: Any) -> np.ndarray:
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(data(a), data(b), equal_nan=True) for a, b in pairs)


@pytest.mark.parametrize(
    "name, tolerance",
    [
        ("InvertedPendulum-v5", 1e-4),
        pytest.param("HalfCheetah-v5", 2e-2, marks=slow),
        pytest.param("Hopper-v5", 2e-2, marks=slow),
    ],
)
@pytest.mark.slow
def test_mjx_tasks_are_gymnasiums_to_single_precision(name: str, tolerance: float) -> None:
    """From the same state, with the same actions: observations, rewards and ends of 8 steps."""
    ours, theirs = make_jax_env(f"mjx/{name}", {}), gymnasium.make(name)
    step = jax.jit(ours.step)
    state, observation = jax.jit(ours.reset)(jax.random.key(2))
    theirs.reset(seed=0)
    bare = theirs.unwrapped
    bare.set_state(np.asarray(state.qpos, float), np.asarray(state.qvel, float))
    rng = np.random.default_rng(0)
    assert ours.action_space == theirs.action_space
    for _ in range(8):
        action = rng.uniform(-1, 1, theirs.action_space.shape).astype(np.float32)
        transition = step(state, action)
        expected = theirs.step(action)
        np.testing.assert_allclose(
            transition.observation, expected[0], atol=tolerance, rtol=tolerance
        )
        np.testing.assert_allclose(transition.reward, expected[1], atol=tolerance, rtol=tolerance)
        assert bool(transition.terminated) == expected[2]
        state = transition.state
    assert not np.allclose(expected[0], observation, atol=10 * tolerance), "it has moved"


def test_the_host_face_is_an_ordinary_environment() -> None:
    env = make_env("gymnax/CartPole-v1", {"max_steps_in_episode": 9})
    spaces = env.observation_space, env.action_space
    assert isinstance(spaces[0], gymnasium.spaces.Box) and spaces[1] == gymnasium.spaces.Discrete(2)
    played = []
    for _ in range(2):
        seen = [env.reset(seed=5)[0]]
        for i in range(9):
            observation, reward, terminated, truncated, _ = env.step(i % 2)
            assert isinstance(reward, float) and spaces[0].contains(observation)
            seen.append(observation)
        assert truncated and not terminated
        played.append(np.stack(seen))
    np.testing.assert_array_equal(*played)
    unseeded = env.reset()[0]
    assert not np.array_equal(unseeded, played[0][0])


def test_a_reset_draws_nothing_that_the_actions_draw() -> None:
    """Action noise of step t is drawn with `fold_in(key(seed), t)`; `split` folds in 0, 1, ..."""
    one = make_env("jax_envs:walk", {})
    start = one.reset(seed=7)[0][0]
    noise = [jax.random.normal(jax.random.fold_in(jax.random.key(7), t)) for t in range(4)]
    assert start not in np.asarray(noise)
    straight = jax.random.normal(jax.random.split(jax.random.key(7))[1])
    assert straight in np.asarray(noise)  # what it would be without the wrapper's own fold


def test_a_missing_backend_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"pip install 'sauna-rl\[playground\]'"):
        make_jax_env("playground/CheetahRun", {})


def test_a_backend_lists_its_environments(capsys: pytest.CaptureFixture[str]) -> None:
    from sauna.cli import main

    main(["list", "gymnax"])
    assert "gymnax/CartPole-v1\n" in capsys.readouterr().out


def test_unknown_names_and_arguments_are_bad_input() -> None:
    with pytest.raises(BadInput, match="CartPole-v1"):
        make_jax_env("gymnax/CartPole-v2", {})
    with pytest.raises(BadInput, match="no parameter 'gravty'"):
        make_jax_env("gymnax/CartPole-v1", {"gravty": 3})
    with pytest.raises(BadInput, match="takes none"):
        make_jax_env("jax_envs:walk", {"limit": 3})


CARTPOLE = {
    "envs": 8,
    "rollout_steps": 128,
    "minibatches": 4,
    "epochs": 8,
    "hidden": "64,64",
    "learning_rate": 1e-3,
    "steps": 200_000,
    "seeds": 10,
}


class UntilSolved(Recorder):
    """Stops once every seed's mean return of 100 episodes has been above 475 of 500."""

    def __init__(self) -> None:
        super().__init__()
        self.best = dict.fromkeys(range(10), 0.0)

    def iteration(self, iteration: int, rows: list[dict], timing: dict) -> None:
        for row in rows:
            self.best[row["seed"]] = max(self.best[row["seed"]], row.get("return_mean", 0.0))

    def allowance(self, iteration: int) -> int:
        return 0 if min(self.best.values()) > 475 else 16


@pytest.mark.parametrize("arm", ["ppo", "sauna"])
@pytest.mark.slow
def test_ten_members_solve_cartpole(arm: str) -> None:
    """As Gymnasium defines it: 475 on average over 100 episodes; every member, within 2e5 steps."""
    recorder = UntilSolved()
    train_members(make_job("gymnax/CartPole-v1", arm=arm, **CARTPOLE), recorder)
    assert min(recorder.best.values()) > 475, recorder.best


@slow
@pytest.mark.parametrize("env", ["playground/CheetahRun", "sauna/HumanoidFlagrunHarder-v0"])
def test_a_simulated_robot_trains_for_a_few_iterations(env: str, tmp_path: Path) -> None:
    """As a user would; XLA does not optimise, which would take longer than the training."""
    run = tmp_path / "run"
    command = [
        sys.executable,
        "-m",
        "sauna",
        "train",
        env,
        "--threshold",
        "0.9",
        "--envs",
        "4",
        "--rollout-steps",
        "8",
        "--minibatches",
        "2",
        "--hidden",
        "8",
        "--steps",
        "128",
        "--epochs",
        "2",
        "--reset",
        "cached",
        "--backend",
        "device",
        "--out",
        str(run),
    ]
    fast = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    variables = {**os.environ, "XLA_FLAGS": fast}
    done = subprocess.run(command, env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "compiled in" in done.stdout
    rows = run_directory.rows(run)
    assert 32 < rows[-1]["env_steps"] <= 128
    assert all(np.isfinite(row["value_loss"]) for row in rows)
