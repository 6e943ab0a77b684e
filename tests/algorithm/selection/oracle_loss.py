"""What the losses, gradients and stopping rules around a selection have to compute: float64 numpy.

The same names as in `oracle`. Every loss is minimised, every objective maximised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from algorithm.selection.oracle import Array, floats, weighted_mean

# ------------------------------------------------------------------ advantages


def gae(
    reward: Array,
    value: Array,
    next_value: Array,
    terminated: Array,
    ended: Array,
    gamma: float,
    gae_lambda: float,
) -> tuple[Array, Array]:
    """Sums discounted TD errors backwards (Schulman et al. 2016): advantages, returns `[T, ...]`.

    `delta = r + gamma next_value (1 - terminated) - V`, `A = delta + gamma lambda (1 - ended) A'`,
    `R = A + V`. `next_value` is of the state that follows, before any reset: of the final
    observation where the episode `ended` by a time limit, which bootstraps though nothing of the
    next episode flows back.
    """
    r, v, following, terminated, ended = floats(reward, value, next_value, terminated, ended)
    advantage, carried = np.zeros_like(v), np.zeros_like(v[0])
    for t in reversed(range(len(r))):
        delta = r[t] + gamma * following[t] * (1 - terminated[t]) - v[t]
        carried = delta + gamma * gae_lambda * (1 - ended[t]) * carried
        advantage[t] = carried
    return advantage, advantage + v


def recompute(
    value: Callable[[Array], Array],
    observation: Array,
    next_observation: Array,
    reward: Array,
    terminated: Array,
    ended: Array,
    gamma: float,
    gae_lambda: float,
) -> tuple[Array, Array]:
    """Computes advantages and returns anew with the value function of now, over the whole ordered
    rollout, before each epoch (Andrychowicz et al. 2020, 3.5). Ratios stay against `log_prob0`."""
    now, following = value(observation), value(next_observation)
    return gae(reward, now, following, terminated, ended, gamma, gae_lambda)


# ------------------------------------------------------------------ objectives of the policy


def ratio_of(log_prob: Array, log_prob0: Array) -> Array:
    """Compares the policy of now with the one that acted: `exp(lp - lp0)`."""
    lp, lp0 = floats(log_prob, log_prob0)
    return np.exp(lp - lp0)


def ppo_clip_objective(ratio: Array, advantage: Array, clip: float = 0.2) -> Array:
    """Takes the worse of free and clipped: `min(r A, clip(r, 1 - eps, 1 + eps) A)`."""
    r, a = floats(ratio, advantage)
    return np.minimum(r * a, np.clip(r, 1 - clip, 1 + clip) * a)


def unclipped_objective(ratio: Array, advantage: Array, clip: float = np.inf) -> Array:
    """Trusts the ratio: `r A`, for rules that stop or drop rows instead of clipping."""
    r, a = floats(ratio, advantage)
    return r * a


def spo_objective(ratio: Array, advantage: Array, clip: float = 0.2) -> Array:
    """Pulls the ratio back by a parabola: `r A - |A| (r - 1)^2 / (2 eps)`, whose maximum lies at
    `1 + sign(A) eps` (Xie et al. 2024, arXiv 2401.16025)."""
    r, a = floats(ratio, advantage)
    return r * a - np.abs(a) * (r - 1) ** 2 / (2 * clip)


# ------------------------------------------------------------------ losses


def value_terms(value: Array, value0: Array, returns: Array, clip: float | None) -> Array:
    """Takes the worse of free and clipped error: `max((V - R)^2, (V0 + clip(V - V0) - R)^2) / 2`,
    the free one alone if `clip` is None."""
    v, v0, r = floats(value, value0, returns)
    free = (v - r) ** 2
    if clip is None:
        return free / 2
    return np.maximum(free, (v0 + np.clip(v - v0, -clip, clip) - r) ** 2) / 2


def ppo_loss(
    log_prob: Array,
    log_prob0: Array,
    advantage: Array,
    value: Array,
    value0: Array,
    returns: Array,
    entropy: Array,
    *,
    clip: float = 0.2,
    value_clip: float | None = 0.2,
    value_coefficient: float = 0.5,
    entropy_coefficient: float = 0.0,
    weight: Array | None = None,
    value_weight: Array | None = None,
    entropy_weight: Array | None = None,
    objective: Callable[..., Array] = ppo_clip_objective,
) -> dict[str, float]:
    """Adds policy, value and entropy, each a weighted mean: `sum w l / sum w`.

    `total = -policy objective + c_v value - c_e entropy`. `advantage` is used as it comes. A weight
    left out is 1 everywhere, so a rule that touches the policy only passes `weight` only.
    """
    ones = np.ones(len(np.asarray(advantage)))
    w, wv, we = (ones if x is None else x for x in (weight, value_weight, entropy_weight))
    policy = -weighted_mean(objective(ratio_of(log_prob, log_prob0), advantage, clip), w)
    squared = weighted_mean(value_terms(value, value0, returns, value_clip), wv)
    spread = weighted_mean(entropy, we)
    total = policy + value_coefficient * squared - entropy_coefficient * spread
    return {"policy": policy, "value": squared, "entropy": spread, "total": total}


def avec_loss(error: Array, weight: Array | None = None) -> float:
    """Fits the shape of the returns, not their mean: `mean e^2 - (mean e)^2` over the minibatch, no
    half, no clip (Flet-Berliac et al. 2021, arXiv 2010.04440)."""
    (e,) = floats(error)
    w = np.ones_like(e) if weight is None else weight
    return weighted_mean(e**2, w) - weighted_mean(e, w) ** 2


def avec_value(value: Array, returns: Array) -> Array:
    """Adds what such a critic cannot learn: `V + mean(R - V)`, the mean over the rollout."""
    v, r = floats(value, returns)
    return v + (r - v).mean()


def cosine_distance(a: Array, b: Array) -> Array:
    """Compares directions along the last axis: `1 - a.b / (|a| |b|)`, each norm at least 1e-6."""
    unit = [x / np.sqrt(np.maximum((x**2).sum(-1, keepdims=True), 1e-12)) for x in floats(a, b)]
    return 1 - (unit[0] * unit[1]).sum(-1)


def merl_next_loss(
    prediction: Array, next_observation: Array, weight: Array | None = None
) -> float:
    """Fits a head to the observation that follows (Flet-Berliac & Preux 2019, arXiv 1909.11939).

    Give weight 0 to a row whose next observation is unknown.
    """
    distance = cosine_distance(prediction, next_observation)
    return weighted_mean(distance, np.ones_like(distance) if weight is None else weight)


def merl_released_loss(prediction: Array, observation: Array) -> float:
    """Reproduces the released code's quirk: row i of a shuffled minibatch is fitted to the
    observation of row i + 1, a random other one; the last row has no target.

    `baselines_merl/ppo2_merl/model.py`: `OBS = obs[nfs:]` against `train_model.fs[:-nfs]`, nfs = 1.
    """
    return float(cosine_distance(prediction[:-1], observation[1:]).mean())


# ------------------------------------------------------------------ when to stop


def ratio_deviation(log_prob: Array, log_prob0: Array) -> float:
    """Averages how far the ratios are from 1: `mean |r - 1|`."""
    return float(np.abs(ratio_of(log_prob, log_prob0) - 1).mean())


def approximate_kl(log_prob: Array, log_prob0: Array) -> float:
    """Estimates KL(old || new) without negative values: `mean(r - 1 - log r)` (Schulman 2020)."""
    lp, lp0 = floats(log_prob, log_prob0)
    return float((np.exp(lp - lp0) - 1 - (lp - lp0)).mean())


def steps_until(reached: Sequence[bool], measured: Literal["before", "after"]) -> int:
    """Counts the gradient steps until a limit is first reached, which ends all epochs.

    Measured "before" a step, that step is not taken; "after" it, it has been.
    """
    for i, stop in enumerate(reached):
        if stop:
            return i + (measured == "after")
    return len(reached)


def espo_stop(
    deviation: Sequence[float], limit: float = 0.25, measured: Literal["before", "after"] = "after"
) -> int:
    """Counts the steps taken where all epochs end once `mean |r - 1| >= limit` in a minibatch,
    measured on it after its own step (Sun et al. 2022, arXiv 2202.00079)."""
    return steps_until([x >= limit for x in deviation], measured)


def target_kl_stop(
    kl: Sequence[float], target: float, measured: Literal["before", "after"] = "before"
) -> int:
    """Counts the steps taken where all epochs end once `kl > 1.5 target` in a minibatch, measured
    before its step, which is then not taken (Stable-Baselines3, `PPO.train`)."""
    return steps_until([x > 1.5 * target for x in kl], measured)


# ------------------------------------------------------------------ gradients at the policy head


def gaussian_head_gradient(
    standardised: float, action: Array, mean: Array, std: Array, hidden: Array
) -> tuple[Array, Array, Array]:
    """Writes out one row's gradient of `A^ r` at ratio 1 for `mean = W h + b` and a free log-std:
    over W `[D, H]` an outer product, over b `[D]`, over log-std `[D]`."""
    action, mean, std, h = floats(action, mean, std, hidden)
    z = (action - mean) / std
    bias = standardised * z / std
    return np.outer(bias, h), bias, standardised * (z**2 - 1)


def categorical_head_gradient(
    standardised: float, action: int, probability: Array, hidden: Array
) -> tuple[Array, Array]:
    """Writes out one row's gradient of `A^ r` at ratio 1 for `logits = W h + b`: over W
    `[actions, H]` an outer product, over b `[actions]`."""
    pi, h = floats(probability, hidden)
    bias = standardised * (np.eye(len(pi))[action] - pi)
    return np.outer(bias, h), bias


def gaussian_score(
    weight: Array, standardised: Array, z: Array, std: Array, on: Literal["all", "mean"]
) -> tuple[Array, Array]:
    """Weights rows of a Gaussian's surrogate gradient at ratio 1: over the mean and the log-std,
    each `[M, D]`. On "mean" the log-std is moved as if every weight were 1, so that a weight which
    favours rare actions cannot by itself widen the policy."""
    w, a, z, std = floats(weight, standardised, z, std)
    over_mean = (w * a)[:, None] * z / std
    over_log_std = ((w * a) if on == "all" else a)[:, None] * (z**2 - 1)
    return over_mean, over_log_std
