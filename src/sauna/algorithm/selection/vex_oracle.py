"""SAUNA's own quantity, known instead of predicted."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.selection.history import History, empty_history, insert
from sauna.algorithm.selection.scores import (
    check_choice,
    check_range,
    check_share,
    count_of,
    largest,
)
from sauna.algorithm.selection.vex_filter import informative, ratio_to_median
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples

THRESHOLD = 0.3  # of arm `sauna`
SHARE = 0.5
CLIP_BELOW = -5.0  # of the target that the head of arm `sauna` is trained on


def vex_oracle(
    setup: SamplerSetup,
    share: float | None = None,
    keep: str | None = None,
    threshold: float | None = None,
) -> Sampler:
    """Keeps rows by their share of the explained variance, `1 - (R - V)^2 / Var(R)`.

    It is known once the rollout is complete: whether this helps says whether SAUNA's idea or its
    prediction fails. `keep` is one of

    | keep | rows |
    |---|---|
    | `informative` | SAUNA's own test (eq. 7) with the true share in place of the prediction |
    | `high`, `low` | the `ceil(share M)` rows of largest, or smallest, share |
    | `both` | half of these at each end, the odd one at the high end |

    The default is `informative` with SAUNA's `threshold` 0.3; a `share` alone asks for `high`,
    whose default is 0.5. With GAE `R - V` is A, so that `high` keeps the rows of smallest `|A|`
    (`top-advantage+low-advantage`), and `low` those of largest (`top-advantage`). A replayed row's
    return is `V + rho A`. Its error is A here all the same, and its return `V + A`: with `rho A`
    a row would score the higher the less today's policy would have done the same.
    """
    keep = keep or ("informative" if share is None else "high")
    check_choice("keep", keep, ("informative", "high", "low", "both"))
    if keep == "informative":
        if share is not None:
            raise ValueError("share is read with keep high, low or both; informative has none")
        return _informative(setup, THRESHOLD if threshold is None else threshold)
    if threshold is not None:
        raise ValueError("threshold is read with keep informative alone")
    return _by_rank(setup, SHARE if share is None else share, keep)


def _informative(setup: SamplerSetup, threshold: float) -> Sampler:
    check_range("threshold", threshold, 0.0)
    shape = (-1, setup.rollout_steps, setup.envs)  # rollouts R, T, N

    def columns(x: Array) -> Array:
        return x.reshape(shape).swapaxes(0, 1).reshape(setup.rollout_steps, -1)

    def rows(x: Array) -> Array:
        return x.reshape(setup.rollout_steps, -1, setup.envs).swapaxes(0, 1).ravel()

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        present = columns(samples.present)
        share = explained(columns(samples.advantage), columns(samples.value), present)
        kept, ratio = eq_7(jnp.maximum(share, CLIP_BELOW), present, threshold)
        return state, Choice(keep=rows(kept) & samples.present, score=rows(ratio))

    return Sampler(lambda: (), choose)


def _by_rank(setup: SamplerSetup, share: float, keep: str) -> Sampler:
    check_share(share)
    count = count_of(share, setup.rows)
    high = {"high": count, "low": 0, "both": (count + 1) // 2}[keep]

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        present = samples.present
        found = explained(samples.advantage, samples.value, present)
        top = largest(found, high, present)
        kept = top | largest(-found, count - high, present & ~top)
        wanted = {"high": found, "low": -found}.get(keep, kept.astype(jnp.float32))
        return state, Choice(keep=kept, score=wanted)

    return Sampler(lambda: (), choose, share=share)


def explained(advantage: Array, value: Array, present: Array) -> Array:
    """`1 - A^2 / Var(V + A)` of rows `[S, ...]`, Var over the first axis; 0 if it is 0."""
    returns, number = value + advantage, jnp.maximum(jnp.sum(present, 0), 1)
    mean = jnp.sum(returns * present, 0) / number
    variance = jnp.sum((returns - mean) ** 2 * present, 0) / number
    varies = variance > 0
    return jnp.where(varies, 1.0 - advantage**2 / jnp.where(varies, variance, 1.0), 0.0)


def eq_7(share: Array, present: Array, threshold: float) -> tuple[Array, Array]:
    """Runs SAUNA's test over columns `[T, K]` of rows in time order, each column by itself.

    Rows that are not present are in no history.

    Returns:
      which rows pass, and their ratio to the median of the earlier ones.
    """

    def step(history: History, row: tuple[Array, Array]) -> tuple[History, tuple[Array, Array]]:
        x, there = row
        found = informative(x, history, jnp.float32(threshold)), ratio_to_median(x, history)
        seen = insert(history, x)
        ordered = jnp.where(there[:, None], seen.ordered, history.ordered)
        return History(ordered, jnp.where(there, seen.number, history.number)), found

    start = empty_history(share.shape[1:], len(share))
    found: tuple[Array, Array] = jax.lax.scan(step, start, (share, present))[1]
    return found
