"""The numbers of `info` at the end of episodes, which become metrics."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from helpers import make_job, resumed, train_here
from sauna.envs.device.contract import numbers_in
from sauna.envs.info import numbers_of


def test_single_finite_numbers_are_taken_and_nothing_else() -> None:
    taken = {
        "bool": (True, 1.0),
        "int": (-3, -3.0),
        "numpy": (np.float32(0.5), 0.5),
        "jax": (jnp.asarray(2.0), 2.0),
        "one": (np.array([[7]]), 7.0),
        "true": (np.bool_(False), 0.0),
    }
    left = {
        "nan": np.nan,
        "inf": -np.inf,
        "text": "3",
        "none": None,
        "array": np.zeros(3),
        "empty": np.zeros(0),
        "list": [1.0],
        "dict": {"r": 1.0},
        "complex": 1j,
        "huge": 10**400,
        "life_lost": True,
        "a\nb": 1.0,
        "x" * 101: 1.0,
        "": 1.0,
        "\ud800": 1.0,
        7: 1.0,
    }
    given = {name: value for name, (value, _) in taken.items()}
    assert numbers_of({**given, **left}) == {name: number for name, (_, number) in taken.items()}
    assert numbers_of(None) == numbers_of({}) == {}
    assert {n: float(x) for n, x in numbers_in({**given, **left}).items()} == numbers_of(given)


@pytest.mark.parametrize(
    "env, settings",
    [
        ("small_envs:Informative", {"arm": "sauna"}),
        ("small_envs:Informative", {"arm": "ppo", "envs": 2, "env_processes": 2}),
        ("jax_envs:informative", {"arm": "ppo", "backend": "device", "device": "cpu", "envs": 2}),
    ],
)
def test_rows_hold_the_means_over_the_episodes_that_ended(env: str, settings: dict) -> None:
    job = make_job(env, **settings)
    whole = train_here(job)
    for row in whole.rows:
        lengths = row["episode_lengths"]
        assert lengths and row["info_length"] == pytest.approx(np.mean(lengths), rel=1e-6)
        assert row["success_rate"] == pytest.approx(np.mean(np.array(lengths) % 2 == 0), rel=1e-6)
        assert [name for name in row if name.startswith("info_")] == ["info_length"]
    if settings["arm"] == "sauna":
        first = train_here(job, stop=1)
        assert first.rows + train_here(resumed(job, first)).rows == whole.rows


def test_rows_without_numbers_of_info_are_as_before() -> None:
    rows = train_here(make_job("small_envs:Scripted", arm="ppo")).rows
    assert not [name for row in rows for name in row if "info" in name or "success" in name]
