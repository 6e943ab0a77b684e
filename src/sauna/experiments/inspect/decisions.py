"""What training would make of a stream of env steps: the filter's decisions, then GAE.

The decisions are the filter's own functions, run as the collector runs them: the filter starts
anew where a rollout begins, and a rollout ends with its last kept step (or where it may try no
further one). Only the policy does not change, where training would update it between rollouts.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.learner.samples import advantages_over_all, advantages_over_kept, kept_rows
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.selection.history import History, median
from sauna.algorithm.selection.registry import make_filter
from sauna.algorithm.selection.vex_filter import EPSILON, RateState, rate_edge
from sauna.algorithm.types import Array, Hypers, Rollout, ScoredStep, StepFilter
from sauna.config.settings import Config


class Decisions(NamedTuple):
    """Of one environment's `L` env steps.

    Median and edge are NaN where there are no earlier predictions, and for other filters than
    `sauna`. An edge is infinite where a target keep rate drops whatever comes.
    """

    prediction: np.ndarray  # [L] x of eq. 7: the head's Vex, for a joint decision its mean
    median: np.ndarray  # [L] of the earlier predictions (of |Vex| if there is a target keep rate)
    edge: np.ndarray  # [L] below which |x| is dropped
    keep: np.ndarray  # [L] bool
    rollouts: list[int]  # the steps at which a rollout begins


def environments(config: Config) -> int:
    """Returns how many environments a decision looks at.

    Of the package's filters, only the joint one looks at more than its own; a user's filter may.
    """
    alone = config.filter in ("none", "random-drop") or (
        config.filter == "sauna" and config.decision == "env"
    )
    return 1 if alone else config.envs


def standards(config: Config, state: Any, hypers: Hypers) -> tuple[Array, Array]:
    """Returns what the next prediction is compared with: median and edge, `[N]` or `[1]` each."""
    if config.filter != "sauna":
        return jnp.full(1, jnp.nan), jnp.full(1, jnp.nan)
    history = state.history if isinstance(state, RateState) else state
    assert isinstance(history, History)
    middle = median(history)
    edge = hypers.threshold * (jnp.abs(middle) + EPSILON)
    if isinstance(state, RateState):
        least = rate_edge(state, config.keep_rate_target)
        edge = jnp.maximum(least, 0.0)
    known = history.number > 0
    return tuple(jnp.atleast_1d(jnp.where(known, x, jnp.nan)) for x in (middle, edge))  # type: ignore[return-value]


@partial(jax.jit, static_argnames=("config", "filter"))
def trace(
    config: Config,
    filter: StepFilter,
    state: Any,
    steps: ScoredStep,
    key: Array,
    hypers: Hypers,
) -> tuple[Array, tuple[Array, Array]]:
    """Returns the mask `[S, N]` of `rollout.program.decide`, and the `standards` before each step.

    Args:
      steps: fields `[S, N, ...]`.
    """

    def step(state: Any, row: tuple[Array, ScoredStep]) -> tuple[Any, Any]:
        t, now = row
        before = standards(config, state, hypers)
        state, kept = filter.keep(state, now, jax.random.fold_in(key, t), hypers)
        return state, (kept, before)

    rows = (jnp.arange(len(steps.vex)), steps)
    return jax.lax.scan(step, state, rows)[1]


def decide(config: Config, scored: ScoredStep, key: Any, hypers: Hypers) -> Decisions:
    """Decides rollout after rollout; what is kept is environment 0's.

    Args:
      config: the member's own.
      scored: fields `[L, N, ...]`.
      key: rollout r draws from `fold_in(key, r)`.
    """
    vex: Any = scored.vex
    filter, steps, most = make_filter(config), len(vex), capacity(config)
    joint = config.filter == "sauna" and config.decision == "joint"
    prediction = vex.mean(1) if joint else vex[:, 0]
    if filter is None:
        nothing = np.full(steps, np.nan)
        return Decisions(
            prediction, nothing, nothing, np.ones(steps, bool), list(range(0, steps, most))
        )
    before, keep = np.zeros((2, steps)), np.zeros(steps, bool)
    rollouts: list[int] = []
    start = 0
    longest = min(most, steps)
    while start < steps:
        rows = ScoredStep(*(_stretch(x, start, longest) for x in scored))
        rollout_key = jax.random.fold_in(key, len(rollouts))
        first = filter.init(vex.shape[1], most)
        mask, standard = trace(config, filter, first, rows, rollout_key, hypers)
        own = np.asarray(mask)[:, 0]
        full = np.flatnonzero(np.cumsum(own) == config.rollout_steps)
        tried = min(int(full[0]) + 1 if len(full) else longest, steps - start)
        keep[start : start + tried] = own[:tried]
        for own_row, values in zip(before, standard, strict=True):
            own_row[start : start + tried] = np.asarray(values)[:tried, 0]
        rollouts.append(start)
        start += tried
    medians, edges = before
    return Decisions(prediction, medians, edges, keep, rollouts)


def _stretch(x: np.ndarray, start: int, length: int) -> np.ndarray:
    """`x[start : start + length]`, filled up with zeros: one compiled shape for all rollouts."""
    part = x[start : start + length]
    return np.concatenate([part, np.zeros((length - len(part), *x.shape[1:]), x.dtype)])


def advantages(config: Config, stream: Rollout, rollouts: list[int], hypers: Hypers) -> np.ndarray:
    """Computes GAE `[L]` of a stream `[L, 1]`, within each rollout as the run computes it.

    NaN where the run computes none: with `gae_over=kept`, on dropped steps.
    """
    found = np.full(len(stream.reward), np.nan)
    for first, last in zip(rollouts, [*rollouts[1:], len(found)], strict=True):
        rollout = Rollout(*(jnp.asarray(x[first:last]) for x in stream))
        if config.gae_over == "all":
            over_all = advantages_over_all(rollout, hypers, config.truncation == "bootstrap")
            found[first:last] = np.asarray(over_all)[:, 0]
            continue
        rows = kept_rows(rollout.keep, int(rollout.keep.sum()))
        if len(rows):
            over_kept = advantages_over_kept(rollout, rows, hypers)
            found[first + np.asarray(rows)[:, 0]] = np.asarray(over_kept)[:, 0]
    return found
