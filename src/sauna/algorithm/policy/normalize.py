"""Running moments of observations and returns, as in baselines' `VecNormalize`.

The functions work on numpy and JAX arrays alike, and on any number of leading axes (a population
on the host is one array). Long sums need more than float32: on the host the moments are float64,
on the device each is a float32 and what rounding has lost of it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
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
      batch: `[..., N, >= D]`, of which the first D numbers are seen.
      active: `[..., N]` bool; other rows count for nothing. Where none is, nothing changes.
    """
    batch_mean, batch_variance, number = _moments_of(_with_moments(batch, moments)[0], active)
    total = moments.count + number
    fraction = number / total
    delta = batch_mean - moments.mean
    move = delta * fraction
    variance = (moments.variance + delta * move) * (moments.count / total)
    return Moments(moments.mean + move, variance + batch_variance * fraction, total)


def _moments_of(batch: Any, active: Any) -> Moments:
    """Mean, variance and number of the active rows of a batch; see `update_moments`."""
    weight = active[..., None]
    number = weight.sum(-2)
    divisor = number + (number == 0)
    mean = (batch * weight).sum(-2) / divisor
    deviation = (batch - mean[..., None, :]) * weight
    return Moments(mean, (deviation**2).sum(-2) / divisor, number)


class LongMoments(NamedTuple):
    """Moments in float32 that stay right over 10^10 samples.

    A float32 count stops at 2^24, and a variance that is scaled by `n / (n + 1)` stops decaying
    before that. Here each moment only has a small increment added, and `*_lost` holds what the
    rounding of all additions so far has left out (Kahan 1965).
    """

    mean: Any
    variance: Any
    count: Any
    mean_lost: Any
    variance_lost: Any
    count_lost: Any

    @property
    def moments(self) -> Moments:
        """The moments to normalise with, to float32's precision."""
        return Moments(self.mean, self.variance, self.count)


def long_moments(moments: Moments) -> LongMoments:
    """The same, with nothing lost so far."""
    return LongMoments(*moments, *(0.0 * part for part in moments))


def _add(moments: LongMoments, mean: Any, variance: Any, count: Any) -> LongMoments:
    """Moments after adding an increment to each."""
    sums, lost = [], []
    for total, before, increment in zip(
        moments[:3], moments[3:], (mean, variance, count), strict=True
    ):
        more = before + increment
        after = total + more
        sums.append(after)
        lost.append(more - (after - total))
    return LongMoments(*sums, *lost)


def update_long_moments(moments: LongMoments, batch: Any, active: Any) -> LongMoments:
    """`update_moments`, by increments: with `f = n_b / (n_a + n_b)` and `d = mean_b - mean_a`,

    `mean += f d` and `var += f (var_b - var_a + (1 - f) d^2)`.
    """
    batch_mean, batch_variance, number = _moments_of(_with_moments(batch, moments)[0], active)
    fraction = number / (moments.count + number)
    delta = batch_mean - moments.mean
    spread = batch_variance - moments.variance + (1.0 - fraction) * delta**2
    return _add(moments, fraction * delta, fraction * spread, 1.0 * number)


def normalize(moments: Moments, batch: Any, clip: float) -> Any:
    """`clip((x - mean) / sqrt(var + eps), +-clip)` of the first D numbers of `[..., N, >= D]`."""
    mean, variance = moments.mean[..., None, :], moments.variance[..., None, :]
    first, rest = _with_moments(batch, moments)
    scaled = ((first - mean) / (variance + EPSILON) ** 0.5).clip(-clip, clip)
    if rest is None:
        return scaled
    library = np if isinstance(batch, np.ndarray) else jnp
    return library.concatenate([scaled, rest.astype(scaled.dtype)], -1)


def _with_moments(batch: Any, moments: Moments | LongMoments) -> tuple[Any, Any]:
    """The first D numbers, which have moments, and the rest; None if there is none."""
    size = moments.mean.shape[-1]
    if batch.shape[-1] == size:
        return batch, None
    return batch[..., :size], batch[..., size:]


def moments_after_each(moments: Moments, values: Any, valid: Any) -> Moments:
    """Moments after each row of `values` `[S, N]` has entered where `valid`; fields `[S]`.

    The sums are taken about the mean so far: `var = (n0 var0 + sum d^2) / n - (sum d / n)^2`.

    Args:
      moments: scalars.
    """
    _, count, shift, squares = _sums_about_mean(moments, values, valid)
    square = moments.count * moments.variance + squares
    return Moments(moments.mean + shift, (square / count - shift**2).clip(0.0), count)


def _sums_about_mean(
    moments: Moments | LongMoments, values: Any, valid: Any
) -> tuple[Any, Any, Any, Any]:
    """After each row of `values` `[S, N]`, `[S]` each: samples seen in the rows and in all, how far
    the mean has moved, and the sum of squares about the mean before."""
    deviation = (values - moments.mean) * valid
    number = valid.sum(1).cumsum()
    count = moments.count + number
    return number, count, deviation.sum(1).cumsum() / count, (deviation**2).sum(1).cumsum()


def long_moments_after_all(
    moments: LongMoments, values: Any, valid: Any
) -> tuple[Moments, LongMoments]:
    """`moments_after_each`, by increments, and what the next rollout starts from.

    With `k` samples so far: `var += (sum d^2 - k var) / n - (sum d / n)^2`.

    Args:
      moments: scalars.
    """
    number, count, shift, squares = _sums_about_mean(moments, values, valid)
    spread = (squares - number * moments.variance) / count - shift**2
    each = Moments(moments.mean + shift, (moments.variance + spread).clip(0.0), count)
    return each, _add(moments, shift[-1], spread[-1], 1.0 * number[-1])


def scale_rewards(moments: Moments, reward: Any, clip: float) -> Any:
    """`clip(r / sqrt(var + eps), +-clip)` of `[S, N]`, by the moments after each row `[S]`."""
    return (reward / (moments.variance + EPSILON)[:, None] ** 0.5).clip(-clip, clip)
