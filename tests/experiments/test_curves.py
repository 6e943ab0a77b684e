"""Curves as numbers: hand arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from sauna.experiments.curves import area_under_curve, common_grid, on_grid


def test_area_by_hand() -> None:
    x = np.array([0.0, 10.0, 30.0])
    assert area_under_curve(x, np.array([0.0, 2.0, 4.0])) == (10 + 60) / 30
    assert area_under_curve(x * 7 + 5, np.full(3, 3.5)) == 3.5


def test_area_begins_with_the_first_known_value_and_bridges_gaps() -> None:
    x = np.array([0.0, 1.0, 2.0, 4.0, 5.0])
    y = np.array([np.nan, 1.0, np.nan, 4.0, np.nan])
    assert area_under_curve(x, y) == 2.5
    assert area_under_curve(x, np.full(5, np.nan)) is None
    assert area_under_curve(x[:1], y[1:2]) is None
    with pytest.raises(ValueError, match="rise"):
        area_under_curve(np.array([0.0, 0.0]), np.ones(2))


def test_common_grid() -> None:
    same = np.array([1.0, 2.0, 5.0])
    assert common_grid([same, same], 60) is same
    grid = common_grid([np.arange(0.0, 100, 10), np.arange(25.0, 200, 10)], 60)
    assert grid[0] == 25 and grid[-1] == 90 and len(grid) <= 10 and (np.diff(grid) > 0).all()
    assert len(common_grid([np.arange(500.0), np.arange(500.0)], 60)) == 60
    assert len(common_grid([np.array([1.0, 2]), np.array([3.0, 4])], 60)) == 0
    assert len(common_grid([same, np.zeros(0)], 60)) == len(common_grid([], 60)) == 0


def test_interpolation_never_extrapolates() -> None:
    x, y = np.array([0.0, 1, 2, 3]), np.array([np.nan, 10, np.nan, 30])
    got = on_grid(x, y, np.array([0, 0.9, 1, 1.5, 3, 3.1]))
    np.testing.assert_array_equal(got, [np.nan, np.nan, 10, 15, 30, np.nan])
    assert np.isnan(on_grid(x, np.full(4, np.nan), x)).all()
