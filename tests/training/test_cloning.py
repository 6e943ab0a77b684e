"""A run that starts from clones of recorded episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
import small_envs
from helpers import SMALL, equal, make_job, policy_output, train_here
from sauna.algorithm.policy.bounded import to_env
from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import make_policy
from sauna.envs.spaces import Spaces, describe, observation_reader
from sauna.system import run_directory
from sauna.system.checkpoint import under
from sauna.system.errors import BadInput
from sauna.training import cloning
from sauna.training.data.episodes import Demonstrations, Stored, demonstrations
from sauna.training.initial import read_initial
from sauna.training.prepare import prepare
from threads import trained_here

NAME = "data:episodes.parquet"
CLONING = {"init_from": NAME, "clone_epochs": 3}
SETTINGS: dict[str, Any] = {**SMALL, "arm": "ppo", "processes": 1, "seeds": 2, **CLONING}
ENV, CHOICES = "small_envs:Scripted", "small_envs:MatchingAction"


def played(env: str, number: int = 12, length: int = 20) -> list[Stored]:
    """Episodes whose action is the sign of the first observation; some are terminated."""
    made, found = getattr(small_envs, env.partition(":")[2])(), []
    generator = np.random.default_rng(0)
    for episode in range(number):
        seen = generator.normal(size=(length + 1, *made.observation_space.shape)) + episode
        right = seen[:-1, 0] > number / 2
        if isinstance(made.action_space, small_envs.spaces.Discrete):
            action = right.astype(np.int64)
        else:
            action = np.repeat(np.where(right, 0.5, -0.5)[:, None], 2, 1)
        found.append(Stored(seen[:-1], seen[-1], action, seen[1:, 0], episode % 2 == 0))
    return found


def data_of(env: str, episodes: list[Stored] | None = None) -> Demonstrations:
    made = getattr(small_envs, env.partition(":")[2])()
    spaces = describe(made.observation_space, made.action_space)
    return demonstrations(episodes or played(env), spaces, made.action_space, False, NAME)


@pytest.fixture(autouse=True)
def data(monkeypatch) -> None:
    """Of the run's own environment, in place of a file."""
    monkeypatch.setattr(cloning, "_read", lambda prepared: data_of(prepared.config.env))


def initial(env: str, say: Any = print, **more: Any) -> tuple[dict[str, np.ndarray], dict]:
    found = read_initial(prepare({"env": env, **SETTINGS, **more}), say, False)
    assert found is not None
    return found


@pytest.mark.parametrize("env", [ENV, CHOICES])
def test_members_start_with_the_clones_weights_and_the_datas_statistics(env: str) -> None:
    said: list[str] = []
    arrays, origin = initial(env, said.append, init_normalizer="kept")
    job = make_job(env, **{n: v for n, v in SETTINGS.items() if n not in CLONING})
    state = train_here(job._replace(initial=arrays), stop=0).final
    fresh = train_here(job, stop=0).final
    data = data_of(env)
    seen = np.concatenate([data.observation, data.final])
    for member in ("ppo/0", "ppo/1"):
        own = under(f"{member}/", state)
        assert equal(under("params/", own), under(f"{member}/params/", arrays))
        assert not equal(under("params/", own), under(f"{member}/params/", fresh))
        np.testing.assert_allclose(own["observation_moments/mean"], seen.mean(0))
        np.testing.assert_allclose(own["observation_moments/variance"], seen.var(0))
        assert own["observation_moments/count"] == len(seen) == 12 * 21
        held = origin["members"][member]
        assert held["held_out"]["log_likelihood"] > held["before"]["log_likelihood"]
        assert (held["held_out_episodes"], held["held_out_steps"]) == (1, 20)
    assert not equal(under("ppo/0/params/", state), under("ppo/1/params/", state))
    assert (origin["episodes"], origin["env_steps"]) == (12, 240)
    assert len(said) == 2 and said[0].startswith(f"ppo/0: cloned {NAME} (12 episodes, 240 env")
    word = "accuracy" if env == CHOICES else "explained variance of actions"
    assert word in said[0] and "log-likelihood" in said[0] and "loss" in said[0]


@pytest.mark.parametrize("distribution", ["squashed", "beta", "gsde"])
def test_every_distribution_of_actions_is_fitted(distribution: str, monkeypatch) -> None:
    """Recorded actions are 0.9 or -0.9; of numbers before a tanh these would be 0.72."""
    data = data_of(ENV)
    data = data._replace(action=1.8 * data.action)
    monkeypatch.setattr(cloning, "_read", lambda prepared: data)
    fast = {"clone_epochs": 20, "clone_learning_rate": 0.03}
    arrays, origin = initial(ENV, distribution=distribution, seeds=1, **fast)
    own = under("ppo/0/observation_moments/", arrays)
    seen = normalize(Moments(**own), data.observation, 10.0)
    job = make_job(ENV, arm="ppo", distribution=distribution)
    output = policy_output(job, arrays, "ppo/0", seen)
    made = make_policy(job.config, job.spaces).distribution
    action = to_env(made, np.asarray(made.mode(output.policy)))
    assert abs(np.median(np.abs(action)) - 0.9) < 0.12
    assert (np.sign(action) == np.sign(data.action)).mean() > 0.8
    held = origin["members"]["ppo/0"]["held_out"]
    assert held["agreement"] == 0.0  # of one episode of equal actions, but for their rounding


def test_pictures_beside_numbers_are_cloned_and_have_no_moments(monkeypatch) -> None:
    env, number = small_envs.Camera(), 9
    spaces, read = (
        describe(env.observation_space, env.action_space),
        observation_reader(env.observation_space),
    )
    env.observation_space.seed(0)
    episodes = []
    for _ in range(12):
        seen = np.stack([read(env.observation_space.sample()) for _ in range(number)])
        seen[:, 2:] = 100  # the picture, behind the numbers
        action = (seen[:-1, 0] > 0).astype(np.int64)
        episodes.append(Stored(seen[:-1], seen[-1], action, seen[1:, 0], True))
    data = demonstrations(episodes, spaces, env.action_space, False, NAME)
    monkeypatch.setattr(cloning, "_read", lambda prepared: data)
    settings = {"network": "mlp", "seeds": 1}
    arrays, origin = initial("small_envs:Camera", clone_learning_rate=0.01, **settings)
    numbers = np.concatenate([data.observation, data.final])[:, :2]
    np.testing.assert_allclose(arrays["ppo/0/observation_moments/mean"], numbers.mean(0))
    found = origin["members"]["ppo/0"]
    assert found["held_out"]["log_likelihood"] > found["before"]["log_likelihood"]
    plain = {name: value for name, value in SETTINGS.items() if name not in CLONING}
    job = prepare({"env": "small_envs:Camera", **plain, **settings}).job(None)
    state = train_here(job._replace(initial=arrays), stop=0).final
    assert equal(under("ppo/0/params/", state), under("ppo/0/params/", arrays))


def test_reward_moments_are_those_of_the_discounted_return() -> None:
    arrays, _ = initial(ENV, init_normalizer="kept", gamma=0.5, seeds=1)
    sums = []
    for episode in played(ENV):
        now = 0.0
        for reward in episode.reward:
            now = 0.5 * now + reward
            sums.append(now)
    for part, expected in (("mean", np.mean(sums)), ("variance", np.var(sums)), ("count", 240)):
        np.testing.assert_allclose(arrays[f"ppo/0/reward_moments/{part}"], expected, rtol=1e-4)


def test_a_clone_depends_on_its_own_seed_alone() -> None:
    both = initial(CHOICES, arm="ppo,sauna")[0]
    one = initial(CHOICES, seeds=[1])[0]
    assert not under("ppo/1/reward_moments/", one)
    for arm in ("ppo", "sauna"):
        assert equal(under(f"{arm}/1/", both), under("ppo/1/", one))


def test_a_resume_needs_the_data_no_more(tmp_path: Path, monkeypatch) -> None:
    run = tmp_path / "run"
    with trained_here():
        sauna.train(ENV, out=run, quiet=True, **SETTINGS)
        expected = (run / "metrics.jsonl").read_bytes()
        assert run_directory.read_config(run)["initial"]["env_steps"] == 240
        (run / "summary.json").unlink()
        (run / "checkpoints").rename(run / "killed-before-the-first")
        monkeypatch.delattr(cloning, "_read")
        sauna.resume(run, quiet=True)
    assert (run / "metrics.jsonl").read_bytes() == expected


def test_what_cannot_be_cloned_is_refused_in_a_line(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.undo()
    refused = {
        "one episode": (played(ENV)[:1], "1 episodes; at least 2 are needed"),
        "shape": (played(CHOICES), "its observations are of shape"),
        "nan": (
            [*played(ENV), played(ENV)[0]._replace(reward=np.full(20, np.nan))],
            "not every reward is finite",
        ),
    }
    for episodes, message in refused.values():
        monkeypatch.setattr(cloning, "read_parquet", lambda *given, e=episodes: e)
        with pytest.raises(BadInput, match=message):
            initial(ENV)
    fresh = {"init_normalizer": "fresh"}
    with pytest.raises(BadInput, match="fresh would show a clone what it was not fitted to"):
        initial(ENV, **fresh)
    seen, choice = np.zeros((20, 4)), np.zeros(20, int)
    seen[:, 1:3] = 1
    choice[7] = 2
    spaces = Spaces("vector", (4,), "discrete", (3,), (), (), mask=3)
    episodes = [Stored(seen, seen[0], choice, seen[:, 0], True)] * 2
    with pytest.raises(BadInput, match="the action of row 7 is not valid by its action_mask"):
        demonstrations(episodes, spaces, small_envs.spaces.Discrete(3), False, NAME)
    with pytest.raises(BadInput, match="clone_epochs: not read"):
        sauna.train(ENV, out=tmp_path / "run", quiet=True, **{**SETTINGS, "init_from": "RUN"})
    assert list(tmp_path.iterdir()) == []
