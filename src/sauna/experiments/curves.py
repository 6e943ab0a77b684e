"""Learning curves as numbers: their AUC, and a grid that all of them have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def area_under_curve(env_steps: np.ndarray, values: np.ndarray) -> float | None:
    """Computes the area under a curve over env steps by trapezoids, divided by their range (AUC).

    It runs from the first finite value to the last one; what came before the first finished
    episode is unknown and does not count as 0. Gaps between are bridged by straight lines.

    Returns:
      None with fewer than two finite values.

    Raises:
      ValueError: env steps do not rise.
    """
    if np.any(np.diff(env_steps) <= 0):
        raise ValueError("env steps must rise from point to point")
    known = np.isfinite(values)
    x, y = env_steps[known], values[known]
    if len(x) < 2:
        return None
    return float((np.diff(x) * (y[1:] + y[:-1]) / 2).sum() / (x[-1] - x[0]))


def common_grid(env_steps: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Returns env steps `[X]`, at most `most`, that lie within every member's curve.

    Where all members were measured at the same steps it is those, and nothing is interpolated.
    """
    first = env_steps[0] if env_steps else np.zeros(0)
    if len(first) <= most and all(np.array_equal(first, other) for other in env_steps):
        return first
    if min(map(len, env_steps)) == 0:
        return np.zeros(0)
    start, end = max(x[0] for x in env_steps), min(x[-1] for x in env_steps)
    if start > end:
        return np.zeros(0)
    return np.unique(np.linspace(start, end, min(most, min(map(len, env_steps)))).round())


def on_grid(env_steps: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Returns a curve at the points of `grid`, linear between finite values and NaN outside
    them."""
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(grid), np.nan)
    return np.interp(grid, env_steps[known], values[known], left=np.nan, right=np.nan)
