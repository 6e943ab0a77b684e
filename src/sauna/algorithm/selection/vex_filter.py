"""SAUNA's filter: keep a transition if its predicted explained variance is informative (eq. 7).

Deciding never changes how an env acts, so that a filter may be run over a segment of steps after
they happened: the host does that, the device decides step by step, and both get the same mask.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.selection.history import History, empty_history, insert, median, quantile
from sauna.algorithm.types import Array, Hypers, Rollout, ScoredStep, StepFilter
from sauna.config.settings import Config

EPSILON = 1e-8  # epsilon_0 of eq. 7


def informative(vex: Array, history: History, threshold: Array) -> Array:
    """Eq. 7: `|x| / (|median| + eps) >= threshold`; true while there is no history.

    Written as a negation so that a NaN prediction is kept, where the finite checks see it, and
    threshold 0 keeps everything.
    """
    return (history.number == 0) | ~(ratio_to_median(vex, history) < threshold)


def ratio_to_median(vex: Array, history: History) -> Array:
    """The left side of eq. 7: `|x| / (|median| + eps)`."""
    return jnp.abs(vex) / (jnp.abs(median(history)) + EPSILON)


def sauna_per_env(history: str, quota: int) -> StepFilter:
    """Eq. 7 for each env by itself.

    Args:
      history: medians over `all` steps or the `kept` ones.
      quota: kept steps that one env needs; more are never in a history of the kept.
    """

    def init(num_envs: int, capacity: int) -> History:
        return empty_history((num_envs,), quota if history == "kept" else capacity)

    def keep(state: History, step: ScoredStep, key: Array, hypers: Hypers) -> tuple[History, Array]:
        mask = informative(step.vex, state, hypers.threshold)
        seen = insert(state, step.vex)
        if history == "kept":
            seen = History(
                jnp.where(mask[:, None], seen.ordered, state.ordered),
                jnp.where(mask, seen.number, state.number),
            )
        return seen, mask

    return StepFilter(init, keep)


def sauna_joint(history: str, quota: int) -> StepFilter:
    """Eq. 7 for a vector step as a whole, as the released code does; see `sauna_per_env`.

    `runner.py` of the authors' release compares |mean over envs| with the median of all envs'
    predictions pooled, and keeps or drops the step of every env together.
    """

    def init(num_envs: int, capacity: int) -> History:
        return empty_history((), num_envs * (quota if history == "kept" else capacity))

    def keep(state: History, step: ScoredStep, key: Array, hypers: Hypers) -> tuple[History, Array]:
        vex = step.vex
        kept = informative(jnp.mean(vex), state, hypers.threshold)
        seen = jax.lax.fori_loop(0, len(vex), lambda n, history: insert(history, vex[n]), state)
        if history == "kept":
            seen = jax.tree.map(lambda new, old: jnp.where(kept, new, old), seen, state)
        return seen, jnp.broadcast_to(kept, vex.shape)

    return StepFilter(init, keep)


class RateState(NamedTuple):
    """What a target keep rate looks back on, for each env."""

    history: History  # of |Vex|
    kept: Array  # [N] int32


SETTLE = 50  # env steps within which a deviation of the keep rate is made good


def sauna_at_rate(rate: float) -> StepFilter:
    """Eq. 7 with a threshold that is moved at every step so that the share `rate` is kept.

    Comparing `|x| / |median|` with a threshold is comparing `|x|` with some quantile of the earlier
    `|x|` of the rollout. The quantile is what is set: with n earlier steps, of which `kept` were
    kept, its level is

        (1 - rate) + (kept - rate n) / SETTLE

    The first term would do if predictions came in random order; the second, an integral controller,
    makes good what they do otherwise, within about `SETTLE` steps. Nothing depends on how far apart
    the predictions are, so this acts where all of them are near 1 and no fixed ratio does. Like the
    history it begins anew with each rollout; a member whose `threshold` is 0 keeps everything.
    """

    def init(num_envs: int, capacity: int) -> RateState:
        return RateState(empty_history((num_envs,), capacity), jnp.zeros(num_envs, jnp.int32))

    def keep(
        state: RateState, step: ScoredStep, key: Array, hypers: Hypers
    ) -> tuple[RateState, Array]:
        size = jnp.abs(step.vex)
        mask = ~(size < rate_edge(state, rate)) | (hypers.threshold <= 0)
        return RateState(insert(state.history, size), state.kept + mask), mask

    return StepFilter(init, keep)


def rate_edge(state: RateState, rate: float) -> Array:
    """What |Vex| has to reach to be kept at a target keep rate, `[N]`; see `sauna_at_rate`."""
    number = state.history.number
    level = (1.0 - rate) + (state.kept - rate * number) / SETTLE
    return quantile(state.history.ordered, number, level)


def threshold_for_rate(vex: Array, valid: Array, rate: float) -> Array:
    """The threshold of eq. 7 that would keep the share `rate` of a rollout's steps `[S, N]`."""
    number = jnp.sum(valid)

    def ordered(x: Array) -> Array:
        return jnp.sort(jnp.where(valid, x, jnp.inf).ravel())

    middle = median(History(ordered(vex), number))
    least = quantile(ordered(jnp.abs(vex)), number, jnp.float32(1.0 - rate))
    return jnp.maximum(least, 0.0) / (jnp.abs(middle) + EPSILON)


def moved_threshold(rollout: Rollout, hypers: Hypers, config: Config) -> Array:
    """The threshold of this iteration; NaN where it is the config's own, or nothing is filtered."""
    unmoved = jnp.float32(jnp.nan)
    if config.keep_rate_target:
        found = threshold_for_rate(rollout.vex, rollout.valid, config.keep_rate_target)
        return jnp.where(hypers.threshold > 0, found, unmoved)
    return unmoved if config.threshold_schedule == "constant" else jnp.float32(hypers.threshold)
