"""How noisy minibatch gradients are, and where they point: estimates with intervals.

A minibatch gradient `h` of one group (say, of kept steps) has a mean `g` and a covariance `C`. From
independent streams, each with some minibatches of every group, follow without bias

    signal    |g|^2: products of gradients of *different* streams
    variance  trace C = E |h|^2 - |g|^2
    snr       |g|^2 / trace C

    snr_per_env_step    snr times the samples that an env step yields: where steps are dropped, a
              batch of the same size takes more of them

and, against the streams of an independent half, whose gradients of all steps have the mean `r`,

    cosine     mean of cos(h, R), R the mean of the reference streams: noise and bias together
    alignment  cos(g, r) = g r / (|g| |r|): what is left of `cosine` with endless minibatches, bias
               alone; from products of independent streams, so it can come out above 1

Intervals are percentile bootstraps over streams, because the steps of a stream are not independent.
A resample that drew a stream twice never multiplies it with itself. `cosine` is taken against the
reference as it is: its noise lowers the cosines of all groups by one factor, `reliability`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

RESAMPLES = 1000
QUANTILES = (0.025, 0.975)
SEED = 0


class Gradients(NamedTuple):
    """Minibatches of `X` groups from each of `B` streams, and `C` reference streams."""

    mean: np.ndarray  # [B, X, D] mean minibatch gradient of a stream's group
    power: np.ndarray  # [B, X] mean of |h|^2
    cosine: np.ndarray  # [B, X] mean of cos(h, R)
    reference: np.ndarray  # [C, D] gradient of all steps of each reference stream
    rate: np.ndarray  # [B, X] samples that one env step yields


def estimate(
    gradients: Gradients, groups: tuple[str, ...], pairs: tuple[tuple[str, str], ...]
) -> dict[str, Any]:
    """Returns every estimate of every group, and differences between the `pairs` of groups.

    Returns:
      `{"groups": {group: {name: [value, low, high]}}, "differences": {"a - b": {...}},
      "reliability": value}`, with None for what cannot be computed.
    """
    random = np.random.default_rng(SEED)
    streams, references = len(gradients.mean), len(gradients.reference)
    # The first row is the estimate itself: every stream once.
    w, v = (
        np.concatenate([np.ones((1, n)), random.multinomial(n, np.full(n, 1 / n), RESAMPLES)])
        for n in (streams, references)
    )
    of_reference = _product(gradients.reference @ gradients.reference.T, v)
    found = {
        group: _group(gradients, place, w, v, of_reference) for place, group in enumerate(groups)
    }
    differences = {
        f"{a} - {b}": {
            "cosine": found[a]["cosine"] - found[b]["cosine"],
            "snr": found[a]["snr"] - found[b]["snr"],
            "snr_per_env_step": found[a]["snr_per_env_step"] - found[b]["snr_per_env_step"],
            "variance_ratio": found[a]["variance"] / found[b]["variance"],
        }
        for a, b in pairs
    }
    length = float(np.sum(gradients.reference.mean(0) ** 2))
    return {
        "groups": {name: _with_intervals(values) for name, values in found.items()},
        "differences": {name: _with_intervals(values) for name, values in differences.items()},
        "reliability": _root(of_reference[:1] / length)[0] if of_reference[0] > 0 else None,
    }


def _group(
    gradients: Gradients, place: int, w: np.ndarray, v: np.ndarray, of_reference: np.ndarray
) -> dict[str, np.ndarray]:
    """Estimates `[1 + RESAMPLES]` of one group."""
    mean, total = gradients.mean[:, place], w.sum(1)
    signal = _product(mean @ mean.T, w)
    variance = w @ gradients.power[:, place] / total - signal
    across = ((w @ (mean @ gradients.reference.T)) * v).sum(1) / (total * v.sum(1))
    return {
        "cosine": w @ gradients.cosine[:, place] / total,
        "snr": signal / variance,
        "snr_per_env_step": signal / variance * (w @ gradients.rate[:, place] / total),
        "variance": variance,
        "signal": signal,
        "alignment": across / _root(signal * of_reference, of_reference > 0),
    }


def _product(gram: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Mean of `gram[b, c]` over pairs of different streams, drawn `w` `[R, B]` times: `[R]`."""
    squares = w**2
    all_pairs = ((w @ gram) * w).sum(1) - squares @ np.diag(gram)
    return all_pairs / (w.sum(1) ** 2 - squares.sum(1))


def _root(x: np.ndarray, fine: np.ndarray | bool = True) -> np.ndarray:
    """Square root, NaN where there is none."""
    return np.sqrt(np.where((x > 0) & fine, x, np.nan))


def _with_intervals(values: dict[str, np.ndarray]) -> dict[str, list[float | None]]:
    """`[value, low, high]` of each; no interval where more than a few resamples have no value."""
    found: dict[str, list[float | None]] = {}
    for name, x in values.items():
        known = x[1:][np.isfinite(x[1:])]
        low, high = (None, None)
        if len(known) >= 0.975 * RESAMPLES:
            low, high = (float(q) for q in np.quantile(known, QUANTILES))
        found[name] = [float(x[0]) if np.isfinite(x[0]) else None, low, high]
    return found
