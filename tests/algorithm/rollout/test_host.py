"""Counting, budgets and ends, seen through whole trainings of a few iterations."""

from __future__ import annotations

import numpy as np
import pytest

from helpers import make_job, train_here
from oracles import RunningNormalizer
from sauna.algorithm.policy.normalize import (
    Moments,
    initial_moments,
    moments_after_each,
    normalize,
    scale_rewards,
    update_moments,
)
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.moments import ObservationMoments
from sauna.algorithm.rollout.program import make_program
from sauna.algorithm.types import member_keys
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs
from sauna.training.loop.budget import hypers_now
from sauna.training.loop.member_state import Counters
from small_envs import Board


@pytest.mark.parametrize(
    "arm, settings",
    [
        ("ppo", {}),
        ("sauna", {"threshold": 0.9}),
        ("sauna", {"threshold": 0.9, "dropped": "mask"}),
        ("random-drop", {"drop_rate": 0.4}),
        ("sauna-paper", {"threshold": 0.9}),
    ],
)
def test_no_arm_oversteps_the_budget_and_every_env_step_is_counted(arm: str, settings) -> None:
    job = make_job("small_envs:Scripted", arm=arm, envs=3, steps=1000, seeds=2, **settings)
    rows = train_here(job).rows
    for seed in (0, 1):
        own = [row for row in rows if row["seed"] == seed]
        steps = [row["env_steps"] for row in own]
        assert 1000 - 96 < steps[-1] <= 1000
        assert steps == sorted(set(steps))
        counted = sum(sum(row["episode_lengths"]) for row in own)
        assert counted <= steps[-1] < counted + 3 * 12  # what is missing are running episodes
        assert own[-1]["episodes"] == sum(len(row["episode_returns"]) for row in own)
        assert (own[-1]["kept_steps"] == steps[-1]) == (arm == "ppo")


def test_a_budget_of_kept_steps_acts_more_often() -> None:
    job = make_job("small_envs:Scripted", arm="sauna-reference", threshold=0.6, steps=320, seeds=1)
    last = train_here(job).rows[-1]
    assert last["kept_steps"] == 320 < last["env_steps"]


def test_the_learning_rate_falls_linearly_with_env_steps_or_not_at_all() -> None:
    rows = train_here(make_job("small_envs:Scripted", arm="ppo", learning_rate=0.5)).rows
    np.testing.assert_allclose([r["learning_rate"] for r in rows], [0.5, 0.375, 0.25, 0.125])
    settings = {"learning_rate": 0.5, "preset": "mujoco-release"}
    rows = train_here(make_job("small_envs:Scripted", arm="ppo", **settings)).rows
    assert {r["learning_rate"] for r in rows} == {0.5}


@pytest.mark.parametrize("arm", ["ppo", "sauna"])
def test_scores_given_while_acting_are_those_of_the_whole_rollout(arm: str) -> None:
    """A CNN gives log-probability, value and Vex with its actions; of each member its own."""
    job = make_job(
        "small_envs:Board", network="small-cnn", arm=arm, seeds=2, envs=3, rollout_steps=8
    )
    program, keys = make_program(job.config, job.spaces), [member_keys(seed) for seed in (0, 1)]
    envs = GymnasiumEnvs(Board, [(seed, n) for seed in (0, 1) for n in range(3)])
    collector = HostCollector(program, job.spaces, envs, keys)
    collector.start()
    params = np.stack([program.policy.init(key.init) for key in keys])
    hypers = [hypers_now(member.config, Counters()) for member in job.members]
    found = collector.collect(params, hypers, 0, np.array([8, 8]))
    for vector, other, one in zip(params, params[::-1], found, strict=True):
        rollout = one.rollout
        scores = np.stack([rollout.log_prob, rollout.value, rollout.vex], -1)[:8]
        expected, another = (
            np.asarray(program.score(p, rollout.observation[:8], rollout.action[:8]))
            for p in (vector, other)
        )
        np.testing.assert_allclose(scores, expected, rtol=1e-5, atol=1e-6)
        assert np.abs(scores - another).max() > 1e-3


def test_moments_equal_baselines_and_skip_inactive_rows() -> None:
    rng = np.random.default_rng(0)
    for number in (1, 5):
        moments, expected = initial_moments((2,), 3), RunningNormalizer(3)
        for _ in range(20):
            batch = rng.normal(3, 2, (2, number, 3))
            active = np.array([[True] * number, [False] * number])
            moments = update_moments(moments, batch, active)
            expected.update(batch[0])
        np.testing.assert_allclose(moments.mean[0], expected.mean, rtol=1e-12)
        np.testing.assert_allclose(moments.variance[0], expected.var, rtol=1e-12)
        np.testing.assert_array_equal(moments.mean[1], 0.0)
        np.testing.assert_array_equal(moments.variance[1], 1.0)
    partly = update_moments(
        initial_moments((), 1), np.array([[1.0], [9.0], [3.0]]), np.array([True, False, True])
    )
    np.testing.assert_allclose([partly.mean[0], partly.variance[0]], [2.0, 1.0], rtol=1e-3)


def test_compiled_moments_are_the_cores() -> None:
    rng = np.random.default_rng(1)
    for number in (1, 4):
        ours, expected = ObservationMoments(3, 5, 2.0), initial_moments((3,), 5)
        for _ in range(30):
            batch, acting = rng.normal(1, 3, (3, number, 5)), rng.random((3, number)) < 0.6
            out = np.zeros((3, number, 5), np.float32)
            ours.see_and_normalize(batch, acting, out)
            expected = update_moments(expected, batch, acting)
            for got, wanted in zip((ours.mean, ours.variance, ours.count), expected, strict=True):
                np.testing.assert_allclose(got, wanted, rtol=1e-13)
            np.testing.assert_allclose(out, normalize(expected, batch, 2.0), rtol=1e-6)


def test_normalized_values_are_clipped() -> None:
    moments = initial_moments((), 2)
    got = normalize(moments, np.array([[100.0, -0.5]]), 10.0)
    np.testing.assert_allclose(got, [[10.0, -0.5]])
    after = Moments(np.zeros(2), np.array([4.0, 1.0]), np.ones(2))
    got = scale_rewards(after, np.array([[6.0, -1.0], [100.0, -100.0]]), 10.0)
    np.testing.assert_allclose(got, [[3.0, -0.5], [10.0, -10.0]])


def test_moments_of_all_rows_at_once_are_those_of_row_after_row() -> None:
    rng = np.random.default_rng(2)
    values, valid = rng.normal(5, 2, (20, 3)), rng.random((20, 3)) < 0.7
    start = Moments(np.array(1.0), np.array(2.0), np.array(3.0))
    got = moments_after_each(start, values, valid)
    expected = Moments(*(part[None] for part in start))
    for row in range(20):
        expected = update_moments(expected, values[row][:, None], valid[row])
        for after, wanted in zip(got, expected, strict=True):
            np.testing.assert_allclose(after[row], wanted[0], rtol=1e-12)
