"""What a handful of seeds can and cannot say.

A score is one number per run, for example its final return. The scores of an arm on a task are a
vector `[n]`, one entry per seed; counts may differ between arms, because a seed can fail. All
intervals are at 95%, and random numbers come from a fixed seed, so that the same scores always
give the same digits.

Seeds are never paired, even where two arms share them: a shared seed fixes the first weights and
the first resets, but the streams part after the first update. Were some likeness left, a test
that ignores it would find too little rather than too much.

References:
  Agarwal et al. (2021), Deep Reinforcement Learning at the Edge of the Statistical Precipice.
  Newcombe (2006), Statistics in Medicine 25, 559-573: an interval for U / (n m).
  Fay and Malinovsky (2018), Statistics in Medicine 37, 3991-4006: intervals that agree with the
    Mann-Whitney test.
  Noether (1987), JASA 82, 645-647: sample sizes.
  Holm (1979), Scandinavian Journal of Statistics 6, 65-70.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its parts are imported when they are used: a mistake is answered before that

ALPHA = 0.05  # two-sided, for tests and intervals alike
POWER = 0.8  # of the test that `seeds_needed` plans
RESAMPLES = 10_000
SEED = 0
QUANTILES = (ALPHA / 2, 1 - ALPHA / 2)
MAX_FAILED = 0.25  # share of an arm's ended seeds that may fail before there is no verdict
EXACT_UP_TO = 100  # runs in both arms together, up to which p values are exact


class Estimate(NamedTuple):
    """A value and its interval; None where fewer than two seeds leave nothing to compute."""

    value: float | None
    low: float | None
    high: float | None


class Comparison(NamedTuple):
    """What the scores of an arm say beside those of the baseline; see `compare`."""

    kind: str  # better, worse, no evidence, underpowered
    improvement: Estimate  # P(arm > baseline)
    p: float  # of the exact test, after Holm's correction
    least: int  # seeds of each below which nothing can be found
    needed: int | None  # seeds of each for a difference as large as the one seen


def iqm(scores: np.ndarray) -> np.ndarray:
    """Computes the interquartile mean over the last axis of `[..., n]` (Agarwal et al. 2021).

    The lowest and highest `floor(n / 4)` are left out, so with fewer than four scores it is the
    plain mean. Tasks may be pooled only where their scores share a scale.
    """
    return scipy.stats.trim_mean(scores, 0.25, axis=-1)


def iqm_estimate(strata: Sequence[np.ndarray]) -> Estimate:
    """Computes the IQM of the pooled scores, with a stratified bootstrap interval.

    Seeds are drawn with replacement within each task, so that every resample holds all tasks.
    Percentile intervals as in rliable. BCa was measured and covers no better at 3 to 10 seeds.
    Both are too narrow there: on normal scores of one task the percentile interval holds the true
    IQM in 76% of trials with 3 seeds, 91% with 6, 93% with 10, 94% with 30
    (`results/intervals.json`). No verdict rests on it.

    Args:
      strata: a vector of scores per task.
    """
    value = float(iqm(np.concatenate(strata)))
    if min(map(len, strata)) < 2:
        return Estimate(value, None, None)
    random = np.random.default_rng(SEED)
    drawn = [
        scores[random.integers(len(scores), size=(RESAMPLES, len(scores)))] for scores in strata
    ]
    low, high = np.quantile(iqm(np.concatenate(drawn, -1)), QUANTILES)
    return Estimate(value, float(low), float(high))


def performance_profile(
    scores: np.ndarray, thresholds: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes the share of runs with `score >= threshold`, and the ends of its bootstrap band.

    The number of resampled runs above a threshold is binomial, so the band is computed rather than
    drawn. It holds pointwise and shrinks to nothing where all runs or none reach the threshold,
    which is no certainty.

    Returns:
      share, low, high: `[X]` each; low and high are NaN with fewer than two scores `[n]`.
    """
    share = (scores[:, None] >= thresholds).mean(0)
    if len(scores) < 2:
        return share, np.full_like(share, np.nan), np.full_like(share, np.nan)
    low, high = (scipy.stats.binom.ppf(q, len(scores), share) / len(scores) for q in QUANTILES)
    return share, low, high


def wins(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns `[n, m]`: 1 where `x_i > y_j`, 1/2 where they are equal, else 0."""
    return (x[:, None] > y) + 0.5 * (x[:, None] == y)


def improvement(x: np.ndarray, y: np.ndarray) -> float:
    """Estimates P(X > Y) + P(X = Y) / 2 by Mann and Whitney's `U / (n m)`."""
    return float(wins(x, y).mean())


def improvement_estimate(x: np.ndarray, y: np.ndarray) -> Estimate:
    """Estimates P(X > Y) on one task, with an interval that agrees with the Mann-Whitney test.

    The ends are the values `t` that lie `z sd(t) + 1 / (2 n m)` from the estimate, where
    `sd(t)^2 = t (1 - t) (1 + k (1 - t) / (2 - t) + k t / (1 + t)) / (n m)`, `k = (n + m) / 2 - 1`
    (Newcombe's method 5). At `t = 1/2` that is the variance of U under equal distributions, and
    the last term is the test's correction for continuity, so 1/2 lies outside where the test
    rejects it. A bootstrap would be the usual choice, but for normal scores 0 to 2 standard
    deviations apart its interval holds the true value in 36% to 80% of trials with 3 seeds of
    each and 71% to 94% with 6; this one in 95% or more of either (`results/intervals.json`).
    """
    value = improvement(x, y)
    if min(len(x), len(y)) < 2:
        return Estimate(value, None, None)
    return Estimate(value, *_score_interval(value, len(x), len(y)))


def _score_interval(value: float, n: int, m: int) -> tuple[float, float]:
    """Newcombe's method 5 with a correction for continuity; P(Y > X) gives the mirror image."""
    return _lower_end(value, n, m), 1 - _lower_end(1 - value, n, m)


def _lower_end(value: float, n: int, m: int) -> float:
    top = value - 0.5 / (n * m)
    if top <= 0:
        return 0.0
    k = (n + m) / 2 - 1
    z = scipy.special.ndtri(1 - ALPHA / 2)

    def excess(t: float) -> float:
        variance = t * (1 - t) * (1 + k * ((1 - t) / (2 - t) + t / (1 + t))) / (n * m)
        return top - t - z * math.sqrt(variance)

    return float(scipy.optimize.brentq(excess, 0.0, top))


def bootstrap_improvement(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Computes the stratified bootstrap interval of P(X > Y) averaged over tasks, as rliable
    computes it.

    Each arm's seeds are redrawn within each task. `counts` says how often each was drawn, which
    makes a resampled U one matrix product.

    Args:
      pairs: `(x [n], y [m])` per task, two seeds or more of each.
    """
    random = np.random.default_rng(SEED)
    total = np.zeros(RESAMPLES)
    for x, y in pairs:
        n, m = len(x), len(y)
        counts_x = random.multinomial(n, np.full(n, 1 / n), RESAMPLES)
        counts_y = random.multinomial(m, np.full(m, 1 / m), RESAMPLES)
        total += ((counts_x @ wins(x, y)) * counts_y).sum(1) / (n * m)
    low, high = np.quantile(total / len(pairs), QUANTILES)
    return float(low), float(high)


def improvement_over_tasks(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Estimate:
    """Estimates P(X > Y) averaged over tasks, each end of the interval the wider of two.

    The bootstrap is too narrow with few seeds and tasks, and calls it certain where every run of
    one arm wins. The other interval adds up those of the tasks (Zou and Donner 2008),
    `low = mean - sqrt(sum (p_i - low_i)^2) / tasks`, and is too narrow with many tasks and skewed
    scores. The tasks are those studied, not a sample of others.
    """
    parts = [improvement(x, y) for x, y in pairs]
    value = float(np.mean(parts))
    if min(min(len(x), len(y)) for x, y in pairs) < 2:
        return Estimate(value, None, None)
    ends = [_score_interval(p, len(x), len(y)) for p, (x, y) in zip(parts, pairs, strict=True)]
    below = math.hypot(*(p - low for p, (low, _) in zip(parts, ends, strict=True))) / len(pairs)
    above = math.hypot(*(high - p for p, (_, high) in zip(parts, ends, strict=True))) / len(pairs)
    low, high = bootstrap_improvement(pairs)
    return Estimate(value, max(0.0, min(low, value - below)), min(1.0, max(high, value + above)))


def exact_p(x: np.ndarray, y: np.ndarray) -> float:
    """Computes the two-sided p value of the Mann-Whitney test, exact with ties as without.

    The chance, over all ways to split the pooled ranks between the two arms, of a rank sum at least
    as far from its mean as the one seen. It supposes equal distributions, not merely
    P(X > Y) = 1/2. Above `EXACT_UP_TO` runs, scipy's normal approximation.
    """
    n, m = len(x), len(y)
    if min(n, m) == 0:
        return 1.0
    twice_ranks = np.rint(2 * scipy.stats.rankdata(np.concatenate([x, y]))).astype(int)
    if len(set(twice_ranks)) == 1:
        return 1.0
    if n + m > EXACT_UP_TO:
        return float(scipy.stats.mannwhitneyu(x, y, method="asymptotic").pvalue)
    chances = _rank_sum_chances(tuple(sorted(twice_ranks.tolist())), n)
    distance = np.abs(np.arange(len(chances)) - n * (n + m + 1))
    return min(1.0, float(chances[distance >= distance[twice_ranks[:n].sum()]].sum()))


@functools.lru_cache(maxsize=64)
def _rank_sum_chances(twice_ranks: tuple[int, ...], n: int) -> np.ndarray:
    """`[S]`: chance that `n` of the ranks, drawn without replacement, add up to each sum.

    Doubled ranks are whole numbers, ties or not. `ways[i, s]` counts the subsets of size i.
    """
    ways = np.zeros((n + 1, sum(twice_ranks) + 1))
    ways[0, 0] = 1
    for rank in twice_ranks:
        ways[1:, rank:] += ways[:-1, :-rank]
    return ways[n] / math.comb(len(twice_ranks), n)


def holm(p_values: Sequence[float]) -> list[float]:
    """Applies Holm's step-down correction: rejecting below `ALPHA`, any false rejection has at most
    that chance, whatever the number of tests."""
    p = np.asarray(p_values, float)
    order = np.argsort(p, kind="stable")
    corrected = np.empty_like(p)
    corrected[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return [float(x) for x in np.minimum(1, corrected)]


def least_seeds(comparisons: int) -> int:
    """Returns the seeds of each arm from which `comparisons` tests can reject at all.

    `2 / C(2n, n)` is the smallest two-sided p value of `n` against `n`.
    """
    return next(n for n in itertools.count(2) if comparisons * 2 / math.comb(2 * n, n) < ALPHA)


def seeds_needed(chance: float, comparisons: int = 1, power: float = POWER) -> int | None:
    """Computes the seeds of each arm with which the test finds a true P(X > Y) of `chance`.

    `n = (z_{1 - alpha/2} + z_power)^2 / (6 (chance - 1/2)^2)` (Noether 1987, equal groups), with
    alpha split over the comparisons. A normal approximation, rough below ten seeds; and an
    observed chance is itself uncertain, so the number is no more than an order of magnitude.

    Returns:
      None where `chance` is 1/2: no number of seeds finds a difference that is not there.
    """
    if chance == 0.5:
        return None
    z = scipy.special.ndtri(1 - ALPHA / comparisons / 2) + scipy.special.ndtri(power)
    return max(math.ceil(z**2 / (6 * (chance - 0.5) ** 2)), least_seeds(comparisons))


def compare(pairs: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, Comparison]:
    """Compares the scores of two arms, for each of a family of questions.

    A family is other arms on one task, or one arm on other tasks. A score of -inf is the worst
    outcome, as of a failed seed.

    `better` and `worse` need both: the exact test below `ALPHA` after Holm's correction over the
    family, and an interval that leaves 1/2 out. Where both have equal distributions, of whatever
    shape, that is wrong with a chance of at most `ALPHA`. Where only their spreads differ it is
    wrong a little more often: in 6% to 8% of trials with 6 to 30 seeds of each and a spread five
    times the other, in 11% to 13% where the arm of lesser spread also has twice the seeds.

    `underpowered`: not even perfectly parted scores would pass. `needed` is None if a single seed,
    or no difference, is all there is.

    Args:
      pairs: name -> the scores of an arm `[n]` and of its baseline `[m]`, possibly empty.
    """
    p_values = holm([exact_p(x, y) for x, y in pairs.values()])
    lowest = holm([2 / math.comb(len(x) + len(y), len(x)) for x, y in pairs.values()])
    return {
        name: _comparison(x, y, p, lowest_p, len(pairs))
        for (name, (x, y)), p, lowest_p in zip(pairs.items(), p_values, lowest, strict=True)
    }


def _comparison(x: np.ndarray, y: np.ndarray, p: float, lowest_p: float, family: int) -> Comparison:
    n, m = len(x), len(y)
    if min(n, m) == 0:
        return Comparison("underpowered", Estimate(None, None, None), p, least_seeds(family), None)
    estimate = improvement_estimate(x, y)
    needed = None if estimate.low is None else seeds_needed(improvement(x, y), family)
    reachable = lowest_p < ALPHA and _lower_end(1.0, n, m) > 0.5
    kind = _kind(estimate, p) if reachable else "underpowered"
    return Comparison(kind, estimate, p, least_seeds(family), needed)


def _kind(estimate: Estimate, p: float) -> str:
    if p >= ALPHA or estimate.low is None or estimate.high is None:
        return "no evidence"
    if estimate.low > 0.5:
        return "better"
    return "worse" if estimate.high < 0.5 else "no evidence"


def mean_interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes the mean over members of `[P, X]` and its interval at each point, by Student's t.

    A bootstrap of 3 to 6 members is too narrow even for normal values, where t is right. Nothing
    helps where few runs stand far above the rest, as the members seen may hold none of them: with
    one in five 10 standard deviations above, it holds the true mean in 77% of trials with 3
    members or 6, 90% with 10 (`results/intervals.json`).
    NaN where any member has no value; the ends also with one member.
    """
    number = len(values)
    mean = values.mean(0)
    if number < 2:
        return mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    half = scipy.stats.t.isf(ALPHA / 2, number - 1) * values.std(0, ddof=1) / math.sqrt(number)
    return mean, mean - half, mean + half
