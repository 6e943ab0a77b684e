"""EnvPool, PettingZoo and Gymnasium's own vector environments; the first two are extras."""

from __future__ import annotations

import numpy as np
import pytest

from helpers import make_job, train_here
from sauna.envs.host.parallel_envs import ParallelEnvs
from sauna.envs.host.vector_envs import VectorEnvs
from sauna.envs.make import in_process_envs, make_env
from sauna.envs.probe import probe
from sauna.system.errors import BadInput

SEEDS = [(0, 0), (0, 1), (3, 0)]
LIMIT = 0.2095  # of CartPole's angle, in rad: 12 degrees


@pytest.mark.parametrize(
    "env",
    ["make_vec/CartPole-v1", pytest.param("envpool/CartPole-v1", marks=pytest.mark.slow)],
)
def test_cartpole_in_rows_ends_beyond_its_limits_and_counts_its_steps(env: str) -> None:
    """Both reset in the step after an end; what had been reached is beyond the angle's limit."""
    if env.startswith("envpool"):
        pytest.importorskip("envpool", reason="needs `pip install 'sauna-rl[envpool]'`")
    envs = in_process_envs(env, {}, SEEDS, "auto")
    assert isinstance(envs, VectorEnvs)
    first, rng, ends = envs.reset(), np.random.default_rng(0), 0
    taken, earned = np.zeros(3), np.zeros(3)
    for _ in range(150):
        idle = envs.waiting.copy()
        step = envs.step(rng.integers(0, 2, (3, 1)).astype(np.int32), np.ones(3, bool))
        taken, earned = taken + ~idle, earned + step.reward
        assert (np.abs(step.observation[~envs.waiting, 2]) <= LIMIT).all()
        for row in np.flatnonzero(step.terminated).tolist():
            reached = np.abs(step.final_observation[row])
            assert (reached[2] > LIMIT or reached[0] > 2.4) and taken[row] == earned[row] > 5
            taken[row] = earned[row] = 0.0
            ends += 1
    assert ends > 5
    envs.close()
    again = in_process_envs(env, {}, SEEDS, "auto")
    np.testing.assert_array_equal(again.reset(), first)
    assert not np.array_equal(first[0], first[2])
    again.close()


def test_envpool_has_no_such_environment_or_is_not_installed(monkeypatch) -> None:
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"envpool/CartPole-v1 needs .*sauna-rl\[envpool\]"):
        make_env("envpool/CartPole-v1", {})
    with pytest.raises(BadInput, match=r"needs .*sauna-rl\[pettingzoo\]"):
        make_env("pettingzoo/sisl/pursuit_v5", {})


@pytest.mark.slow
def test_rows_in_processes_of_their_own_are_those_of_one_process() -> None:
    found = []
    for mode in ("sync", "async"):
        kwargs = {"vectorization_mode": mode, "max_episode_steps": 5}
        envs = in_process_envs("make_vec/Pendulum-v1", kwargs, [(0, 0), (0, 1)], "auto")
        seen = [envs.reset()]
        for _ in range(12):
            step = envs.step(np.full((2, 1), 0.5, np.float32), np.ones(2, bool))
            seen += [step.observation.copy(), step.final_observation.copy()]
        assert not envs.waiting.any() and seen[-1].any()
        found.append(np.stack(seen))
        envs.close()
    np.testing.assert_array_equal(*found)


@pytest.mark.slow
def test_envpool_trains() -> None:
    pytest.importorskip("envpool", reason="needs `pip install 'sauna-rl[envpool]'`")
    rows = train_here(make_job("envpool/CartPole-v1", arm="gigaflow", envs=4)).rows
    assert rows[-1]["episodes"] > 1 and not any(name.startswith("info_") for name in rows[-1])


@pytest.mark.slow
def test_a_game_of_pettingzoo_trains_and_leavers_are_counted_right() -> None:
    pytest.importorskip("pettingzoo", reason="needs `pip install 'sauna-rl[pettingzoo]'`")
    env, kwargs = "pettingzoo/sisl/pursuit_v5", {"n_pursuers": 3, "max_cycles": 20}
    found = probe(env, kwargs)
    assert found.group == 3 and found.differs is None
    assert isinstance(in_process_envs(env, kwargs, SEEDS, "auto"), ParallelEnvs)
    job = make_job(env, arm="ppo", envs=3, env_kwargs=kwargs, eval_every=96, eval_episodes=1)
    rows = train_here(job).rows
    assert {n for row in rows for n in row["episode_lengths"]} == {20}
    assert "eval_return_mean" in rows[-1]
    with pytest.raises(BadInput, match="no parallel environment of PettingZoo"):
        make_env("pettingzoo/sisl/persuit_v5", {})
