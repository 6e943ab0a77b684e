"""Which preset an environment gets by its name, and that every preset of the zoo can be trained."""

from __future__ import annotations

import dataclasses

import pytest

from command_line import sauna_here
from sauna.config.presets import PRESETS, arm_config, overrides_of, resolve, resolve_run
from sauna.config.settings import Config
from sauna.config.task_presets import TASK_PRESET_HELP, TASK_PRESETS
from sauna.config.zoo import (
    AUTO,
    ENVS,
    PUBLISHED,
    ZOO,
    entry_of,
    preset_of_spaces,
    row_of,
    shown_published,
)
from sauna.system.errors import BadInput

# The environment, its preset, and the env steps and numbers that RL Zoo publishes for it.
PICKED = [
    ("CartPole-v1", "cartpole", 100_000, {"gamma": 0.98, "gae_lambda": 0.8, "epochs": 20}),
    ("Acrobot-v1", "acrobot", 1_000_000, {"envs": 16, "gae_lambda": 0.94}),
    ("MountainCar-v0", "mountain-car", 1_000_000, {"rollout_steps": 16, "gae_lambda": 0.98}),
    ("Pendulum-v1", "pendulum", 100_000, {"gamma": 0.9, "learning_rate": 1e-3}),
    ("LunarLander-v3", "lunar-lander", 1_000_000, {"gamma": 0.999, "entropy_coef": 0.01}),
    ("LunarLanderContinuous-v3", "lunar-lander", 1_000_000, {"gae_lambda": 0.98}),
    ("BipedalWalker-v3", "bipedal-walker", 5_000_000, {"clip_range": 0.18, "envs": 32}),
    ("BipedalWalkerHardcore-v3", "bipedal-walker-hardcore", 100_000_000, {"gamma": 0.99}),
    ("CarRacing-v3", "car-racing", 200_000, {"distribution": "beta"}),
    ("Swimmer-v5", "swimmer", 1_000_000, {"gamma": 0.9999, "rollout_steps": 2048}),
    ("InvertedDoublePendulum-v5", "inverted-double-pendulum", 1_000_000, {"epochs": 5}),
    ("HalfCheetah-v5", "half-cheetah", 1_000_000, {"epochs": 20, "hidden": (256, 256)}),
    ("ALE/Pong-v5", "atari", 10_000_000, {"sign_rewards": True}),
    ("gymnax/Breakout-MinAtar", "minatar", 10_000_000, {"envs": 64}),
    ("gymnax/CartPole-v1", "cartpole", 100_000, {}),
    ("playground/CheetahRun", "playground", 60_000_000, {"gamma": 0.995}),
    ("MiniGrid-DoorKey-5x5-v0", "minigrid", 100_000, {"rollout_steps": 128}),
    ("MiniGrid-FourRooms-v0", "minigrid-long", 5_000_000, {"rollout_steps": 512}),
    ("PointMaze_UMazeDense-v3", "robotics", 1_000_000, {}),
    ("gymnasium_robotics:FetchReachDense-v4", "robotics", 200_000, {}),
]


@pytest.mark.parametrize("env, preset, steps, numbers", PICKED, ids=[row[0] for row in PICKED])
def test_auto_is_the_preset_of_the_environment(env, preset, steps, numbers) -> None:
    config = resolve({"env": env, "preset": AUTO})
    assert (config.preset, config.steps) == (preset, steps)
    assert {name: getattr(config, name) for name in numbers} == numbers
    named = resolve({"env": env, "preset": preset, "steps": steps})
    assert config == named
    assert resolve({"env": env, "preset": AUTO, "steps": 200_000}).steps == 200_000


def test_mujoco_is_what_it_was() -> None:
    for name in (env for env in ENVS if (entry := entry_of(env)) and entry.preset == "mujoco"):
        assert resolve({"env": name, "preset": AUTO}) == resolve({"env": name})
    assert sum(row_of(env)[1] == "mujoco" for env in ENVS) == 8


@pytest.mark.parametrize("env", ENVS)
def test_every_environment_of_the_zoo_can_be_resolved_with_every_kind_of_arm(env: str) -> None:
    config = resolve({"env": env, "preset": AUTO})
    samples = config.envs * config.rollout_steps
    assert samples % config.minibatches == 0 and config.steps >= 4 * samples
    for arm in ("sauna", "gigaflow", "avec"):
        resolve({"env": env, "preset": AUTO, "arm": arm})


def test_what_rl_zoo_publishes_is_of_environments_that_the_zoo_has() -> None:
    assert set(PUBLISHED) <= set(ENVS)
    assert {entry.preset for entry in ZOO} <= set(PRESETS)
    assert shown_published("CartPole-v1") == "500.0 +- 0.0"
    assert shown_published("MiniGrid-Unlock-v0") == "0.963 +- 0.016"
    assert shown_published("Humanoid-v5") == ""


def test_presets_of_tasks_are_registered_and_only_name_fields() -> None:
    fields = {field.name for field in dataclasses.fields(Config)}
    assert set(TASK_PRESETS) == set(TASK_PRESET_HELP) <= set(PRESETS)
    for settings in TASK_PRESETS.values():
        assert set(settings) <= fields


@pytest.mark.parametrize(
    "env", ["CartPole", "MyCartPole-v1", "CartPole-v1x", "my_envs:CartPole", "sauna.local:CartPole"]
)
def test_other_names_are_not_in_the_zoo(env: str) -> None:
    assert entry_of(env) is None and row_of(env) == ()
    with pytest.raises(BadInput, match=r"preset: the zoo knows no .* by its spaces"):
        resolve({"env": env, "preset": AUTO})


def test_auto_leaves_another_algorithm_alone() -> None:
    a2c = {"env": "CartPole-v1", "algorithm": "a2c", "preset": AUTO}
    assert resolve(a2c) == resolve({"env": "CartPole-v1", "algorithm": "a2c"})


def test_an_unknown_algorithm_is_refused_by_its_name() -> None:
    done = sauna_here("train", "CartPole-v1", "--arm", "sauna", "--algorithm", "a2c_")
    known = "unknown value 'a2c_' (known: ppo, a2c); did you mean 'a2c'?"
    assert (done.returncode, done.stderr) == (2, f"sauna: algorithm: {known}\n")


def test_nothing_but_auto_looks_into_the_zoo() -> None:
    config = resolve({"env": "CartPole-v1"})
    assert (config.preset, config.steps, config.envs) == ("mujoco", 1_000_000, 1)
    assert arm_config("ppo", {"preset": AUTO}).preset == "mujoco"  # no environment is known


def test_a_run_of_auto_is_repeated_by_the_name_of_its_preset() -> None:
    run = resolve_run({"env": "LunarLander-v3", "preset": AUTO, "arm": "ppo"})
    again = overrides_of(run)
    assert again["preset"] == "lunar-lander"
    assert resolve_run(again) == run


@pytest.mark.parametrize(
    "pictures, discrete, time_limit, preset, why",
    [
        (True, True, 5000, "pictures", "pictures"),
        (False, True, 1600, "long-horizon", "up to 1,600 steps"),
        (False, False, 1001, "long-horizon", "up to 1,001 steps"),
        (False, True, 1000, "discrete", "actions are discrete"),
        (False, True, None, "discrete", "actions are discrete"),
        (False, False, 1000, "mujoco", "actions are continuous"),
    ],
)
def test_a_preset_for_spaces(pictures, discrete, time_limit, preset, why) -> None:
    picked, said = preset_of_spaces(pictures, discrete, time_limit)
    assert picked == preset and said.endswith(why)
