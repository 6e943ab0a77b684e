"""Compute to a level: by hand, and with an arm that is the baseline."""

from __future__ import annotations

import numpy as np
import pytest

from sauna.experiments import compute
from sauna.experiments.compute import (
    GRID,
    Curves,
    compute_ratio,
    cumulated,
    drawn,
    has_risen,
    joined,
    learner_seconds,
    reached,
    training_seconds,
)


def curves(x: list[float], *seeds: list[float | None]) -> Curves:
    found = joined([(x, seed) for seed in seeds])
    assert found is not None
    return found


def test_counts_add_up_until_one_is_unknown() -> None:
    assert cumulated([3.0, 4.0, 5.0]) == [3.0, 7.0, 12.0]
    assert cumulated([3.0, None, 5.0]) == [3.0, None, None]


def test_the_iteration_that_compiles_counts_as_the_next() -> None:
    timings = [
        {"iteration": 0, "update_cpu_seconds": {"ppo/0": 9.0, "ppo/1": 8.0}},
        {"iteration": 1, "update_cpu_seconds": {"ppo/0": 0.5}},
        {"iteration": 2},
        {"iteration": 3, "update_cpu_seconds": {"ppo/0": 7.0}},
    ]
    assert learner_seconds(timings, "ppo/0") == {0: 0.5, 1: 0.5, 3: 7.0}
    assert learner_seconds(timings, "ppo/1") == {0: 8.0}


def test_a_training_takes_its_learning_and_its_share_of_what_members_do_together() -> None:
    host = [
        {"iteration": 0, "collect_cpu_seconds": 90.0, "update_cpu_seconds": {"a/0": 5, "b/0": 6}},
        {"iteration": 1, "collect_cpu_seconds": 4.0, "update_cpu_seconds": {"a/0": 1, "b/0": 2}},
        {"iteration": 2, "collect_cpu_seconds": 4.0, "update_cpu_seconds": {"a/0": 1}},
        {"iteration": 3, "seconds": 1.0},  # of a run of before
    ]
    assert training_seconds(host, "a/0") == {0: 3.0, 1: 3.0, 2: 5.0}
    assert training_seconds(host, "b/0") == {0: 4.0, 1: 4.0}
    device = [{"iteration": 0, "cpu_seconds": {"a/0": 0.5}}]
    assert training_seconds(device, "a/0") == {0: 0.5}


def test_a_level_is_reached_between_two_points() -> None:
    x = np.array([10.0, 20.0, 40.0])
    mean = np.array([[0.0, 4.0, 8.0], [0.0, 4.0, 2.0], [5.0, 0.0, 0.0], [np.nan, 6.0, 7.0]])
    # 5 is a quarter of the way from 4 to 8: 20 + 20 / 4.
    assert reached(x, mean, np.full(4, 5.0)).tolist() == [25.0, np.inf, 10.0, 20.0]
    assert reached(x, mean[:1], np.array([4.0])).tolist() == [20.0]


def test_seeds_that_ended_keep_their_last_return() -> None:
    found = joined([([1, 2], [0, 10]), ([1, 2, 4], [None, 2, 6])])
    assert found is not None and found.x.tolist() == [1, 2, 4]
    assert np.array_equal(found.y, [[0, 10, 10], [np.nan, 2, 6]], equal_nan=True)
    assert joined([([1, 2], [None, None])]) is None
    assert joined([]) is None


def test_an_arm_that_learns_the_same_from_half_the_samples() -> None:
    """ppo ends at the mean 20 of 15 and 25 after 100 samples; the arm is there after 50."""
    base = curves([0.0, 100.0], [0.0, 15.0], [0.0, 25.0])
    arm = curves([0.0, 50.0], [0.0, 15.0], [0.0, 25.0])
    found = compute_ratio(arm, base)
    assert found.value == pytest.approx(0.5)
    assert found.low == pytest.approx(0.3)  # 25 against 15 half-way: 50 * 15 / 25 / 100
    assert found.high is None  # two low seeds of the arm never reach two high ones of ppo


def test_the_interval_covers_what_all_resamples_give() -> None:
    """Three seeds that are alike leave no resample that differs."""
    base = curves([0.0, 100.0], *[[0.0, 10.0]] * 3)
    arm = curves([0.0, 100.0], *[[0.0, 40.0]] * 3)
    found = compute_ratio(arm, base)
    assert found == pytest.approx((0.25, 0.25, 0.25))


def test_the_baseline_itself_needs_its_own_compute_even_if_it_levels_off() -> None:
    """Negative control: a ratio to all of the baseline's compute would be 0.2 here."""
    base = curves([0.0, 20.0, 100.0], [0.0, 10.0, 10.0], [0.0, 30.0, 30.0])
    assert compute_ratio(base, base).value == pytest.approx(1.0)


def test_a_baseline_rises_if_all_seeds_do_and_not_by_noise() -> None:
    """Rises of 8 and 10: mean 9, half of the 95% interval 12.7; with a third of 9 it is 2.5."""
    x = [0.0, 50.0, 100.0]
    assert not has_risen(curves(x, [None, 2.0, 10.0], [2.0, 1.0, 12.0]))
    assert has_risen(curves(x, [None, 2.0, 10.0], [2.0, 1.0, 12.0], [0.0, 0.0, 9.0]))
    assert not has_risen(curves(x, [0.0, 9.0, 9.0]))  # one seed
    assert not has_risen(curves(x, [9.0, 9.0, 0.0], [8.0, 8.0, 0.0], [9.0, 9.0, 1.0]))  # it fell


def test_an_arm_that_does_not_get_there() -> None:
    base = curves([0.0, 100.0], [0.0, 10.0], [0.0, 12.0])
    arm = curves([0.0, 500.0], [0.0, 3.0], [0.0, 5.0])
    assert compute_ratio(arm, base) == (None, None, None)


def test_the_interval_has_as_many_resamples_as_every_other_one() -> None:
    """The protocol of the study `selection` promises 10,000."""
    assert compute.RESAMPLES == 10_000


def test_one_seed_has_no_interval() -> None:
    base, arm = curves([0.0, 100.0], [0.0, 10.0]), curves([0.0, 100.0], [0.0, 20.0])
    assert compute_ratio(arm, base) == (pytest.approx(0.5), None, None)


def test_equal_arms_hold_one_in_their_interval_and_a_faster_one_does_not() -> None:
    """Negative control: seeds of one distribution, of which the arm's are trained for longer."""
    random = np.random.default_rng(0)

    def seeds(end: float) -> Curves:
        x = np.linspace(0, end, 21)
        return curves(list(x), *[list(x * slope) for slope in random.normal(1.0, 0.1, 10)])

    base, arm = seeds(100.0), seeds(200.0)
    same, faster = compute_ratio(arm, base), compute_ratio(Curves(arm.x / 2, arm.y), base)
    assert same.low is not None and same.high is not None and same.low < 1 < same.high
    assert faster.high is not None and faster.high < 1


def test_a_drawn_curve_is_thinned_and_starts_where_all_seeds_have_values() -> None:
    x = list(np.arange(200.0))
    found = drawn(curves(x, [None, *x[1:]], x))
    assert len(found.x) <= GRID and found.x[0] == 1.0 and found.x[-1] == 199.0
    assert np.isfinite(found.y).all()
