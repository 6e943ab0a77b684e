"""The four targets against float64 numpy, identities, and the guards."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arrays import random_rollout
from sauna.algorithm.learner.metrics import head_statistics, variance_explained
from sauna.algorithm.learner.samples import episode_numbers, kept_rows
from sauna.algorithm.learner.vex_targets import TARGETS


def sample(seed: int = 0) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    return_ = rng.normal(size=(50, 3)) * 3 + 1
    value = return_ + rng.normal(size=(50, 3)) * 1.5 + 0.5
    weight = (rng.random((50, 3)) < 0.8).astype(float)
    episode = np.cumsum(rng.random((50, 3)) < 0.1, 0)
    return return_, value, weight, episode - episode[0]


def equation_5(return_: np.ndarray, value: np.ndarray) -> float:
    return 1 - ((return_ - value) ** 2).sum() / ((return_ - return_.mean()) ** 2).sum()


def target(name: str, *arrays: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(TARGETS[name].target(*map(jnp.asarray, arrays)))


def test_rollout_is_equation_5_of_each_actor() -> None:
    return_, value, weight, episode = sample()
    got = target("rollout", return_, value, weight, episode)
    for n in range(3):
        used = weight[:, n] > 0
        expected = equation_5(return_[used, n], value[used, n])
        np.testing.assert_allclose(got[:, n], expected, atol=1e-12)


def test_episode_is_equation_5_of_each_stretch() -> None:
    return_, value, weight, episode = sample()
    got = target("episode", return_, value, weight, episode)
    checked = 0
    for n in range(3):
        for e in np.unique(episode[:, n]):
            used = (weight[:, n] > 0) & (episode[:, n] == e)
            if used.sum() > 1:
                expected = equation_5(return_[used, n], value[used, n])
                np.testing.assert_allclose(got[used, n], expected, atol=1e-9)
                checked += 1
    assert checked > 8


def test_minibatch_is_the_released_formula() -> None:
    return_, value, weight, _ = (x[:, 0] for x in sample())
    got = target("minibatch", return_, value, weight, np.zeros(50, int))
    used = weight > 0
    expected = 1 - np.var((return_ - value)[used]) / np.var(return_[used])
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_a_constant_error_costs_nothing_per_minibatch_but_all_in_equation_5() -> None:
    return_ = np.random.default_rng(0).normal(size=(40, 1))
    arrays = (return_, return_ + 7.0, np.ones((40, 1)), np.zeros((40, 1), int))
    np.testing.assert_allclose(target("minibatch", *(a[:, 0] for a in arrays)), 1.0)
    assert target("rollout", *arrays)[0, 0] < -10


def test_the_mean_of_sample_is_equation_5_where_nothing_is_clipped() -> None:
    rng = np.random.default_rng(2)
    return_ = rng.normal(size=(60, 2))
    value = return_ + rng.uniform(-1, 1, size=(60, 2)) * 0.5
    ones, zeros = np.ones((60, 2)), np.zeros((60, 2), int)
    got = target("sample", return_, value, ones, zeros)
    np.testing.assert_allclose(got.mean(0), target("rollout", return_, value, ones, zeros)[0])
    assert got.std() > 0.01


def test_sample_by_hand_and_its_clip() -> None:
    return_ = np.array([[1.0], [-1.0]])  # variance 1
    value = np.array([[0.5], [9.0]])
    got = target("sample", return_, value, np.ones((2, 1)), np.zeros((2, 1), int))
    np.testing.assert_allclose(got, [[0.75], [-5.0]])


@pytest.mark.parametrize("name", TARGETS)
def test_constant_returns_give_0_and_not_nan(name: str) -> None:
    shape = (10,) if TARGETS[name].per_minibatch else (10, 2)
    ones = np.ones(shape)
    got = target(name, ones * 3, ones * 2, ones, np.zeros(shape, int))
    np.testing.assert_array_equal(got, 0.0)


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.parametrize("constant", [0.1, 0.3, 33.3, -1e4])
def test_constant_float32_returns_give_0_too(name: str, constant: float) -> None:
    """In float32 the mean of equal numbers is off by rounding, and the variance is not 0."""
    shape = (2048,) if TARGETS[name].per_minibatch else (2048, 1)
    ones = jnp.ones(shape, jnp.float32)
    got = TARGETS[name].target(ones * constant, ones, ones, jnp.zeros(shape, jnp.int32))
    np.testing.assert_array_equal(got, 0.0)


@pytest.mark.parametrize("name", TARGETS)
def test_samples_of_weight_0_do_not_count(name: str) -> None:
    return_, value, weight, _ = sample(4)
    zeros = np.zeros(weight.shape, int)
    arrays = [return_, value, weight, zeros]
    if TARGETS[name].per_minibatch:
        arrays = [a[:, 0] for a in arrays]
    changed = [np.where(arrays[2] > 0, a, 1e3) for a in arrays[:2]]
    one, other = target(name, *arrays), target(name, *changed, *arrays[2:])
    np.testing.assert_allclose(one[arrays[2] > 0], other[arrays[2] > 0], atol=1e-9)


def test_episodes_of_kept_steps_are_numbered_without_gaps() -> None:
    r = random_rollout(5, keep_rate=0.4)
    rows = kept_rows(jnp.asarray(r.keep), 40)
    got = np.asarray(episode_numbers(jax.tree.map(jnp.asarray, r), rows))
    ended = r.terminated | r.truncated
    for n in range(3):
        kept = np.flatnonzero(r.keep[:, n])
        true = [ended[:t, n].sum() for t in kept]
        expected = [sorted(set(true)).index(e) for e in true]
        np.testing.assert_array_equal(got[: len(kept), n], expected)


def test_logged_statistics() -> None:
    rng = np.random.default_rng(0)
    vex, valid = rng.normal(size=(31, 2)).astype(np.float32), rng.random((31, 2)) < 0.7
    mean, spread, middle = head_statistics(jnp.asarray(vex), jnp.asarray(valid))
    np.testing.assert_allclose(
        [mean, spread, middle],
        [vex[valid].mean(), vex[valid].std(), np.median(vex[valid])],
        rtol=1e-5,
    )
    r, v, w = rng.normal(size=40), rng.normal(size=40), (rng.random(40) < 0.5).astype(float)
    expected = 1 - np.var((r - v)[w > 0]) / np.var(r[w > 0])
    np.testing.assert_allclose(variance_explained(r, v, w), expected, rtol=1e-5)
