"""Rows that are stepped together: vector environments in each mode, and agents."""

from __future__ import annotations

import numpy as np
import pytest

import vector_envs
from helpers import equal, make_job, resumed, train_here
from sauna.algorithm.rollout.host import HostCollector
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs
from sauna.envs.host.parallel_envs import AgentsAsOne, ParallelEnvs
from sauna.envs.host.vector_envs import OneRow, VectorEnvs
from sauna.envs.make import in_process_envs, make_env
from sauna.envs.probe import probe
from sauna.system.errors import BadInput

SEEDS = [(0, 0), (0, 1), (7, 0), (7, 1)]
MODES = ["same", "later", "never"]


def streams(envs, actions: np.ndarray, steps: int) -> list[list[tuple]]:
    """What each row's own steps gave, whose k-th action is `actions[row, k]`."""
    rows = len(actions)
    seen, found, taken = envs.reset(), [[] for _ in range(rows)], np.zeros(rows, int)
    for _ in range(steps):
        idle = np.zeros(rows, bool) if envs.waiting is None else envs.waiting.copy()
        given = actions[np.arange(rows), taken][:, None]
        step = envs.step(given, np.ones(rows, bool))
        for row in np.flatnonzero(~idle):
            ended = bool(step.terminated[row] or step.truncated[row])
            final = step.final_observation[row].tolist() if ended else None
            flags = bool(step.terminated[row]), bool(step.truncated[row])
            info = step.info.get(row)
            found[row].append((seen[row].tolist(), step.reward[row], *flags, final, info))
            taken[row] += 1
        assert not step.reward[idle].any() and not step.terminated[idle].any()
        seen = step.observation.copy()
    return found


@pytest.mark.parametrize("mode", MODES)
def test_every_autoreset_mode_gives_the_steps_of_single_environments(mode: str) -> None:
    """With the true final observation of each episode; two members of two rows each."""
    actions = np.random.default_rng(0).integers(0, 2, (4, 40)).astype(np.int32)
    one_by_one = GymnasiumEnvs(vector_envs.Counting, SEEDS)
    expected = streams(one_by_one, actions, 40)
    envs = in_process_envs(f"vector_envs:{mode}", {}, SEEDS, "auto")
    assert isinstance(envs, VectorEnvs)
    for got, row in zip(streams(envs, actions, 40), expected, strict=True):
        assert got == row[: len(got)] and len(got) >= 30
        assert any(step[2] for step in got) and any(step[3] for step in got)
    if mode != "later":
        assert envs.waiting is not None and not envs.waiting.any()
    shown = envs.start_after(2, envs.snapshot(2))
    assert shown == [0.0] and envs.snapshot(2)["episode"] == envs.snapshot(3)["episode"] == 1


@pytest.mark.parametrize("mode", MODES)
def test_a_vector_environment_of_one_row_is_a_plain_one(mode: str) -> None:
    env = make_env(f"vector_envs:{mode}", {})
    assert isinstance(env, OneRow)
    assert env.reset(seed=3)[0] == [0.0]
    for t in range(1, 6):
        seen, reward, terminated, truncated, info = env.step(0)
        assert (seen.tolist(), reward) == ([float(t)], 10.0 * (t - 1))
        assert (terminated, truncated, info["is_success"]) == (False, t == 5, float(t == 3))
    assert env.reset()[0] == [0.0]
    found = probe(f"vector_envs:{mode}", {})
    assert found.group == 0 and "row by row" in str(found.differs)


def test_a_vector_environment_that_cannot_be_used_is_refused_in_a_line() -> None:
    with pytest.raises(BadInput, match="2 rows instead of 3"):
        in_process_envs("vector_envs:two_always", {}, [(0, n) for n in range(3)], "auto")
    with pytest.raises(BadInput, match="does not say how it begins episodes"):
        make_env("vector_envs:nameless", {})
    for settings, words in (
        ({"env_processes": 1}, "env_processes: not read by vector_envs:same"),
        ({"arm": "sauna"}, "dropped: --dropped replace needs"),
    ):
        with pytest.raises(BadInput, match=words):
            make_job("vector_envs:same", **{"arm": "ppo", **settings})
    with pytest.raises(BadInput, match=r"mode NEXT_STEP.*use mode SAME_STEP"):
        make_job("vector_envs:later", arm="sauna", dropped="mask")
    make_job("vector_envs:same", arm="sauna", dropped="mask")
    with pytest.raises(BadInput, match="Gymnasium knows no 'Nowhere-v0'"):
        make_env("make_vec/Nowhere-v0", {})


def test_void_steps_are_neither_learned_from_nor_counted(monkeypatch) -> None:
    """A rollout of mode NEXT_STEP: the row after an end is not valid; a time limit bootstraps."""
    kept, collect = [], HostCollector.collect

    def watched(self, params, *rest):
        found = collect(self, params, *rest)
        copies = [type(c.rollout)(*(np.array(x) for x in c.rollout)) for c in found]
        kept.append((params.copy(), self, copies, found))
        return found

    monkeypatch.setattr(HostCollector, "collect", watched)
    settings = {"arm": "ppo", "envs": 2, "normalize_rewards": "no", "truncation": "bootstrap"}
    recorder = train_here(make_job("vector_envs:later", **settings, steps=192))
    counted = 0
    for (params, collector, (rollout,), (found,)), row in zip(kept, recorder.rows, strict=True):
        ended = rollout.terminated | rollout.truncated
        np.testing.assert_array_equal(~rollout.valid[1:], ended[:-1])
        assert not rollout.keep[~rollout.valid].any() and rollout.truncated.any()
        assert found.env_steps == rollout.valid.sum() < 64
        final = collector._values(params, np.full((1, 2, 1), 5.0), 0)
        assert not np.allclose(final, 0.0)
        for t, n in np.argwhere(rollout.truncated).tolist():
            assert abs(rollout.next_value[t, n] - final[n]) < 0.1  # of moments a little older
        assert set(row["episode_lengths"]) <= {3, 5}
        counted += found.env_steps
        assert row["env_steps"] == counted
    lengths = [n for row in recorder.rows for n in row["episode_lengths"]]
    returns = [r for row in recorder.rows for r in row["episode_returns"]]
    for length, return_ in zip(lengths, returns, strict=True):
        base = 10.0 * sum(range(length))
        assert base <= return_ <= base + length


def test_agents_are_rows_and_one_that_leaves_waits_for_the_others() -> None:
    seeds = [(0, n) for n in range(6)]
    envs = in_process_envs("vector_envs:Agents", {}, seeds, "auto")
    assert isinstance(envs, ParallelEnvs)
    first = envs.reset()
    np.testing.assert_array_equal(first[:, 0], [0, 1, 2, 0, 1, 2])
    action, active = np.full((6, 1), 2, np.int32), np.ones(6, bool)
    waiting = []
    for t in range(1, 5):
        waiting.append(envs.waiting[:3].tolist())
        step = envs.step(action, active)
        ended = step.terminated | step.truncated
        np.testing.assert_array_equal(ended, np.tile([t == 2, t == 3, t == 4], 2))
        np.testing.assert_array_equal(step.truncated, np.tile([False, False, t == 4], 2))
        assert (step.final_observation[ended][:, 1:] == [t, 2]).all()
        np.testing.assert_array_equal(step.reward, np.where(np.tile(waiting[-1], 2), 0.0, 2.0))
        assert sorted(step.info) == np.flatnonzero(ended).tolist()
    assert waiting == [[False] * 3, [False] * 3, [True, False, False], [True, True, False]]
    np.testing.assert_array_equal(envs.step(action, active).observation[:, 1], [1] * 6)
    again = in_process_envs("vector_envs:Agents", {}, seeds, "auto")
    snapshots = [envs.snapshot(index) for index in range(6)]
    for index in range(6):
        seen = again.restore(index, snapshots[index])
        np.testing.assert_array_equal(seen, envs._observation[index])
    np.testing.assert_array_equal(again.waiting, envs.waiting)


def test_a_policy_of_agents_is_evaluated_on_all_of_them() -> None:
    env = make_env("vector_envs:Agents", {})
    assert isinstance(env, AgentsAsOne)
    seen, _ = env.reset(seed=1)
    assert seen.shape == (3, 3)
    rewards, shapes = [], []
    for _ in range(4):
        seen, reward, terminated, truncated, info = env.step(np.array([1] * len(seen)))
        rewards.append(reward * 3)
        shapes.append(len(seen))
    assert (rewards, shapes) == ([3, 3, 2, 1], [3, 2, 1, 1])
    assert (terminated, truncated, info) == (False, True, {"is_success": 1.0})


@pytest.mark.slow
def test_agents_train_and_resume_exactly() -> None:
    settings = {"arm": "ppo", "envs": 3, "rollout_steps": 24, "minibatches": 2, "eval_every": 72}
    job = make_job("vector_envs:Agents", **settings, eval_episodes=1, steps=216)
    whole, first = train_here(job), train_here(job, 1)
    again = train_here(resumed(job, first))
    assert equal(again.final, whole.final) and first.rows + again.rows == whole.rows
    lengths = {n for row in whole.rows for n in row["episode_lengths"]}
    assert lengths == {2, 3, 4} and "eval_return_mean" in whole.rows[-1]


def test_a_function_with_its_own_number_of_envs_is_a_plain_environment() -> None:
    env = make_env("vector_envs:numbered", {"num_envs": 3})
    assert isinstance(env, vector_envs.Counting)


def test_agents_are_refused_what_they_cannot_do() -> None:
    with pytest.raises(BadInput, match="envs: 2 is no multiple of the 3 agents"):
        make_job("vector_envs:Agents", arm="ppo", envs=2)
    with pytest.raises(BadInput, match="recurrent: a policy of several agents"):
        make_job("vector_envs:Agents", arm="ppo", envs=3, minibatches=2, recurrent="gru")
    with pytest.raises(BadInput, match="filter cannot pass over agents that wait"):
        make_job("vector_envs:Agents", arm="sauna", envs=3, dropped="mask")
    with pytest.raises(BadInput, match="agent b has another observation space than a"):
        make_job("vector_envs:Agents", arm="ppo", envs=3, env_kwargs='{"wide": true}')
