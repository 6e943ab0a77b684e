"""What each rule of sample selection has to compute: float64 numpy, one function per rule.

`M` rows of a rollout. `advantage` is raw GAE unless a parameter says `standardised`; `error` is
`returns - value` at collection; `log_prob0` belongs to the policy that acted, `log_prob` to the one
of now. A rule returns the mask of the rows that stay, probabilities to draw by, or weights. Where
scores tie, the lower row wins. Losses, gradients and stopping rules are in `oracle_loss`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

Array = np.ndarray


def floats(*arrays: object) -> list[Array]:
    return [np.asarray(array, np.float64) for array in arrays]


# ------------------------------------------------------------------ sums, counts and ranks


def standardise(advantage: Array, epsilon: float = 1e-8) -> Array:
    """Centres and scales over all rows: `(A - mean A) / (std A + eps)`, population std."""
    (a,) = floats(advantage)
    return (a - a.mean()) / (a.std() + epsilon)


def weighted_mean(term: Array, weight: Array) -> float:
    """Divides by the sum of the weights: `sum w l / sum w`; 0 where every weight is 0."""
    term, weight = floats(term, weight)
    total = weight.sum()
    return float((weight * term).sum() / total) if total > 0 else 0.0


def importance_mean(term: Array, weight: Array) -> float:
    """Divides by the number of draws: `sum w l / K`.

    With `w = 1 / (N p)` its mean over draws is the plain mean of all rows; `weighted_mean`, the
    self-normalised form, only tends to it as K grows.
    """
    term, weight = floats(term, weight)
    return float((weight * term).sum() / len(term))


def effective_sample_size(weight: Array) -> float:
    """Counts the equal weights that would vary as much: `(sum w)^2 / sum w^2` (Kish 1965)."""
    (weight,) = floats(weight)
    squares = (weight**2).sum()
    return float(weight.sum() ** 2 / squares) if squares > 0 else 0.0


def kept_count(share: float, number: int) -> int:
    """Rounds up, `ceil(share * number)`, not for a float product's last bit; at least 1."""
    return min(number, max(1, math.ceil(share * number - 1e-6)))


def largest(score: Array, count: int) -> Array:
    """Marks the `count` rows of largest score."""
    (score,) = floats(score)
    keep = np.zeros(len(score), bool)
    keep[np.argsort(-score, kind="stable")[:count]] = True
    return keep


# ------------------------------------------------------------------ rules on the advantage


def gigaflow_keep(
    advantage: Array, maximum_before: float | None, threshold: float = 0.01, rate: float = 0.25
) -> tuple[Array, float]:
    """Drops rows far below the running largest advantage (Cusumano-Towner et al. 2025, Alg. 1).

    `M <- max|A|` in the first rollout (`maximum_before=None`), later `rate max|A| + (1 - rate) M`;
    a row stays where `|A| >= threshold M`, M the new one. Returns the mask and M.
    """
    (a,) = floats(advantage)
    now = float(np.abs(a).max())
    maximum = now if maximum_before is None else rate * now + (1 - rate) * maximum_before
    return np.abs(a) >= threshold * maximum, maximum


def top_advantage_keep(advantage: Array, share: float, leaked: Array | None = None) -> Array:
    """Keeps the `ceil(share M)` rows of largest `|A|`, and of the others those that leak."""
    (a,) = floats(advantage)
    keep = largest(np.abs(a), kept_count(share, len(a)))
    return keep if leaked is None else keep | np.asarray(leaked, bool)


def prioritized_probabilities(advantage: Array, power: float = 0.8, floor: float = 1e-6) -> Array:
    """Draws by size: `p = (|A| + floor)^power / sum` (after Schaul et al. 2016, eq. 1)."""
    (a,) = floats(advantage)
    scaled = (np.abs(a) + floor) ** power
    return scaled / scaled.sum()


def prioritized_weights(probability: Array, correction: float) -> Array:
    """Weakens what is drawn often: `(N p)^-correction`, divided by its mean over draws.

    At `correction = 1` that is the unbiased weight."""
    (p,) = floats(probability)
    weight = (len(p) * p) ** -correction
    return weight / np.average(weight, weights=p)


def positive_advantage(advantage: Array, epsilon: float = 1e-8) -> Array:
    """Cuts off what is worse than expected: `max(0, A) / std(A)`, not centred, std of the uncut A
    (Jesson et al. 2023, arXiv 2306.01460)."""
    (a,) = floats(advantage)
    return np.maximum(0.0, a) / (a.std() + epsilon)


def positive_keep(advantage: Array) -> Array:
    """Keeps for the policy the rows with `A > 0`; the critic sees all."""
    return np.asarray(advantage, np.float64) > 0


# ------------------------------------------------------------------ drawing by a gradient's norm


def gaussian_gradient_norm(
    standardised: Array, action: Array, mean: Array, std: Array, hidden: Array
) -> Array:
    """Measures each row's surrogate gradient at the policy head, at ratio 1.

    The head is `mean = W h + b` and a log-std per action that no state changes. With
    `z = (a - mean) / std`: `g = |A^| sqrt(sum_j (z_j/std_j)^2 (|h|^2 + 1) + sum_j (z_j^2 - 1)^2)`,
    the Euclidean norm over W, b and log-std. `action`, `mean` `[M, D]`, `std` `[D]` or `[M, D]`,
    `hidden` `[M, H]`.
    """
    a, action, mean, std, h = floats(standardised, action, mean, std, hidden)
    z = (action - mean) / std
    weights_and_bias = ((z / std) ** 2).sum(-1) * ((h**2).sum(-1) + 1)
    return np.abs(a) * np.sqrt(weights_and_bias + ((z**2 - 1) ** 2).sum(-1))


def categorical_gradient_norm(
    standardised: Array, action: Array, probability: Array, hidden: Array
) -> Array:
    """Measures each row's surrogate gradient at a softmax head, at ratio 1.

    `g = |A^| sqrt(1 - 2 pi_a + sum_i pi_i^2) sqrt(|h|^2 + 1)`; `probability` `[M, actions]`.
    """
    a, pi, h = floats(standardised, probability, hidden)
    taken = pi[np.arange(len(pi)), np.asarray(action)]
    logits = np.sqrt(1 - 2 * taken + (pi**2).sum(-1))
    return np.abs(a) * logits * np.sqrt((h**2).sum(-1) + 1)


def mixed_probabilities(score: Array, uniform: float = 0.1) -> Array:
    """Draws by score, with a floor under every row: `(1 - uniform) g / sum g + uniform / N`.

    Uniform where every score is 0. For the value loss the score is `|error|`.
    """
    (g,) = floats(score)
    if g.sum() == 0:
        return np.full(len(g), 1 / len(g))
    return (1 - uniform) * g / g.sum() + uniform / len(g)


def importance_weights(probability: Array) -> Array:
    """Undoes the drawing exactly: `1 / (N p)` (Katharopoulos & Fleuret 2018)."""
    (p,) = floats(probability)
    return 1 / (len(p) * p)


# ------------------------------------------------------------------ delight


def surprisal(log_prob: Array, entropy: Array | None = None, bound: float = 10.0) -> Array:
    """Says how unlikely the action was: `-log_prob`, clipped to `+-bound`.

    A density's is negative where the policy is narrow: pass its `entropy` and it is subtracted,
    before the clipping, so that the mean is 0 and the unit of the action no longer matters.
    """
    (lp,) = floats(log_prob)
    centre = 0.0 if entropy is None else np.asarray(entropy, np.float64)
    return np.clip(-lp - centre, -bound, bound)


def delight_weight(
    standardised: Array,
    log_prob: Array,
    entropy: Array | None = None,
    temperature: float = 1.0,
    bound: float = 10.0,
) -> Array:
    """Strengthens rare and good, weakens rare and bad (Osband 2026, arXiv 2603.14608).

    `2 sigmoid(chi / temperature)`, `chi = A^ surprisal`, a constant for the gradient. The paper's
    gate has no factor 2, which here makes a row without delight weigh 1.
    """
    chi = np.asarray(standardised, np.float64) * surprisal(log_prob, entropy, bound)
    return 1 + np.tanh(chi / (2 * temperature))


def kondo_keep(
    standardised: Array,
    log_prob: Array,
    share: float = 0.3,
    entropy: Array | None = None,
    bound: float = 10.0,
) -> Array:
    """Keeps for the policy the `ceil(share M)` rows of largest delight (arXiv 2603.20526 in the
    limit of a hard gate); the critic sees all."""
    chi = np.asarray(standardised, np.float64) * surprisal(log_prob, entropy, bound)
    return largest(chi, kept_count(share, len(chi)))


# ------------------------------------------------------------------ ratio, segments, Vex


def sample_dropout_keep(log_prob: Array, log_prob0: Array, deviation: float) -> Array:
    """Drops from a minibatch the rows with `|r - 1| >= deviation`; keeps all if none is left
    (Lin et al. 2023, arXiv 2302.02299)."""
    lp, lp0 = floats(log_prob, log_prob0)
    keep = np.abs(np.exp(lp - lp0) - 1) < deviation
    return keep if keep.any() else np.ones_like(keep)


def segment_scores(advantage: Array, length: int = 64) -> Array:
    """Sums A over segments of `length` steps of one env: `[T, N]` -> `[ceil(T / length), N]`.

    What is left at the end of the rollout is a shorter segment.
    """
    (a,) = floats(advantage)
    return np.stack([a[t : t + length].sum(0) for t in range(0, len(a), length)])


def segments_to_rows(keep: Array, steps: int, length: int = 64) -> Array:
    """Spreads a mask of segments `[S, N]` over their steps: `[steps, N]`."""
    return np.repeat(np.asarray(keep, bool), length, axis=0)[:steps]


def pods_keep(score: Array, count: int | None = None) -> Array:
    """Keeps the segments whose scores vary most (Xu et al. 2025, arXiv 2504.13818).

    The j highest and `count - j` lowest, of all j the one with the largest variance, the smallest
    such j; `count` is half of them, rounded up, if None. Tries every j.
    """
    (score,) = floats(score)
    flat = score.ravel()
    count = kept_count(0.5, flat.size) if count is None else count
    order = np.argsort(-flat, kind="stable")
    choices = [
        np.concatenate([order[:j], order[len(flat) - (count - j) :]]) for j in range(count + 1)
    ]
    keep = np.zeros(flat.size, bool)
    keep[choices[int(np.argmax([flat[chosen].var() for chosen in choices]))]] = True
    return keep.reshape(score.shape)


def largest_variance(score: Sequence[float], count: int) -> float:
    """Tries every subset of `count` scores and returns the largest variance."""
    return max(float(np.var(chosen)) for chosen in itertools.combinations(score, count))


def vex_share(error: Array, returns: Array) -> Array:
    """Knows what a variance-explained head predicts: `1 - e^2 / Var(R)`, Var over the rollout.

    Its mean is the rollout's own variance explained. 0 everywhere if the returns do not vary.
    """
    e, r = floats(error, returns)
    return 1 - e**2 / r.var() if r.var() > 0 else np.zeros_like(e)


def vex_keep(share: Array, kept: float, which: Literal["high", "low", "both"]) -> Array:
    """Keeps `ceil(kept M)` rows: where the share is high, where it is low, or half at each end
    (the odd one at the high end)."""
    (share,) = floats(share)
    count = kept_count(kept, len(share))
    high = {"high": count, "low": 0, "both": (count + 1) // 2}[which]
    top = largest(share, high)
    return top | largest(np.where(top, -np.inf, -share), count - high)


def informative_keep(share: Array, threshold: float = 0.3, present: Array | None = None) -> Array:
    """Keeps what passes eq. 7 in each column of `[T, N]`, of rows in time order.

    `|x| / (|median of the earlier rows' x| + 1e-8) >= threshold`; a first row has no earlier ones
    and is kept. Rows that are not `present` are neither kept nor among the earlier ones.
    """
    (share,) = floats(share)
    there = np.ones(share.shape, bool) if present is None else np.asarray(present, bool)
    keep = np.zeros(share.shape, bool)
    for n, column in enumerate(share.T):
        earlier: list[float] = []
        for t in np.flatnonzero(there[:, n]):
            ratio = abs(column[t]) / (abs(np.median(earlier)) + 1e-8) if earlier else np.inf
            keep[t, n] = ratio >= threshold
            earlier.append(column[t])
    return keep


# ------------------------------------------------------------------ controls and minibatches


def random_keep(count: int, permutation: Array) -> Array:
    """Keeps the first `count` of a permutation of the rows."""
    keep = np.zeros(len(permutation), bool)
    keep[np.asarray(permutation)[:count]] = True
    return keep


def stride_keep(count: int, number: int) -> Array:
    """Keeps rows `floor(i number / count)`: every k-th where `number = k count`."""
    keep = np.zeros(number, bool)
    keep[np.arange(count) * number // count] = True
    return keep


def low_advantage_keep(advantage: Array, count: int) -> Array:
    """Keeps the `count` rows of smallest `|A|`."""
    return largest(-np.abs(np.asarray(advantage, np.float64)), count)


def reversed_keep(score: Array, count: int) -> Array:
    """Keeps the `count` rows that a rule by score likes least."""
    return largest(-np.asarray(score, np.float64), count)


def minibatches(
    keep: Array, permutation: Array, size: int, last: Literal["filled", "left out"]
) -> list[Array]:
    """Cuts the kept rows, in the permutation's order, into minibatches of one size.

    A short last one is left out, or filled with kept rows again from the front.
    """
    rows = np.asarray(permutation)[np.asarray(keep, bool)[np.asarray(permutation)]]
    if last == "filled" and len(rows):
        rows = np.resize(rows, math.ceil(len(rows) / size) * size)
    return [rows[i : i + size] for i in range(0, len(rows) - size + 1, size)]


def speed_up(update_share: float, kept: float) -> float:
    """Predicts the gain in time where the update takes `u` of it: `1 / (1 - u + u k)` (Amdahl)."""
    return 1 / (1 - update_share + update_share * kept)
