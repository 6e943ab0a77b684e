"""How much compute an arm needs to get as far as the baseline gets.

Compute is a count that only grows along a curve: samples through the gradient, or CPU seconds of
the learner or of the whole training. The level to reach is the baseline's mean final return. An
arm's compute is that of the first point where its mean curve is at the level; the baseline's is
found in the same way, so that an arm that is the baseline has the ratio 1, however early the
baseline levels off. A baseline that has not risen above its start gives no level: any arm is there
at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sauna.experiments.statistics import QUANTILES, RESAMPLES, SEED, mean_interval

GRID = 60  # points of a drawn curve at most
# What compute is counted in: the key of a curve, and its name.
AXES = {
    "samples_backward": "samples learned from",
    "learner_cpu_seconds": "CPU seconds of the learner",
    "cpu_seconds": "CPU seconds of the training",
}


class Curves(NamedTuple):
    """The curves of an arm's seeds over compute: `x [X]`, and `y [seeds, X]`, NaN before a seed's
    first return."""

    x: np.ndarray
    y: np.ndarray


class Ratio(NamedTuple):
    """An arm's compute divided by the baseline's; None if the level is not reached.

    An end of the interval is None if so many resamples do not reach the level, or with one seed.
    """

    value: float | None
    low: float | None
    high: float | None


def cumulated(per_iteration: Sequence[float | None]) -> list[float | None]:
    """Adds up from the first iteration; None from the first unknown one on."""
    total: float | None = 0.0
    found: list[float | None] = []
    for value in per_iteration:
        total = None if total is None or value is None else total + value
        found.append(total)
    return found


def learner_seconds(timings: Sequence[dict[str, Any]], member: str) -> dict[int, float]:
    """Returns a member's CPU seconds of the learner in each iteration, where they are known.

    The program is compiled in a run's first iteration, which counts as the second one. Compiling
    again when a run is resumed cannot be separated, and counts.

    Args:
      timings: the rows of `timing.jsonl`.
      member: its name, `sauna/0`.
    """
    return _without_compiling(
        {
            row["iteration"]: float(row["update_cpu_seconds"][member])
            for row in timings
            if member in row.get("update_cpu_seconds", {})
        }
    )


def training_seconds(timings: Sequence[dict[str, Any]], member: str) -> dict[int, float]:
    """Returns a member's CPU seconds of collecting and learning in each iteration, where known.

    What the members of a run do together counts for each of them alike: on the host collecting,
    on the device all.

    Args:
      timings, member: as of `learner_seconds`.
    """
    found = {}
    for row in timings:
        learning = row.get("update_cpu_seconds", {})
        if member in row.get("cpu_seconds", {}):
            found[row["iteration"]] = float(row["cpu_seconds"][member])
        elif member in learning and "collect_cpu_seconds" in row:
            collecting = row["collect_cpu_seconds"] / len(learning)
            found[row["iteration"]] = float(collecting + learning[member])
    return _without_compiling(found)


def _without_compiling(seconds: dict[int, float]) -> dict[int, float]:
    if {0, 1} <= seconds.keys():
        seconds[0] = min(seconds[0], seconds[1])
    return seconds


def joined(curves: Sequence[tuple[Any, Any]]) -> Curves | None:
    """Puts the curves of seeds on all of their points together, linear between a seed's own points.

    A seed that has ended keeps its last return: more compute is not spent on it.

    Args:
      curves: `(x, y)` of each seed; None or NaN where a value is unknown.

    Returns:
      None if some seed has no point at all.
    """
    known = []
    for x, y in curves:
        points = np.array([x, y], float)
        known.append(points[:, np.isfinite(points).all(0)])
    if not known or min(points.shape[1] for points in known) == 0:
        return None
    grid = np.unique(np.concatenate([points[0] for points in known]))
    rows = [np.interp(grid, points[0], points[1], left=np.nan) for points in known]
    return Curves(grid, np.stack(rows))


def reached(x: np.ndarray, mean: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Finds where mean curves `[B, X]` first are at `level [B]` or above it, linear between points.

    Returns:
      `[B]`: infinite where a curve never is; NaN points of a curve are passed over.
    """
    above = mean >= level[:, None]
    first = above.argmax(-1)
    rows = np.arange(len(mean))
    before = np.maximum(first - 1, 0)
    low, high = mean[rows, before], mean[rows, first]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(high > low, (level - low) / (high - low), 1.0)
    found = np.where(
        (first > 0) & np.isfinite(low), x[before] + share * (x[first] - x[before]), x[first]
    )
    return np.where(above.any(-1), found, np.inf)


def has_risen(baseline: Curves) -> bool:
    """Whether the seeds' last returns stand above their first ones by more than their noise: the
    95% interval of the mean rise is above 0. With one seed there is none, and the answer is no.
    """
    first = np.array([seed[np.isfinite(seed)][0] for seed in baseline.y])
    _, low, _ = mean_interval((baseline.y[:, -1] - first)[:, None])
    return bool(low[0] > 0)


def compute_ratio(arm: Curves, baseline: Curves) -> Ratio:
    """Computes the ratio of compute, with a bootstrap interval over the seeds of both arms.

    The percentile interval resamples seeds of either arm, and with them the level. With few seeds
    it is too narrow, and no verdict rests on it.
    """
    value = float(
        _ratios(arm, baseline, *(np.full((1, len(c.y)), 1 / len(c.y)) for c in (arm, baseline)))[0]
    )
    if min(len(arm.y), len(baseline.y)) < 2:
        return Ratio(_finite(value), None, None)
    random = np.random.default_rng(SEED)
    shares = [
        random.multinomial(n, np.full(n, 1 / n), RESAMPLES) / n
        for n in (len(arm.y), len(baseline.y))
    ]
    # No interpolation: between a finite ratio and none there is no value.
    ends = np.quantile(_ratios(arm, baseline, *shares), QUANTILES, method="inverted_cdf")
    return Ratio(_finite(value), *map(_finite, ends))


def _ratios(
    arm: Curves, baseline: Curves, of_arm: np.ndarray, of_baseline: np.ndarray
) -> np.ndarray:
    """Ratios `[B]` of means that give the seeds the weights `[B, seeds]`."""
    level = of_baseline @ baseline.y[:, -1]
    # The last mean is the level itself, up to the order of additions.
    close = level - 1e-9 * np.abs(level)
    own = reached(arm.x, of_arm @ arm.y, close)
    base = reached(baseline.x, of_baseline @ baseline.y, close)
    return own / base


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def drawn(curves: Curves) -> Curves:
    """Thins the curves to at most `GRID` points, and to those where every seed has a value."""
    known = np.isfinite(curves.y).all(0)
    x, y = curves.x[known], curves.y[:, known]
    chosen = np.unique(np.linspace(0, max(len(x) - 1, 0), GRID).astype(int))[: len(x)]
    return Curves(x[chosen], y[:, chosen])
