"""What the learner's rules make of rollouts: which samples they take, and how much each counts.

The rules are asked as training asks them before the first epoch of an update, with its keys and
the state that they had at the checkpoint. A loss weight is asked for all samples of a rollout as
for one minibatch, before the first gradient step of the rollout's update and after its last.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.learner.losses import loss_terms
from sauna.algorithm.learner.program import Learner, make_learner, make_parts
from sauna.algorithm.learner.samples import advantages_over_all, kept_rows, with_matched_control
from sauna.algorithm.learner.selected import drawn_length, first_draw
from sauna.algorithm.learner.sequence_choice import choice_of_sequences, rows_of_sequences
from sauna.algorithm.learner.sequences import row_outputs, units
from sauna.algorithm.learner.update import (
    Parts,
    device_minibatch_order,
    loss_advantage,
    minibatch_order,
)
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.types import (
    Array,
    Batch,
    Hypers,
    Memory,
    Rollout,
    TrainState,
    member_keys,
    selection_key,
)
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.experiments.inspect.decisions import Span, rows_of


class Learned(NamedTuple):
    """Of environment 0's `L` env steps; NaN for a step that is no sample. None: no rule has it."""

    taken: np.ndarray  # [L] bool, whether the policy learns from it in the first epoch
    score: np.ndarray | None  # [L] how much the sampler wants it
    draws: np.ndarray | None  # [L] expected in an epoch, if the sampler draws by probabilities
    weight: np.ndarray | None  # [L] of the policy term, by the sampler
    first_weight: np.ndarray | None  # [L] by the loss weight, before the first gradient step
    last_weight: np.ndarray | None  # [L] the same after the last


def reads_rollouts(config: Config) -> bool:
    """Whether some rule of the run decides about whole rollouts."""
    learner = (config.sampler, config.loss_weight) != ("none", "none")
    controlled = config.filter != "none" and config.control != "none"
    return learner or controlled or config.advantage_sign == "positive"


def learned(
    config: Config,
    policy: Policy,
    spaces: Spaces,
    state: TrainState,
    streams: Rollout,
    spans: list[Span],
    hypers: Hypers,
    seed: int,
    iteration: int,
) -> Learned:
    """Asks the rules about rollout after rollout; the policy does not change between them.

    Args:
      config: the member's own, and `seed`.
      state: as the checkpoint has it.
      streams: `[L, N, ...]`, of which `spans` cuts the rollouts.
      iteration: of the first rollout.
    """
    learner, parts = make_learner(config, policy, spaces), make_parts(config, policy, spaces)
    asked, weighed = jax.jit(partial(ask, parts=parts)), jax.jit(partial(weigh, parts=parts))
    found: dict[str, np.ndarray] = {}
    for i, span in enumerate(spans, iteration):
        key, order, every = draws_of(parts, seed, i)
        rollout = rollout_of(streams, span, config.sequence_length)
        rollout = controlled_rollout(rollout, hypers, key, config)
        batch = learner.make_batch(rollout, hypers, key)
        after, columns = asked(state, batch, rollout, order, key)
        if config.loss_weight != "none":
            draws = key, order, every
            columns |= _weights(learner, weighed, state, rollout, batch, hypers, draws)
        rows = np.asarray(kept_rows(rollout.keep, config.rollout_steps))[:, 0]
        there = np.asarray(batch.weight).reshape(len(rows), -1)[:, 0] > 0
        for name, values in columns.items():
            column = np.asarray(values, float).reshape(len(rows), -1)[:, 0]
            place = found.setdefault(name, np.full(len(streams.reward), np.nan))
            place[span.first[0] + rows[there]] = column[there]
        state = after
    taken = found["taken"] == 1.0
    if "last_mask" in found:
        taken &= found["last_mask"] == 1.0
    return Learned(taken, *(found.get(name) for name in Learned._fields[1:]))


def draws_of(parts: Parts, seed: int, iteration: int) -> tuple[Array, Any, Any]:
    """The key of an iteration's draws, the order of each epoch, and one of all rows `[M]`."""
    config, keys = parts.config, member_keys(seed)
    key, rows = selection_key(keys, iteration), config.rollout_steps * config.envs
    every: Any = np.arange(rows)  # of a recurrent policy, whose orders are of sequences
    if config.backend == "device":
        own = jax.random.fold_in(keys.order, iteration)
        order: Any = device_minibatch_order(config, own, drawn_length(parts))
        if config.recurrent == "none":
            every = device_minibatch_order(config, own)[0]
    else:
        order = minibatch_order(config, seed, iteration)
        if config.recurrent == "none":
            every = order[0]
    return key, order, every


def rollout_of(streams: Rollout, span: Span, length: int) -> Rollout:
    """One rollout `[S, N, ...]` of streams `[L, N, ...]`; `length` is a recurrent policy's."""
    rows = span.first + np.arange(len(span.valid))[:, None]
    found: Rollout = jax.tree.map(lambda x: rows_of(x, rows), streams)
    if found.memory is not None:
        start, state = found.memory
        found = found._replace(memory=Memory(start, state[::length]))
    return found._replace(valid=span.valid, keep=span.keep)  # type: ignore[arg-type]


def controlled_rollout(rollout: Rollout, hypers: Hypers, key: Array, config: Config) -> Rollout:
    """The rollout with what the matched control of its filter keeps, if it has one."""
    over_all = advantages_over_all(rollout, hypers, config.truncation == "bootstrap")
    return with_matched_control(rollout, over_all, key, config)


def ask(
    state: TrainState, batch: Batch, rollout: Rollout, order: Array, key: Array, *, parts: Parts
) -> tuple[TrainState, dict[str, Array]]:
    """What the sampler takes of `M` rows in the first epoch, as columns `[M]` of `Learned`."""
    config, present = parts.config, batch.weight > 0
    state, choice, drawn = first_draw(state, batch, rollout, order, key, parts=parts)
    taken, columns = present, {}
    if choice.keep is not None:
        taken = present & choice.keep
    else:
        counts, probability = jnp.arange(len(drawn.rows)) < drawn.number, choice.probability
        taken = jnp.zeros(units(config), bool).at[drawn.rows].max(counts)
        if rollout.memory is not None:
            of = batch, rollout, config.sequence_length
            taken = rows_of_sequences(taken, *of) & present
            probability = choice_of_sequences(choice, *of).probability
            probability = rows_of_sequences(probability, *of) * present
        columns["draws"] = drawn_length(parts, draws=True) * probability
    if config.advantage_sign == "positive":
        taken &= loss_advantage(batch.advantage, batch.weight, config) > 0
    if parts.rules.sampler is not None:
        columns |= {"score": choice.score} if choice.score is not None else {}
        columns |= {"weight": choice.weight} if choice.weight is not None else {}
    return state, {"taken": taken, **columns}


def weigh(
    params: Array,
    state: TrainState,
    batch: Batch,
    rollout: Rollout,
    draws: tuple[Array, Any, Any],
    *,
    parts: Parts,
) -> tuple[Array, Array]:
    """Mask and scale `[M]` that the loss weight gives the rows under a policy's `params`.

    Args:
      draws: see `draws_of`; the rows come in the last one's order, as a control deals weights to
        the next row.
    """
    config, distribution = parts.config, parts.policy.distribution
    assert parts.rules.loss_weight is not None
    key, order, every = draws
    _, choice, _ = first_draw(state, batch, rollout, order, key, parts=parts)
    present = batch.weight if choice.keep is None else batch.weight * choice.keep
    over = batch.weight if config.normalize_over == "rollout" else present
    rows = jax.tree.map(lambda x: x[every], batch)
    rows = rows._replace(
        advantage=loss_advantage(batch.advantage, over, config)[every],
        weight=present[every],
    )
    output = row_outputs(parts.policy, params, batch, rollout, config.sequence_length)
    output = jax.tree.map(lambda x: x[every], output)
    log_prob = distribution.log_prob(output.policy, rows.action)
    entropy = distribution.entropy(output.policy)
    terms = loss_terms(rows, rows.advantage, rows.weight, log_prob, entropy, distribution)
    mask, scale = parts.rules.loss_weight.weight(terms)
    back = jnp.argsort(every)
    return mask[back], scale[back]


def _weights(
    learner: Learner,
    weighed: Any,
    state: TrainState,
    rollout: Rollout,
    batch: Batch,
    hypers: Hypers,
    draws: tuple[Array, Any, Any],
) -> dict[str, Array]:
    """The loss weight before and after the update of a rollout, as columns `[M]` of `Learned`."""
    own, (key, order, _) = jax.tree.map(jnp.copy, state), draws
    updated, _ = learner.learn(own, rollout, batch, hypers, order, key)  # takes over own's memory
    mask, scale = weighed(state.params, state, batch, rollout, draws)
    last_mask, last_scale = weighed(updated.params, state, batch, rollout, draws)
    return {
        "first_weight": mask * scale,
        "last_weight": last_mask * last_scale,
        "last_mask": (last_mask > 0).astype(jnp.float32),
    }
