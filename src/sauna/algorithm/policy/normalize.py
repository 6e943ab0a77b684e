"""Running moments of observations and returns, as in baselines' `VecNormalize`.

The functions work on numpy and JAX arrays alike, and on any number of leading axes (a population
on the host is one array); on the host the moments are float64, which 10^6 additions need.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

EPSILON = 1e-8  # added to the variance before the square root, as VecNormalize does


class Moments(NamedTuple):
    """Mean and variance `[..., D]` of `count` samples `[..., 1]`."""

    mean: Any
    variance: Any
    count: Any


def initial_moments(lead: tuple[int, ...], size: int) -> Moments:
    """Mean 0, variance 1 and a count of 1e-4, `RunningMeanStd`'s start."""
    shape = (*lead, size)
    return Moments(np.zeros(shape), np.ones(shape), np.full((*lead, 1), 1e-4))


def update_moments(moments: Moments, batch: Any, active: Any) -> Moments:
    """Moments after also seeing those rows of `batch` that are active.

    Chan, Golub and LeVeque's pairwise formula:
    `M2 = var_a n_a + var_b n_b + (mean_b - mean_a)^2 n_a n_b / (n_a + n_b)`.

    Args:
      moments: of `[..., D]`.
      batch: `[..., N, D]`.
      active: `[..., N]` bool; other rows count for nothing. Where none is, nothing changes.
    """
    weight = active[..., None]
    number = weight.sum(-2)
    divisor = number + (number == 0)
    batch_mean = (batch * weight).sum(-2) / divisor
    deviation = (batch - batch_mean[..., None, :]) * weight
    batch_variance = (deviation**2).sum(-2) / divisor
    total = moments.count + number
    fraction = number / total
    delta = batch_mean - moments.mean
    move = delta * fraction
    variance = (moments.variance + delta * move) * (moments.count / total)
    return Moments(moments.mean + move, variance + batch_variance * fraction, total)


def normalize(moments: Moments, batch: Any, clip: float) -> Any:
    """`clip((x - mean) / sqrt(var + eps), +-clip)` of `[..., N, D]`."""
    mean, variance = moments.mean[..., None, :], moments.variance[..., None, :]
    return ((batch - mean) / (variance + EPSILON) ** 0.5).clip(-clip, clip)


def moments_after_each(moments: Moments, values: Any, valid: Any) -> Moments:
    """Moments after each row of `values` `[S, N]` has entered where `valid`; fields `[S]`.

    The sums are taken about the mean so far: `var = (n0 var0 + sum d^2) / n - (sum d / n)^2`.

    Args:
      moments: scalars.
    """
    deviation = (values - moments.mean) * valid
    count = moments.count + valid.sum(1).cumsum()
    shift = deviation.sum(1).cumsum() / count
    square = moments.count * moments.variance + (deviation**2).sum(1).cumsum()
    return Moments(moments.mean + shift, (square / count - shift**2).clip(0.0), count)


def scale_rewards(moments: Moments, reward: Any, clip: float) -> Any:
    """`clip(r / sqrt(var + eps), +-clip)` of `[S, N]`, by the moments after each row `[S]`."""
    return (reward / (moments.variance + EPSILON)[:, None] ** 0.5).clip(-clip, clip)
