"""The preset of a training that names none."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

import sauna
from sauna import cli
from sauna.config.presets import resolve
from sauna.system.errors import BadInput
from sauna.training import pick as module
from sauna.training.pick import pick


def test_a_known_environment_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "look_at", None)
    picked = pick({"env": "LunarLander-v3", "seeds": 3})
    assert picked.overrides == {"env": "LunarLander-v3", "seeds": 3, "preset": "auto"}
    assert picked.found is None and picked.said == (
        "preset lunar-lander for LunarLander-v3 (RL Zoo's numbers), 1,000,000 env steps; "
        "--preset names another"
    )
    assert "env steps" not in pick({"env": "LunarLander-v3", "steps": 10_000}).said


@pytest.mark.parametrize(
    "env, kwargs, preset, why",
    [
        ("small_envs:Scripted", {}, "mujoco", "its actions are continuous"),
        ("small_envs:GoodAction", {}, "discrete", "its actions are discrete"),
        ("small_envs:Picture", {}, "pictures", "it is seen in pictures"),
        ("small_envs:Board", {}, "discrete", "its actions are discrete"),
        ("Taxi-v4", {"max_episode_steps": 2000}, "long-horizon", "last up to 2,000 steps"),
    ],
)
def test_an_unknown_environment_is_looked_at_once(env, kwargs, preset, why) -> None:
    picked = pick({"env": env, "env_kwargs": kwargs, "preset": None})
    assert picked.overrides["preset"] == preset
    assert why in picked.said and "--preset names another" in picked.said
    assert picked.found is not None
    resolve(picked.overrides)


def test_what_names_its_settings_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "look_at", None)
    for given in (
        {"env": "CartPole-v1", "preset": "mujoco"},
        {"env": "CartPole-v1", "algorithm": "a2c"},
        {"env": ""},
        {},
    ):
        assert pick(given) == module.Picked(given)
    several = {"env": "small_envs:Scripted", "distributed": "localhost:1,2,0"}
    assert pick(several) == module.Picked({**several, "preset": "mujoco"})


def test_a_mistake_is_found_before_the_environment_is_made() -> None:
    for wrong, said in (
        ({"env": "small_envs:Raising", "gama": 1}, "unknown key 'gama'"),
        ({"env": "small_envs:Raising", "arm": "suana"}, "did you mean 'sauna'"),
        ({"env": "nowhere:it"}, "cannot import 'nowhere'"),
    ):
        with pytest.raises(BadInput, match=said):
            pick(wrong)


def test_both_interfaces_pick_and_say_so(monkeypatch, capsys, tmp_path) -> None:
    started: list[dict] = []
    (tmp_path / "config.json").touch()

    def start(overrides, display, *more):
        started.append(overrides)
        return SimpleNamespace(path=tmp_path)

    monkeypatch.setattr("sauna.training.run.start", start)
    monkeypatch.setattr("sauna.api.train_and_draw", lambda *_, **__: None)
    sauna.train("CartPole-v1", batch_size=128)
    cli.main(["train", "CartPole-v1", "--batch-size", "128"])
    said = "preset cartpole for CartPole-v1 (RL Zoo's numbers), 100,000 env steps"
    assert capsys.readouterr().out.count(said) == 2
    assert started == [{"env": "CartPole-v1", "preset": "auto", "minibatches": 2}] * 2
    sauna.train("CartPole-v1", preset="mujoco", quiet=True)
    assert started[-1] == {"env": "CartPole-v1", "preset": "mujoco"}
    assert "preset" not in capsys.readouterr().out
    file = tmp_path / "tuned.json"
    file.write_text(json.dumps({"env": "CartPole-v1", "preset": "auto", "gamma": 0.9}))
    cli.main(["train", "--config", str(file)])
    expected = f"the settings of {file} over preset cartpole for CartPole-v1 (RL Zoo's numbers)"
    assert expected in capsys.readouterr().out and started[-1]["gamma"] == 0.9
