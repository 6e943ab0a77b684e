"""Filters: which transitions of a rollout the update keeps.

A filter is a pair of pure functions. `init(num_envs, capacity)` gives the state at the start of a
rollout in which each env acts at most `capacity` times. `keep(state, observation, vex, key,
hypers)` is called once per env step, in time order:

  observation  [N, ...]  what the policy saw
  vex          [N]       the Vex head's prediction there
  key                    a JAX key of this step alone
  hypers                 traced hyperparameters, of which `threshold` and `drop_rate` are filters'

and returns the new state and the mask `[N]` of the envs whose transition is kept. An env whose
quota is already full still has a row; its decision is ignored. Deciding never changes how an env
acts, so a filter may be run over a stretch of steps after they happened: the host does that, the
device decides step by step, and both get the same mask.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.core.types import Array, Hypers
from sauna.system.errors import BadInput

EPSILON = 1e-8  # epsilon_0 of eq. 7


class Filter(NamedTuple):
    """`init(num_envs, capacity) -> state`, `keep(state, ...) -> (state, mask [N])`."""

    init: Callable[[int, int], Any]
    keep: Callable[[Any, Array, Array, Array, Hypers], tuple[Any, Array]]


class History(NamedTuple):
    """Earlier predictions in rising order, so that their median is a look-up."""

    ordered: Array  # [..., capacity + 1], +inf behind the first `number`
    number: Array  # [...] int32


def empty_history(lead: tuple[int, ...], capacity: int) -> History:
    return History(
        jnp.full((*lead, capacity + 1), jnp.inf, jnp.float32), jnp.zeros(lead, jnp.int32)
    )


def median(history: History) -> Array:
    """Median over the last axis; the mean of the middle two of an even number. 0 if empty."""
    low = jnp.maximum(history.number - 1, 0) // 2
    pair = jnp.stack([low, history.number // 2], -1)
    middle = jnp.take_along_axis(history.ordered, pair, -1)
    return jnp.where(history.number > 0, 0.5 * (middle[..., 0] + middle[..., 1]), 0.0)


def insert(history: History, x: Array) -> History:
    """`x` `[...]` put in its place: each slot becomes the middle of (left neighbour, x, itself)."""
    widths = [(0, 0)] * x.ndim + [(1, 0)]
    left = jnp.pad(history.ordered[..., :-1], widths, constant_values=-jnp.inf)
    ordered = jnp.maximum(left, jnp.minimum(history.ordered, x[..., None]))
    return History(ordered, history.number + 1)


def informative(vex: Array, history: History, threshold: Array) -> Array:
    """Eq. 7: `|x| / (|median| + eps) >= threshold`; true while there is no history.

    Written as a negation so that a NaN prediction is kept, where the finite checks see it, and
    threshold 0 keeps everything.
    """
    ratio = jnp.abs(vex) / (jnp.abs(median(history)) + EPSILON)
    return (history.number == 0) | ~(ratio < threshold)


def sauna_per_env(history: str, quota: int) -> Filter:
    """Eq. 7 for each env by itself.

    Args:
      history: medians over `all` steps or the `kept` ones.
      quota: kept steps that one env needs; more are never in a history of the kept.
    """

    def init(num_envs: int, capacity: int) -> History:
        return empty_history((num_envs,), quota if history == "kept" else capacity)

    def keep(
        state: History, observation: Array, vex: Array, key: Array, hypers: Hypers
    ) -> tuple[History, Array]:
        mask = informative(vex, state, hypers.threshold)
        seen = insert(state, vex)
        if history == "kept":
            seen = History(
                jnp.where(mask[:, None], seen.ordered, state.ordered),
                jnp.where(mask, seen.number, state.number),
            )
        return seen, mask

    return Filter(init, keep)


def sauna_joint(history: str, quota: int) -> Filter:
    """Eq. 7 for a vector step as a whole, as the released code does; see `sauna_per_env`.

    `runner.py` of the authors' release compares |mean over envs| with the median of all envs'
    predictions pooled, and keeps or drops the step of every env together.
    """

    def init(num_envs: int, capacity: int) -> History:
        return empty_history((), num_envs * (quota if history == "kept" else capacity))

    def keep(
        state: History, observation: Array, vex: Array, key: Array, hypers: Hypers
    ) -> tuple[History, Array]:
        kept = informative(jnp.mean(vex), state, hypers.threshold)
        seen = jax.lax.fori_loop(0, len(vex), lambda n, history: insert(history, vex[n]), state)
        if history == "kept":
            seen = jax.tree.map(lambda new, old: jnp.where(kept, new, old), seen, state)
        return seen, jnp.broadcast_to(kept, vex.shape)

    return Filter(init, keep)


class Held(NamedTuple):
    """What a held keep rate looks back on, for each env."""

    history: History  # of |Vex|
    kept: Array  # [N] int32


SETTLE = 50  # env steps within which a deviation of the keep rate is made good


def sauna_at_rate(rate: float) -> Filter:
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

    def init(num_envs: int, capacity: int) -> Held:
        return Held(empty_history((num_envs,), capacity), jnp.zeros(num_envs, jnp.int32))

    def keep(
        state: Held, observation: Array, vex: Array, key: Array, hypers: Hypers
    ) -> tuple[Held, Array]:
        size = jnp.abs(vex)
        mask = ~(size < held_edge(state, rate)) | (hypers.threshold <= 0)
        return Held(insert(state.history, size), state.kept + mask), mask

    return Filter(init, keep)


def held_edge(state: Held, rate: float) -> Array:
    """What |Vex| has to reach to be kept at a held keep rate, `[N]`; see `sauna_at_rate`."""
    number = state.history.number
    level = (1.0 - rate) + (state.kept - rate * number) / SETTLE
    return quantile(state.history.ordered, number, level)


def quantile(ordered: Array, number: Array, level: Array) -> Array:
    """The value that a further one of the same kind falls short of with the chance `level`.

    Among n + 1 values in random order each rank is as likely, so it is the one of rank
    `floor(level (n + 1))` of n, counted from 1: -inf for rank 0, +inf behind the last.

    Args:
      ordered: `[..., >= number]`, rising, +inf behind the first `number` `[...]`.
      level: `[...]`.
    """
    rank = jnp.floor(level * (number + 1)).astype(jnp.int32)
    place = jnp.clip(rank - 1, 0, ordered.shape[-1] - 1)
    found = jnp.take_along_axis(ordered, place[..., None], -1)[..., 0]
    return jnp.where(rank < 1, -jnp.inf, jnp.where(rank > number, jnp.inf, found))


def scheduled(threshold: Any, schedule: str, left: Any) -> Any:
    """The threshold when the share `left` of the budget is left."""
    return {"constant": threshold, "rising": threshold * (1.0 - left),
            "falling": threshold * left}[schedule]  # fmt: skip


def threshold_held(vex: Array, valid: Array, rate: float) -> Array:
    """The threshold of eq. 7 that would keep the share `rate` of a rollout's steps `[S, N]`."""
    number = jnp.sum(valid)

    def ordered(x: Array) -> Array:
        return jnp.sort(jnp.where(valid, x, jnp.inf).ravel())

    middle = median(History(ordered(vex), number))
    least = quantile(ordered(jnp.abs(vex)), number, jnp.float32(1.0 - rate))
    return jnp.maximum(least, 0.0) / (jnp.abs(middle) + EPSILON)


def random_drop() -> Filter:
    """Drops each step with probability `drop_rate`, whatever the head says: a control."""

    def keep(
        state: tuple[()], observation: Array, vex: Array, key: Array, hypers: Hypers
    ) -> tuple[tuple[()], Array]:
        return state, jax.random.uniform(key, vex.shape) >= hypers.drop_rate

    return Filter(lambda num_envs, capacity: (), keep)


def make_filter(config: Config) -> Filter | None:
    """The filter that `config` names, or None where every transition is kept.

    Raises:
      BadInput: a user's `module:name` is something else.
    """
    if config.filter == "none":
        return None
    if config.filter == "random-drop":
        return random_drop()
    if config.filter == "sauna" and config.keep_rate_target:
        return sauna_at_rate(config.keep_rate_target)
    if config.filter == "sauna":
        rule = sauna_joint if config.decision == "joint" else sauna_per_env
        return rule(config.history, config.rollout_steps)
    filter = import_name("filter", config.filter)
    if not isinstance(filter, Filter):
        raise BadInput(f"filter: {config.filter} is not a sauna.Filter")
    return filter


def decide(
    filter: Filter,
    state: Any,
    observation: Array,
    vex: Array,
    first: Array,
    length: Array,
    key: Array,
    hypers: Hypers,
) -> tuple[Any, Array]:
    """Runs a filter over a stretch of consecutive env steps.

    Args:
      observation: `[L, N, ...]`; `vex`: `[L, N]`, of which the first `length` rows count.
      first: index of the stretch's first step within the rollout.
      key: the rollout's filter key; step t uses `fold_in(key, t)`.

    Returns:
      the filter's state after the stretch, and the mask `[L, N]` (False behind `length`).
    """

    def step(carry: tuple[Array, Any, Array]) -> tuple[Array, Any, Array]:
        t, state, mask = carry
        step_key = jax.random.fold_in(key, first + t)
        state, kept = filter.keep(state, observation[t], vex[t], step_key, hypers)
        return t + 1, state, mask.at[t].set(kept)

    start = (jnp.int32(0), state, jnp.zeros(vex.shape, bool))
    _, state, mask = jax.lax.while_loop(lambda carry: carry[0] < length, step, start)
    return state, mask
