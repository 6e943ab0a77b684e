"""The rules' oracles against hand arithmetic, enumeration and identities."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from algorithm.selection import oracle as o

COUNTS = st.integers(1, 12)
SHARES = st.floats(0.01, 1.0)
FEW = settings(max_examples=40, deadline=None)


def numbers(size: object = COUNTS, low: float = -50, high: float = 50) -> st.SearchStrategy:
    return arrays.arrays(np.float64, size, elements=st.floats(low, high, width=32))


def whole(size: int) -> st.SearchStrategy:
    return arrays.arrays(np.int64, size, elements=st.integers(-9, 9))


def rows(keep: np.ndarray) -> list[int]:
    return np.flatnonzero(keep).tolist()


# ------------------------------------------------------------------ sums, counts and ranks


def test_standardise_by_hand() -> None:
    np.testing.assert_allclose(o.standardise(np.array([1.0, 3.0])), [-1, 1], atol=1e-7)
    np.testing.assert_array_equal(o.standardise(np.full(4, 7.0)), np.zeros(4))


def test_means_by_hand() -> None:
    assert o.weighted_mean([1, 5], [3, 1]) == 2
    assert o.importance_mean([1, 5], [3, 1]) == 4
    assert o.weighted_mean([1, 5], [0, 0]) == 0


@FEW
@given(numbers(5), numbers(5, 0.125, 5), st.floats(0.01, 100))
def test_a_weighted_mean_ignores_the_scale_of_the_weights(term, weight, scale) -> None:
    expected = o.weighted_mean(term, weight)
    assert math.isclose(o.weighted_mean(term, scale * weight), expected, abs_tol=1e-9)


@FEW
@given(numbers(low=0.0, high=10), st.floats(0.01, 100))
def test_effective_sample_size_lies_between_one_and_all(weight, scale) -> None:
    size = o.effective_sample_size(weight)
    assert size == 0 if not weight.any() else 1 - 1e-9 <= size <= len(weight) + 1e-9
    assert math.isclose(o.effective_sample_size(scale * weight), size, abs_tol=1e-6)


def test_effective_sample_size_by_hand() -> None:
    assert o.effective_sample_size([2, 2, 2]) == 3
    assert o.effective_sample_size([0, 5, 0]) == 1
    assert math.isclose(o.effective_sample_size([1, 3]), 1.6)


@pytest.mark.parametrize(
    ("share", "number", "count"),
    [(0.25, 8, 2), (0.25, 9, 3), (0.55, 100, 55), (0.1, 30, 3), (0.001, 10, 1), (1.0, 7, 7)],
)
def test_kept_count(share, number, count) -> None:
    assert o.kept_count(share, number) == count  # 0.55 * 100 is 55.00000000000001 in floats


def test_largest_takes_the_lower_row_of_a_tie() -> None:
    assert rows(o.largest([1, 2, 2, 2, 0], 2)) == [1, 2]


# ------------------------------------------------------------------ rules on the advantage


def test_gigaflow_by_hand() -> None:
    advantage = np.array([-4.0, 0.04, -0.04, 0.039])
    keep, maximum = o.gigaflow_keep(advantage, None)
    assert maximum == 4 and rows(keep) == [0, 1, 2]  # the threshold 0.04 itself stays
    keep, maximum = o.gigaflow_keep(advantage, 8.0)  # 0.25 * 4 + 0.75 * 8 = 7
    assert maximum == 7 and rows(keep) == [0]


@FEW
@given(numbers(), st.floats(0, 50), st.sampled_from([0.25, 2.0, 1024.0]))
def test_gigaflow_ignores_the_unit_of_the_reward(advantage, before, unit) -> None:
    keep, maximum = o.gigaflow_keep(advantage, before)
    scaled, larger = o.gigaflow_keep(unit * advantage, unit * before)
    np.testing.assert_array_equal(keep, scaled)
    assert math.isclose(larger, unit * maximum)


def test_gigaflows_first_rollout_keeps_its_largest() -> None:
    assert o.gigaflow_keep(np.zeros(3), None)[0].all()
    assert not o.gigaflow_keep(np.zeros(3), 1.0)[0].any()  # nothing may be left later


def test_top_advantage_by_hand() -> None:
    advantage = np.array([1.0, -3.0, 2.0, 0.5, -0.1])
    assert rows(o.top_advantage_keep(advantage, 0.25)) == [1, 2]
    leaked = np.array([True, True, False, False, True])
    assert rows(o.top_advantage_keep(advantage, 0.25, leaked)) == [0, 1, 2, 4]


@FEW
@given(numbers(), SHARES)
def test_no_dropped_advantage_is_larger_than_a_kept_one(advantage, share) -> None:
    keep = o.top_advantage_keep(advantage, share)
    assert keep.sum() == o.kept_count(share, len(advantage))
    if not keep.all():
        assert np.abs(advantage[keep]).min() >= np.abs(advantage[~keep]).max()


@FEW
@given(numbers())
def test_a_share_of_one_keeps_all(advantage) -> None:
    number = len(advantage)
    assert o.top_advantage_keep(advantage, 1.0).all()
    assert o.kondo_keep(advantage, advantage, 1.0).all()
    assert o.vex_keep(advantage, 1.0, "both").all()
    assert o.stride_keep(number, number).all()
    assert o.low_advantage_keep(advantage, number).all()
    assert o.random_keep(number, np.arange(number)[::-1]).all()
    assert o.pods_keep(advantage, number).all()


def test_positive_by_hand() -> None:
    advantage = np.array([-2.0, 0.0, 2.0, 4.0])  # mean 1, std sqrt 5
    expected = np.array([0, 0, 2, 4]) / math.sqrt(5)
    np.testing.assert_allclose(o.positive_advantage(advantage, 0.0), expected)
    assert rows(o.positive_keep(advantage)) == [2, 3]


@FEW
@given(numbers())
def test_no_kept_sign_flips(advantage) -> None:
    """What centring would break: a row weighs something iff its raw advantage is positive."""
    weighed = o.positive_advantage(advantage) > 0
    np.testing.assert_array_equal(weighed, o.positive_keep(advantage))


# ------------------------------------------------------------------ probabilities and weights


def test_prioritized_by_hand() -> None:
    p = o.prioritized_probabilities(np.array([-1.0, 4.0, 0.0]), power=0.5, floor=0.0)
    np.testing.assert_allclose(p, [1 / 3, 2 / 3, 0])
    p = o.prioritized_probabilities(np.array([1.0, -2.0]), power=2.0, floor=1.0)
    np.testing.assert_allclose(p, [4 / 13, 9 / 13])
    p = np.array([0.5, 0.25, 0.125, 0.125])  # N p = 2, 1, 0.5, 0.5
    np.testing.assert_allclose(o.prioritized_weights(p, 1.0), [0.5, 1, 2, 2])
    half = np.array([1, 2, 4, 4]) * 8 / (9 + 4 * math.sqrt(2))  # the mean is (1 + 2 sqrt 2) / 4
    np.testing.assert_allclose(o.prioritized_weights(p, 0.5) ** 2, half)


@FEW
@given(numbers(), st.floats(0, 1), st.floats(0, 1))
def test_probabilities_sum_to_one_and_weights_of_draws_have_mean_one(
    advantage, power, correction
) -> None:
    p = o.prioritized_probabilities(advantage, power)
    assert math.isclose(p.sum(), 1) and (p > 0).all()
    assert math.isclose(np.sum(p * o.prioritized_weights(p, correction)), 1)
    mixed = o.mixed_probabilities(np.abs(advantage))
    assert math.isclose(mixed.sum(), 1) and (mixed >= 0.1 / len(advantage) - 1e-15).all()
    assert o.importance_weights(mixed).max() <= 10 + 1e-9


def test_no_power_draws_alike_and_no_correction_weighs_alike() -> None:
    p = o.prioritized_probabilities(np.array([1.0, -7.0, 0.0]), power=0.0)
    np.testing.assert_allclose(p, np.full(3, 1 / 3))
    np.testing.assert_array_equal(o.prioritized_weights([0.9, 0.1], 0.0), [1, 1])
    np.testing.assert_array_equal(o.mixed_probabilities(np.zeros(4)), np.full(4, 0.25))


def mean_over_draws(probability, draws, estimate) -> float:
    """Averages an estimate over every sequence of independent draws, each by its probability."""
    sequences = itertools.product(range(len(probability)), repeat=draws)
    return sum(
        float(np.prod(probability[list(drawn)])) * estimate(list(drawn)) for drawn in sequences
    )


@FEW
@given(numbers(4, 0, 9), numbers(4, -9, 9), st.integers(1, 3))
def test_importance_weights_are_unbiased(score, term, draws) -> None:
    p = o.mixed_probabilities(score)
    weight = o.importance_weights(p)
    exact = mean_over_draws(p, draws, lambda i: o.importance_mean(term[i], weight[i]))
    assert math.isclose(exact, term.mean(), abs_tol=1e-9)


@FEW
@given(numbers(4, 0.5, 9), numbers(4, -9, 9))
def test_a_full_correction_is_unbiased(advantage, term) -> None:
    p = o.prioritized_probabilities(advantage)
    weight = o.prioritized_weights(p, 1.0)
    exact = mean_over_draws(p, 2, lambda i: o.importance_mean(term[i], weight[i]))
    assert math.isclose(exact, term.mean(), abs_tol=1e-9)


def test_dividing_by_the_sum_of_the_weights_is_biased() -> None:
    """The negative control: one row drawn at a time weighs 1 whatever its probability."""
    p, term = np.array([0.8, 0.2]), np.array([1.0, 0.0])
    weight = o.importance_weights(p)
    assert math.isclose(mean_over_draws(p, 1, lambda i: o.weighted_mean(term[i], weight[i])), 0.8)
    assert math.isclose(mean_over_draws(p, 1, lambda i: o.importance_mean(term[i], weight[i])), 0.5)


# ------------------------------------------------------------------ delight


def test_delight_by_hand() -> None:
    np.testing.assert_array_equal(o.surprisal(np.array([-2.0, 3.0, -40.0, 40.0])), [2, -3, 10, -10])
    assert o.surprisal([-15], [8]) == 7  # centred first, then clipped
    log_prob = np.log([0.5, 0.25])  # surprisal ln 2 and ln 4; sigmoid(ln 2) = 2/3, of ln 4 = 4/5
    np.testing.assert_allclose(o.delight_weight([1, 1], log_prob), [4 / 3, 8 / 5])
    np.testing.assert_allclose(o.delight_weight([-1, -1], log_prob), [2 / 3, 2 / 5])
    np.testing.assert_allclose(o.delight_weight([2, 2], log_prob, temperature=2.0), [4 / 3, 8 / 5])
    assert o.delight_weight([0], [-5]) == 1


@FEW
@given(numbers(6), numbers(6, -9, 9))
def test_delight_of_opposite_advantages_sums_to_two(advantage, log_prob) -> None:
    both = o.delight_weight(advantage, log_prob) + o.delight_weight(-advantage, log_prob)
    np.testing.assert_allclose(both, 2)


@FEW
@given(numbers(6), numbers(6, -3, 3), st.floats(0.01, 100))
def test_centred_delight_ignores_the_unit_of_the_action(advantage, log_prob, unit) -> None:
    """A density's logarithm falls by log c where its entropy rises by log c."""
    entropy = np.full(6, 1.4)
    other = o.delight_weight(advantage, log_prob - math.log(unit), entropy + math.log(unit))
    expected = o.delight_weight(advantage, log_prob, entropy)
    np.testing.assert_allclose(other, expected, rtol=1e-6, atol=1e-6)


def test_kondo_by_hand() -> None:
    advantage, log_prob = np.array([1.0, 1.0, -1.0, -1.0, 2.0]), np.array([-1, -3, -1, -3, -1.0])
    # delight 1, 3, -1, -3, 2
    assert rows(o.kondo_keep(advantage, log_prob, 0.3)) == [1, 4]
    assert rows(o.kondo_keep(advantage, log_prob, 0.6)) == [0, 1, 4]


# ------------------------------------------------------------------ ratio, segments, Vex


def test_sample_dropout_by_hand() -> None:
    ratio = np.array([1.0, 1.25, 1.24, 0.75, 0.76, 3.0])
    assert rows(o.sample_dropout_keep(np.log(ratio), np.zeros(6), 0.2500001)) == [0, 1, 2, 3, 4]
    assert rows(o.sample_dropout_keep(np.log(ratio), np.zeros(6), 0.245)) == [0, 2, 4]
    assert rows(o.sample_dropout_keep(np.zeros(2), [0.0, -700.0], 1.0)) == [0]
    assert o.sample_dropout_keep(np.log([2.0, 3.0]), np.zeros(2), 0.5).all()


def test_a_deviation_at_the_limit_drops_out() -> None:
    assert rows(o.sample_dropout_keep([-math.inf, 0.0], np.zeros(2), 1.0)) == [1]  # |0 - 1| = 1


def test_segments_by_hand() -> None:
    advantage = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(o.segment_scores(advantage, 2), [[2, 4], [10, 12], [8, 9]])
    keep = o.segments_to_rows(np.array([[1, 0], [0, 0], [0, 1]]), 5, 2)
    np.testing.assert_array_equal(keep[:, 0], [1, 1, 0, 0, 0])
    np.testing.assert_array_equal(keep[:, 1], [0, 0, 0, 0, 1])


def test_pods_by_hand() -> None:
    assert rows(o.pods_keep([0, 10, 9, 8], 2)) == [0, 1]
    assert rows(o.pods_keep([5, -5, 1, 0, 2])) == [0, 1, 4]  # half of five, rounded up
    keep = o.pods_keep([[1, 2], [3, 4]], 2)
    np.testing.assert_array_equal(keep, [[True, False], [False, True]])


@FEW
@given(st.integers(1, 8).flatmap(whole), st.data())
def test_pods_finds_the_subset_of_largest_variance(score, data) -> None:
    count = data.draw(st.integers(1, len(score)))
    keep = o.pods_keep(score, count)
    assert keep.sum() == count
    assert math.isclose(np.var(score[keep]), o.largest_variance(list(score), count), abs_tol=1e-9)


@FEW
@given(whole(7), whole(7).filter(lambda returns: returns.std() > 0))
def test_vex_shares_average_to_the_variance_explained(error, returns) -> None:
    share = o.vex_share(error, returns)
    explained = 1 - (error**2).sum() / ((returns - returns.mean()) ** 2).sum()
    assert math.isclose(share.mean(), explained, rel_tol=1e-9, abs_tol=1e-9)
    low, high = o.vex_keep(share, 0.3, "low"), o.vex_keep(share, 0.3, "high")
    assert np.abs(error[low]).min() >= np.abs(error[~low]).max()
    assert np.abs(error[high]).max() <= np.abs(error[~high]).min()


def test_vex_by_hand() -> None:
    share = o.vex_share(np.array([0.0, 2.0, -1.0]), np.array([-1.0, 1.0, 0.0]))  # Var 2/3
    np.testing.assert_allclose(share, [1, -5, -0.5])
    assert rows(o.vex_keep(share, 0.34, "high")) == [0, 2]
    assert rows(o.vex_keep(share, 0.34, "low")) == [1, 2]
    assert rows(o.vex_keep(share, 0.34, "both")) == [0, 1]
    assert rows(o.vex_keep(np.arange(6.0), 0.5, "both")) == [0, 4, 5]
    np.testing.assert_array_equal(o.vex_share(np.ones(2), np.ones(2)), [0, 0])


def test_eq_7_by_hand() -> None:
    """Medians of the earlier rows: none, 1, 0.6, 0.2, 0.1; a very negative share is kept."""
    share = np.array([[1.0], [0.2], [0.1], [-4.0], [0.04]])
    assert o.informative_keep(share)[:, 0].tolist() == [True, False, False, True, False]
    assert o.informative_keep(share, 0.1)[:, 0].tolist() == [True, True, True, True, True]
    there = np.array([[True], [False], [True], [True], [True]])  # medians: none, 1, 0.55, 0.1
    assert o.informative_keep(share, 0.3, there)[:, 0].tolist() == [True, False, False, True, True]


# ------------------------------------------------------------------ controls and minibatches


def test_controls_by_hand() -> None:
    assert rows(o.random_keep(2, [3, 0, 2, 1])) == [0, 3]
    assert rows(o.stride_keep(3, 9)) == [0, 3, 6]
    assert rows(o.stride_keep(3, 8)) == [0, 2, 5]
    assert rows(o.low_advantage_keep(np.array([5.0, -1.0, 2.0, -3.0]), 2)) == [1, 2]
    assert rows(o.reversed_keep(np.array([5.0, -1.0, 2.0, -3.0]), 2)) == [1, 3]


@FEW
@given(st.integers(1, 40).flatmap(lambda n: st.tuples(st.just(n), st.integers(1, n))))
def test_a_control_keeps_exactly_as_many(sizes) -> None:
    number, count = sizes
    score = np.random.default_rng(number).permutation(number) - number / 3
    assert o.stride_keep(count, number).sum() == count
    assert o.random_keep(count, np.arange(number)).sum() == count
    assert o.low_advantage_keep(score, count).sum() == count
    rest = o.largest(score, number - count)
    np.testing.assert_array_equal(o.reversed_keep(score, count), ~rest)  # no ties here


def test_minibatches_by_hand() -> None:
    keep = np.array([1, 0, 1, 1, 0, 1, 1], bool)
    order = np.array([6, 1, 0, 2, 4, 5, 3])
    cut = [x.tolist() for x in o.minibatches(keep, order, 2, "left out")]
    assert cut == [[6, 0], [2, 5]]
    cut = [x.tolist() for x in o.minibatches(keep, order, 2, "filled")]
    assert cut == [[6, 0], [2, 5], [3, 6]]
    assert o.minibatches(np.zeros(7, bool), order, 2, "filled") == []


@FEW
@given(arrays.arrays(bool, st.integers(1, 20)), st.integers(1, 8), st.integers(0, 99))
def test_no_minibatch_is_short_and_no_kept_row_is_lost(keep, size, seed) -> None:
    order = np.random.default_rng(seed).permutation(len(keep))
    filled = o.minibatches(keep, order, size, "filled")
    assert len(filled) == math.ceil(keep.sum() / size)
    assert all(len(x) == size for x in filled)
    assert {int(i) for x in filled for i in x} == set(rows(keep))
    assert len(o.minibatches(keep, order, size, "left out")) == keep.sum() // size


def test_speed_up_by_hand() -> None:
    assert round(o.speed_up(0.24, 0.5), 2) == 1.14
    assert round(o.speed_up(0.87, 0.25), 1) == 2.9
    assert o.speed_up(1.0, 0.25) == 4 and o.speed_up(0.0, 0.25) == 1
