"""What is searched: reading it, its values, and the settings that they become."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import configured
from sauna.experiments.tune.population import drawn, explored
from sauna.experiments.tune.space import (
    DEFAULT,
    Range,
    default_space,
    fewest_minibatches,
    load_space,
    read_space,
    settings_of,
    start_of,
    traced,
)
from sauna.system.errors import BadInput


@pytest.mark.parametrize(
    "values, message",
    [
        ({}, "empty"),
        ({"learning_rat": [1e-3]}, "unknown key 'learning_rat'.*'learning_rate'"),
        ({"steps": [100]}, "steps is not searched"),
        ({"gamma": [0.9, 1.5]}, "at most 1"),
        ({"gamma": []}, "each choice once"),
        ({"gamma": [0.9, 0.9]}, "each choice once"),
        ({"gamma": 0.9}, "must be a list of choices"),
        ({"gamma": {"low": 0.9}}, "must be a list of choices"),
        ({"gamma": {"low": 0.9, "high": 0.9}}, "not below"),
        ({"entropy_coef": {"low": 0.0, "high": 0.1, "log": True}}, "log needs low above 0"),
        ({"activation": {"low": "relu", "high": "tanh"}}, "no number"),
        ({"batch_size": [0]}, "whole numbers of at least 1"),
        ({"epochs": [1.5]}, "whole number"),
    ],
)
def test_mistakes_in_a_space_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        read_space(values)


def test_a_file_is_read_and_code_that_it_names_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "space.toml"
    file.write_text("gamma = [0.9, 0.99]\nhidden = [[64, 64], [256]]\n")
    space = read_space(load_space(str(file), trust=False))
    assert space["hidden"].choices == ("64,64", "256")
    file.write_text('network = ["someone:net"]\n')
    with pytest.raises(BadInput, match="names code that would run"):
        load_space(str(file), trust=False)
    assert load_space(str(file), trust=True) == {"network": ["someone:net"]}
    with pytest.raises(BadInput, match="no file"):
        load_space(str(tmp_path / "none.toml"), trust=False)


def test_the_value_nearest_to_the_start() -> None:
    choices = Range("gamma", (0.9, 0.99))
    assert [choices.inside(v) for v in (0.99, 0.0, 0.96)] == [0.99, 0.9, 0.99]
    assert Range("hidden", ("64,64",)).inside((64, 64)) == "64,64"
    assert Range("hidden", ("64,64",)).inside((32,)) is None
    assert Range("epochs", (), 3, 20).inside(40) == 20
    assert Range("learning_rate", (), 1e-5, 1e-2, True).inside(0) == 1e-5


@pytest.mark.parametrize(
    "samples, size, number", [(128, 32, 4), (128, 1000, 1), (60, 32, 2), (96, 40, 3), (7, 3, 7)]
)
def test_minibatches_are_equal_and_no_larger_than_asked_for(samples, size, number) -> None:
    assert fewest_minibatches(samples, size) == number
    assert samples % number == 0 and samples // number <= size
    fewer = [n for n in range(1, number) if samples % n == 0]
    assert all(samples // n > size for n in fewer)


def test_a_batch_size_becomes_minibatches_of_the_rollout_that_is_searched() -> None:
    config = configured(envs=4, rollout_steps=32, minibatches=4)
    assert settings_of({"batch_size": 32}, config) == {"minibatches": 4}
    found = settings_of({"batch_size": 32, "rollout_steps": 64, "gamma": 0.9}, config)
    assert found == {"minibatches": 8, "rollout_steps": 64, "gamma": 0.9}
    assert start_of(read_space({"batch_size": [16, 32]}), config) == {"batch_size": 32}


def test_the_default_space_holds_what_the_algorithm_reads() -> None:
    assert set(read_space(DEFAULT)) == set(DEFAULT)
    ppo = default_space(configured(steps=100_000, envs=4))
    assert ppo["rollout_steps"] == [32, 64, 128, 256, 512, 1024, 2048]
    small = {"envs": 4, "rollout_steps": 32, "minibatches": 4}
    assert default_space(configured(steps=2_000, **small))["rollout_steps"] == [32]
    assert "rollout_steps" not in default_space(configured(steps=500, **small))
    a2c = default_space(configured(algorithm="a2c", preset="a2c", steps=100_000, arm="ppo"))
    assert not {"clip_range", "epochs", "batch_size"} & set(a2c)
    shared = traced(read_space(ppo))
    assert {"learning_rate", "gamma", "clip_range"} <= set(shared)
    assert not {"rollout_steps", "batch_size", "epochs", "hidden", "activation"} & set(shared)


def test_draws_and_changes_stay_in_the_range() -> None:
    draw = np.random.default_rng(0)
    rate = Range("learning_rate", (), 1e-5, 1e-2, True)
    values = [drawn(rate, draw) for _ in range(200)]
    assert min(values) >= 1e-5 and max(values) <= 1e-2
    assert 0.4 < np.mean(np.array(values) < 10**-3.5) < 0.6  # by the logarithm
    changed = np.array([explored(rate, 1e-3, draw) for _ in range(200)])
    assert changed.min() >= 1e-5 and changed.max() <= 1e-2
    factors = np.isclose(changed, 0.8e-3) | np.isclose(changed, 1.2e-3)
    assert 0.6 < factors.mean() < 0.9  # the rest is drawn anew
    assert {explored(rate, 1e-2, draw) for _ in range(50)} >= {1e-2, 0.8e-2}
    gamma = Range("gamma", (0.9, 0.95, 0.99, 0.999))
    beside = [explored(gamma, 0.95, draw) for _ in range(100)]
    assert set(beside) <= set(gamma.choices) and beside.count(0.9) + beside.count(0.99) > 60
