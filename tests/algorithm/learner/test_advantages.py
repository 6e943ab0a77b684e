"""GAE against an independent loop, identities, and what must not leak."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arrays import batch_of, no_key, random_rollout
from helpers import configured
from sauna.algorithm.learner.advantages import gae
from sauna.algorithm.learner.samples import advantages_over_all
from sauna.algorithm.learner.vex_targets import TARGETS
from sauna.algorithm.types import Hypers, Rollout

over_all = jax.jit(advantages_over_all, static_argnums=2)  # one program, not one per operation


def hypers(**values: float) -> Hypers:
    start = dict.fromkeys(Hypers._fields, 0.0) | {"gamma": 0.9, "gae_lambda": 0.8}
    return Hypers(**{k: np.float64(v) for k, v in {**start, **values}.items()})


def loop_gae(rollout: Rollout, gamma: float, lam: float, bootstrap_truncated: bool) -> np.ndarray:
    """Per episode and backwards, with plain branches instead of masks."""
    steps, envs = rollout.reward.shape
    advantage = np.zeros((steps, envs))
    for n in range(envs):
        later = 0.0
        for t in range(steps - 1, -1, -1):
            if rollout.terminated[t, n]:
                successor, later = 0.0, 0.0
            elif rollout.truncated[t, n]:
                successor, later = (rollout.next_value[t, n] if bootstrap_truncated else 0.0), 0.0
            else:
                successor = rollout.next_value[t, n]
            delta = rollout.reward[t, n] + gamma * successor - rollout.value[t, n]
            advantage[t, n] = later = delta + gamma * lam * later
    return advantage


@pytest.mark.parametrize("bootstrap", [True, False])
def test_equals_a_plain_loop_in_both_precisions(bootstrap: bool) -> None:
    rollout = random_rollout(0)
    expected = loop_gae(rollout, 0.9, 0.8, bootstrap)
    with jax.enable_x64(True):
        exact = over_all(jax.tree.map(jnp.asarray, rollout), hypers(), bootstrap)
        assert exact.dtype == jnp.float64
        np.testing.assert_allclose(exact, expected, rtol=0, atol=1e-12)
    single = jax.tree.map(lambda x: jnp.asarray(x, np.float32) if x.dtype == float else x, rollout)
    rounded = over_all(single, jax.tree.map(np.float32, hypers()), bootstrap)
    assert rounded.dtype == jnp.float32
    np.testing.assert_allclose(rounded, expected, rtol=1e-5, atol=1e-5)


def test_by_hand() -> None:
    """Two steps, gamma 0.5, lambda 0.5, the second one truncated with final value 4."""
    reward, value = jnp.array([1.0, 2.0]), jnp.array([3.0, 5.0])
    got = gae(reward, value, jnp.array([5.0, 4.0]), jnp.ones(2), jnp.array([1, 0]), 0.5, 0.5)
    # delta_1 = 2 + 0.5 * 4 - 5 = -1; delta_0 = 1 + 0.5 * 5 - 3 = 0.5; A_0 = 0.5 + 0.25 * -1
    np.testing.assert_allclose(got, [0.25, -1.0])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_lambda_0_is_the_temporal_difference_error(seed: int) -> None:
    r = random_rollout(seed)
    with jax.enable_x64(True):
        got = over_all(jax.tree.map(jnp.asarray, r), hypers(gae_lambda=0.0), True)
        expected = r.reward + 0.9 * np.where(r.terminated, 0.0, r.next_value) - r.value
        np.testing.assert_allclose(got, expected, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_lambda_1_is_the_discounted_sum_minus_the_value(seed: int) -> None:
    r = random_rollout(seed, envs=1)
    with jax.enable_x64(True):
        got = over_all(jax.tree.map(jnp.asarray, r), hypers(gae_lambda=1.0), True)
    for t in range(len(r.reward)):
        total, discount = 0.0, 1.0
        for k in range(t, len(r.reward)):
            total += discount * r.reward[k, 0]
            discount *= 0.9
            last = k == len(r.reward) - 1 or r.terminated[k, 0] or r.truncated[k, 0]
            if last:
                total += 0.0 if r.terminated[k, 0] else discount * r.next_value[k, 0]
                break
        np.testing.assert_allclose(got[t, 0], total - r.value[t, 0], atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 39))
def test_nothing_leaks_across_an_episode_end(seed: int, end: int) -> None:
    r = random_rollout(seed, envs=1)
    r.terminated[end - 1] = True
    r.truncated[end - 1] = False
    with jax.enable_x64(True):
        before = over_all(jax.tree.map(jnp.asarray, r), hypers(), True)[:end]
        r.reward[end:] += 100.0
        r.value[end:] -= 50.0
        after = over_all(jax.tree.map(jnp.asarray, r), hypers(), True)[:end]
    np.testing.assert_array_equal(before, after)


def test_truncation_reaches_the_endless_value_and_termination_must_miss_it() -> None:
    """Reward 1 for ever, V exact: the lambda-return is 1 / (1 - gamma) only when bootstrapped."""
    gamma, steps = 0.9, 30
    endless = 1 / (1 - gamma)
    full = np.full((steps, 1), endless)
    ends = (np.arange(steps) % 5 == 4)[:, None]
    no = np.zeros((steps, 1), bool)
    r = random_rollout(0, steps, 1)._replace(
        reward=np.ones((steps, 1)), value=full, next_value=full, terminated=no, truncated=ends
    )
    with jax.enable_x64(True):
        h = hypers(gae_lambda=0.95)
        right = np.asarray(over_all(jax.tree.map(jnp.asarray, r), h, True)) + full
        wrong = np.asarray(over_all(jax.tree.map(jnp.asarray, r), h, False)) + full
    np.testing.assert_allclose(right, endless, atol=1e-9)
    assert np.all(wrong[ends] < 2.0)


def test_advantages_over_all_do_not_depend_on_what_is_kept() -> None:
    """Dropping changes which advantages are used, never what they are."""
    config = configured(rollout_steps=40, envs=3, minibatches=4)
    r = random_rollout(3, keep_rate=0.6)
    r32 = jax.tree.map(lambda x: jnp.asarray(x, np.float32) if x.dtype == float else x, r)
    h = jax.tree.map(np.float32, hypers())
    batch = batch_of(r32, h, no_key(), config=config, target=TARGETS["rollout"])
    every = np.asarray(over_all(r32, h, True))
    for n in range(3):
        number = r.keep[:, n].sum()
        got = np.asarray(batch.advantage).reshape(40, 3)[:number, n]
        np.testing.assert_array_equal(got, every[r.keep[:, n], n])
        weight = np.asarray(batch.weight).reshape(40, 3)[:, n]
        np.testing.assert_array_equal(weight, np.arange(40) < number)


def test_padding_behind_the_stream_changes_nothing() -> None:
    config = configured(rollout_steps=40, envs=3, minibatches=4)
    r = jax.tree.map(
        lambda x: jnp.asarray(x, np.float32) if x.dtype == float else x, random_rollout(4)
    )
    longer = jax.tree.map(lambda x: jnp.concatenate([x, jnp.ones_like(x)]), r)
    no = jnp.zeros((40, 3), bool)
    longer = longer._replace(
        valid=jnp.concatenate([r.valid, no]), keep=jnp.concatenate([r.keep, no])
    )
    h = jax.tree.map(np.float32, hypers())
    one = batch_of(r, h, no_key(), config=config, target=TARGETS["episode"])
    other = batch_of(longer, h, no_key(), config=config, target=TARGETS["episode"])
    jax.tree.map(np.testing.assert_array_equal, one, other)
