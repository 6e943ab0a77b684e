"""What `sauna record` plays and hands on; the files are tests/training/data's."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import sauna
from helpers import SMALL
from sauna.experiments import record as recording
from sauna.system.errors import BadInput
from sauna.training.data.episodes import Recorded

SETTINGS = {**SMALL, "processes": 1, "arm": "ppo", "steps": 64, "seeds": 2}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "run"
    sauna.train("small_envs:Endless", quiet=True, out=path, **SETTINGS)
    return path


@pytest.fixture
def kept(monkeypatch) -> list[Recorded]:
    """What is written, in place of a file."""
    found: list[Recorded] = []

    @contextmanager
    def writer(to, env, about, wrapping):
        yield found.append

    monkeypatch.setattr(recording, "_writer", writer)
    return found


@pytest.mark.parametrize("deterministic", [False, True])
def test_the_episodes_are_those_of_an_evaluation(run, kept, deterministic) -> None:
    how = {"episodes": 3, "deterministic": deterministic, "seed": 7, "member": "ppo/1"}
    found = sauna.record(run, "a.parquet", **how, say=lambda text: None, max_steps=40)
    expected = sauna.evaluate(run, **how, say=lambda text: None, max_steps=40)["members"]["ppo/1"]
    assert [float(one.reward.sum()) for one in kept] == expected["returns"] == found["returns"]
    assert [len(one.reward) for one in kept] == expected["lengths"]
    assert found["env_steps"] == sum(expected["lengths"])
    assert [one.seed for one in kept] == [7, 8, 9]
    for one in kept:
        assert len(one.observation) == len(one.action) + 1
        assert one.terminated or one.truncated  # also where it was cut
    assert found["mode"] in recording.report(found) and "seeds 7 to 9" in recording.report(found)


def test_each_observation_is_the_one_before_its_action(run, kept) -> None:
    """Playing the actions again gives the same observations."""
    from sauna.envs.make import make_env

    sauna.record(run, "a.parquet", episodes=1, say=lambda text: None, max_steps=20)
    env = make_env("small_envs:Endless", {})
    seen = [env.reset(seed=0)[0]]
    seen += [env.step(action)[0] for action in kept[0].action]
    np.testing.assert_array_equal(kept[0].observation, np.stack(seen))


@pytest.mark.parametrize("by", ["info", "method"])
def test_masks_are_recorded_beside_the_observations(tmp_path, kept, by) -> None:
    """Playing the actions again gives the same masks, in which each action is valid."""
    from sauna.envs.make import make_env

    kwargs = {"several": True, "by": by}
    settings = {**SETTINGS, "env_kwargs": kwargs, "action_mask": True, "seeds": 1}
    sauna.train("small_envs:Choosy", quiet=True, out=tmp_path / "run", **settings)
    sauna.record(tmp_path / "run", "a.parquet", episodes=2, say=lambda text: None)
    env = make_env("small_envs:Choosy", kwargs)
    for seed, one in enumerate(kept):
        seen, masks = [env.reset(seed=seed)[0]], [env.valid]
        for action in one.action:
            seen.append(env.step(action)[0])  # which raises at an action that is not valid
            masks.append(env.valid)
        np.testing.assert_array_equal(one.observation, np.stack(seen))
        assert one.mask is not None and one.mask.shape == (len(one.action) + 1, 5)
        np.testing.assert_array_equal(one.mask[:-1], np.stack(masks)[:-1])
        assert one.mask[-1].all() and not one.mask[:-1].all()


def test_what_cannot_be_recorded_is_refused(run, tmp_path) -> None:
    for to, more, message in (
        ("a.csv", {}, "neither minari:NAME nor a file that ends in .parquet"),
        ("a.parquet", {"episodes": 0}, "episodes: must be a whole number of at least 1, not 0"),
        ("a.parquet", {"member": "ppo/7"}, "unknown member 'ppo/7'"),
        ("a.parquet", {"env": "small_envs:Scripted"}, "has other spaces than the run"),
    ):
        with pytest.raises(BadInput, match=message):
            sauna.record(run, tmp_path / to, **more)
    assert list(tmp_path.iterdir()) == []
