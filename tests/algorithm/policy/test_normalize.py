"""Running moments of float32 stay right where float32 counts no further."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sauna.algorithm.policy.normalize import (
    LongMoments,
    Moments,
    long_moments,
    long_moments_after_all,
    moments_after_each,
    update_long_moments,
    update_moments,
)

STEPS = 2**20  # of one environment, in blocks that repeat
BLOCK = 2**12
VALUES = np.random.default_rng(0).normal(0.5, 2.0, (BLOCK, 1, 1)).astype(np.float32)
ACTIVE = np.ones(1, bool)


def merged(count: float, steps: int = STEPS) -> Moments:
    """Mean 0 and variance 1 of `count` samples and `steps` of `VALUES`, in one formula, float64."""
    values = VALUES.astype(np.float64)
    mean, variance, total = values.mean(), values.var(), count + steps
    between = mean**2 * count * steps / total
    return Moments(mean * steps / total, (count + variance * steps + between) / total, total)


def started(count: float) -> LongMoments:
    """Mean 0 and variance 1 of `count` samples, which two float32 hold."""
    high = np.float32(count)
    shape = jnp.ones(1, jnp.float32)
    parts = long_moments(Moments(0.0 * shape, shape, high * shape))
    return parts._replace(count_lost=np.float32(count - float(high)) * shape)


def exact(moments: LongMoments) -> Moments:
    parts = np.asarray(moments, np.float64)[..., 0]
    return Moments(*(parts[:3] + parts[3:]))


def run(update: Any, moments: Any) -> Any:
    """All blocks, step by step, in one compiled loop."""

    def block(now: Any, _: Any) -> tuple[Any, None]:
        return jax.lax.scan(lambda m, x: (update(m, x, ACTIVE), None), now, VALUES)[0], None

    return jax.jit(lambda m: jax.lax.scan(block, m, length=STEPS // BLOCK)[0])(moments)


@pytest.mark.parametrize("count", [2.0**24, 10.0**8, 10.0**10])
def test_observation_moments_follow_float64_however_long_a_run_is(count: float) -> None:
    """What the steps add is compared, not what was there before."""
    found, expected = exact(run(update_long_moments, started(count))), merged(count)
    np.testing.assert_allclose(found.count, expected.count, rtol=0, atol=0.5)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-3)
    np.testing.assert_allclose(found.variance - 1, expected.variance - 1, rtol=1e-3)


def test_plain_float32_does_not() -> None:
    """The negative control: the count stands, and the variance only grows."""
    begun = started(2.0**24).moments
    found, expected = run(update_moments, begun), merged(2.0**24)
    assert float(found.count[0]) == 2.0**24
    assert abs(float(found.variance[0]) - expected.variance) > 0.03


def test_from_nothing_both_forms_are_the_same_numbers() -> None:
    rng = np.random.default_rng(1)
    plain = Moments(np.zeros(3), np.ones(3), np.full(1, 1e-4))
    long = long_moments(plain)
    for _ in range(50):
        batch, active = rng.normal(3.0, 5.0, (4, 3)), rng.random(4) < 0.7
        plain, long = update_moments(plain, batch, active), update_long_moments(long, batch, active)
    for one, other in zip(plain, long.moments, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("count", [2.0**24, 10.0**10])
def test_reward_moments_follow_float64_however_long_a_run_is(count: float) -> None:
    """A rollout of 4096 steps at a time."""
    values, valid = jnp.asarray(VALUES[:, :, 0]), jnp.ones((BLOCK, 1), bool)
    begun = jax.tree.map(lambda part: part[0], started(count))
    after = jax.jit(
        lambda m: jax.lax.scan(
            lambda now, _: (long_moments_after_all(now, values, valid)[1], None),
            m,
            length=STEPS // BLOCK,
        )[0]
    )(begun)
    found = exact(LongMoments(*(part[None] for part in after)))
    expected = merged(count)
    np.testing.assert_allclose(found.count, expected.count, rtol=0, atol=0.5)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-3)
    np.testing.assert_allclose(found.variance - 1, expected.variance - 1, rtol=1e-3)


def test_reward_moments_after_each_row_are_the_hosts() -> None:
    rng = np.random.default_rng(2)
    plain = Moments(0.3, 2.0, 100.0)
    values, valid = rng.normal(1.0, 3.0, (20, 4)), rng.random((20, 4)) < 0.8
    expected = moments_after_each(plain, values, valid)
    each, end = long_moments_after_all(LongMoments(*plain, 0.0, 0.0, 0.0), values, valid)
    for one, other, last in zip(expected, each, end.moments, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-12)
        np.testing.assert_allclose(last, one[-1], rtol=1e-12)
