"""From a choice to minibatches: every row where it has to be, in all modes, also for few rows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from algorithm.selection import oracle
from sauna.algorithm.selection.draws import (
    by_probability,
    draw,
    effective_size,
    kept_first,
    minibatch_count,
    minibatch_places,
    minibatch_size,
)
from sauna.algorithm.types import Choice

ROWS, MINIBATCHES = 24, 4
FULL = ROWS // MINIBATCHES


@jax.jit
def _kept_first(keep: jax.Array, order: jax.Array) -> tuple[jax.Array, jax.Array]:
    return kept_first(keep, order)


def minibatches(mode: str, keep: np.ndarray, order: np.ndarray) -> list[np.ndarray]:
    """The rows of each gradient step of an epoch, with static sizes and traced numbers."""
    rows, number = _kept_first(jnp.asarray(keep), jnp.asarray(order))
    size = minibatch_size(mode, FULL, MINIBATCHES, ROWS)
    found = []
    for i in range(int(minibatch_count(mode, number, size, MINIBATCHES))):
        places, counts = minibatch_places(mode, jnp.int32(i), number, size, MINIBATCHES)
        assert places.shape == counts.shape == (size,)
        found.append(np.asarray(rows)[np.asarray(places)][np.asarray(counts)])
    return found


masks = st.lists(st.booleans(), min_size=ROWS, max_size=ROWS).map(np.array)
orders = st.permutations(range(ROWS)).map(lambda rows: np.array(rows, np.int32))


@settings(max_examples=30, deadline=None)
@given(masks, orders)
def test_fewer_steps_are_numpys_minibatches(keep: np.ndarray, order: np.ndarray) -> None:
    got = minibatches("fewer", keep, order)
    expected = oracle.minibatches(keep, order, FULL, "filled")
    assert len(got) == len(expected)
    for one, other in zip(got, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@settings(max_examples=30, deadline=None)
@given(masks, orders)
def test_smaller_steps_share_the_rows_without_a_rest(keep: np.ndarray, order: np.ndarray) -> None:
    """Each row once, in order; sizes differ by at most one; no step is without a row."""
    got = minibatches("smaller", keep, order)
    assert len(got) == min(keep.sum(), MINIBATCHES)
    sizes = [len(rows) for rows in got]
    assert not sizes or (max(sizes) - min(sizes) <= 1 and min(sizes) >= 1)
    expected = order[keep[order]]
    np.testing.assert_array_equal(np.concatenate([*got, order[:0]]), expected)


@settings(max_examples=30, deadline=None)
@given(masks, orders)
def test_refilled_steps_go_through_the_rows_again(keep: np.ndarray, order: np.ndarray) -> None:
    got = minibatches("refill", keep, order)
    kept = order[keep[order]]
    assert len(got) == (MINIBATCHES if len(kept) else 0)
    if len(kept):
        np.testing.assert_array_equal(np.concatenate(got), np.resize(kept, ROWS))


@settings(max_examples=30, deadline=None)
@given(masks, orders)
def test_kept_rows_come_first_in_the_permutations_order(
    keep: np.ndarray, order: np.ndarray
) -> None:
    rows, number = _kept_first(jnp.asarray(keep), jnp.asarray(order))
    assert number == keep.sum()
    expected = np.concatenate([order[keep[order]], order[~keep[order]]])
    np.testing.assert_array_equal(rows, expected)


def test_all_rows_make_ppos_own_minibatches_in_every_mode() -> None:
    order = np.random.default_rng(0).permutation(ROWS).astype(np.int32)
    for mode in ("fewer", "smaller", "refill"):
        got = minibatches(mode, np.ones(ROWS, bool), order)
        np.testing.assert_array_equal(np.stack(got), order.reshape(MINIBATCHES, FULL))


@given(st.integers(1, 60), st.integers(1, 600))
def test_fewer_steps_take_hardly_a_row_twice(full: int, length: int) -> None:
    """Of a static number of rows: as few steps as PPO's size allows, and less than one row each."""
    size = minibatch_size("fewer", full, 4, length)
    count = int(minibatch_count("fewer", jnp.int32(length), size, 4))
    assert size <= full and count == -(-length // full)
    assert 0 <= count * size - length < count
    if length % full == 0:
        assert size == full


def test_a_draw_holds_as_many_rows_as_are_kept_or_asked_for() -> None:
    order = jnp.arange(ROWS, dtype=jnp.int32)[::-1]
    keep = jnp.arange(ROWS) % 3 == 0
    some = draw(Choice(keep=keep), order, jax.random.key(0), 10)
    assert some.number == 8 and some.rows.shape == (10,)
    np.testing.assert_array_equal(some.rows[:8], np.arange(21, -1, -3))
    np.testing.assert_array_equal(some.rows, some.value_rows)
    turned = jnp.array([3, 9, 1, 0, 7, 2, 8, 6, 5, 4], jnp.int32)  # of the first ten kept rows
    few = draw(Choice(keep=keep), turned, jax.random.key(0), 10)
    assert few.number == 8, "places 8 and 9 hold rows that are not kept: they come last"
    np.testing.assert_array_equal(few.rows[:8], 3 * np.array([3, 1, 0, 7, 2, 6, 5, 4]))
    p = jnp.ones(ROWS) / ROWS
    drawn = draw(Choice(probability=p), order, jax.random.key(0), 10)
    assert drawn.number == 10
    np.testing.assert_array_equal(drawn.rows, drawn.value_rows)
    two = draw(Choice(probability=p, value_probability=p), order, jax.random.key(0), 10)
    np.testing.assert_array_equal(two.rows, drawn.rows)
    assert not np.array_equal(two.rows, two.value_rows), "the value loss draws rows of its own"


def test_rows_are_drawn_as_often_as_their_probability_says() -> None:
    """By a chi-square test with a fixed key, which other probabilities fail."""
    rng = np.random.default_rng(0)
    p = rng.random(ROWS) ** 2
    p[[3, ROWS - 1]] = 0.0
    p /= p.sum()
    number = 20_000
    uniform = jax.random.uniform(jax.random.key(1), (number,))
    count = np.bincount(by_probability(jnp.asarray(p, jnp.float32), uniform), minlength=ROWS)
    on = p > 0
    assert not count[~on].any()
    assert stats.chisquare(count[on], number * p[on]).pvalue > 0.01
    other = np.roll(p[on], 1)
    assert stats.chisquare(count[on], number * other).pvalue < 1e-6


def test_the_ends_of_the_uniform_numbers_are_rows_that_can_be_drawn() -> None:
    p = jnp.array([0.0, 0.3, 0.3, 0.4, 0.0])
    ends = jnp.array([0.0, 1.0 - 2**-24], jnp.float32)
    np.testing.assert_array_equal(by_probability(p, ends), [1, 3])


@pytest.mark.parametrize("seed", range(3))
def test_the_effective_size_is_kishs(seed: int) -> None:
    weight = np.random.default_rng(seed).random(ROWS).astype(np.float32)
    expected = oracle.effective_sample_size(weight)
    np.testing.assert_allclose(effective_size(jnp.asarray(weight)), expected, rtol=1e-5)
    np.testing.assert_allclose(effective_size(3.0 * jnp.ones(7)), 7.0)
    assert effective_size(jnp.zeros(4)) == 0.0
