"""What training would make of a stream of env steps: the filter's decisions, then GAE.

The decisions are the filter's own functions, run as the collector runs them: the filter starts
anew where a rollout begins, and a rollout ends with its last kept step (or where it may try no
further one). Only the policy does not change, where training would update it between rollouts.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeVar

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


class Span(NamedTuple):
    """The steps of `N` environments that make up one rollout of at most `S` steps each."""

    first: np.ndarray  # [N] the step at which it begins
    valid: np.ndarray  # [S, N] bool, the steps that are tried
    keep: np.ndarray  # [S, N] bool, those of them that the filter keeps


class Decisions(NamedTuple):
    """Of one environment's `L` env steps, to the end of its last rollout or as far as it is there.

    Median and edge are NaN where there are no earlier predictions, and for other filters than
    `sauna`. An edge is infinite where a target keep rate drops whatever comes.
    """

    prediction: np.ndarray  # [L] x of eq. 7: the head's Vex, for a joint decision its mean
    median: np.ndarray  # [L] of the earlier predictions (of |Vex| if there is a target keep rate)
    edge: np.ndarray  # [L] below which |x| is dropped
    keep: np.ndarray  # [L] bool
    rollouts: list[int]  # the steps at which a rollout begins
    spans: list[Span]  # the rollouts, of all environments that were looked at


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


def decide(
    config: Config, scored: ScoredStep, key: Any, hypers: Hypers, steps: int | None = None
) -> Decisions:
    """Decides rollout after rollout; what is kept is environment 0's.

    Args:
      config: the member's own.
      scored: fields `[at least L, N, ...]`.
      key: rollout r draws from `fold_in(key, r)`.
      steps: that the rollouts have to cover; default all.
    """
    vex: Any = scored.vex
    there, number = vex.shape
    steps, most = steps or there, capacity(config)
    filter, longest = make_filter(config), min(most, there)
    joint = config.filter == "sauna" and config.decision == "joint"
    prediction = vex.mean(1) if joint else vex[:, 0]
    before, kept = np.full((2, there), np.nan), np.zeros(there, bool)
    first, spans = np.zeros(number, int), list[Span]()
    while first[0] < steps:
        rows = first + np.arange(longest)[:, None]
        valid, keep = rows < there, rows < there
        if filter is not None:
            part = ScoredStep(*(rows_of(x, rows) for x in scored))
            rollout_key = jax.random.fold_in(key, len(spans))
            state = filter.init(number, most)
            mask, standard = trace(config, filter, state, part, rollout_key, hypers)
            keep = valid & np.asarray(mask)
            valid &= np.cumsum(keep, 0) - keep < config.rollout_steps  # until T are kept
            keep &= valid
            own = rows[valid[:, 0], 0]
            before[:, own] = [np.asarray(x)[valid[:, 0], 0] for x in standard]
        kept[rows[keep[:, 0], 0]] = True
        spans.append(Span(first.copy(), valid, keep))
        first += valid.sum(0)
    rollouts = [int(span.first[0]) for span in spans]
    median, edge = before
    every = Decisions(prediction, median, edge, kept, rollouts, spans)
    return until(every, int(first[0]))


Columns = TypeVar("Columns", bound=NamedTuple)


def until(columns: Columns, steps: int) -> Columns:
    """The arrays of a record cut to their first steps; its other fields stay."""
    arrays = {n: x for n, x in columns._asdict().items() if isinstance(x, np.ndarray)}
    cut: Any = {name: array[:steps] for name, array in arrays.items()}
    return columns._replace(**cut)


def rows_of(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Row `rows[s, n]` of environment n of `[L, N, ...]`: `[S, N, ...]`; zeros behind the end."""
    found = x[np.minimum(rows, len(x) - 1), np.arange(x.shape[1])]
    found[rows >= len(x)] = 0
    return found


def advantages(config: Config, stream: Rollout, rollouts: list[int], hypers: Hypers) -> np.ndarray:
    """Computes GAE `[L]` of a stream `[L, 1]`, within each rollout as the run computes it.

    NaN where the run computes none: with `gae_over=kept`, on dropped steps.
    """
    found = np.full(len(stream.reward), np.nan)
    for first, last in zip(rollouts, [*rollouts[1:], len(found)], strict=True):
        rollout: Rollout = jax.tree.map(lambda x: jnp.asarray(x[first:last]), stream)  # noqa: B023
        if config.gae_over == "all":
            over_all = advantages_over_all(rollout, hypers, config.truncation == "bootstrap")
            found[first:last] = np.asarray(over_all)[:, 0]
            continue
        rows = kept_rows(rollout.keep, int(rollout.keep.sum()))
        if len(rows):
            over_kept = advantages_over_kept(rollout, rows, hypers)
            found[first + np.asarray(rows)[:, 0]] = np.asarray(over_kept)[:, 0]
    return found
