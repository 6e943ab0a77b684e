"""The update under a rule of selection: choose rows, then run as many minibatches as they fill.

Without a rule `update.update_on_all` runs instead: PPO, bit for bit. Here the number of
gradient steps is known only while the program runs. No gradient flows through that loop, and time
is spent on the steps that are run. Members that are compiled together run the most steps of any.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.losses import Losses, Minibatch, scale_of_kept, standardize, times
from sauna.algorithm.learner.replay import pool_rows
from sauna.algorithm.learner.samples import recomputed
from sauna.algorithm.learner.sequence_choice import (
    choice_of_sequences,
    minibatches_of_sequences,
)
from sauna.algorithm.learner.sequences import rollout_outputs, row_outputs, units
from sauna.algorithm.learner.update import (
    Parts,
    acts_on_mean,
    gradient_step,
    loss_advantage,
    minibatch_advantage,
    vex_targets,
)
from sauna.algorithm.selection.draws import (
    draw,
    effective_size,
    minibatch_count,
    minibatch_places,
    minibatch_size,
)
from sauna.algorithm.types import (
    Array,
    Batch,
    Choice,
    Draw,
    Hypers,
    Rollout,
    Samples,
    TrainState,
)
from sauna.config.settings import Config


class Totals(NamedTuple):
    """Sums over the gradient steps of one iteration; `stopped` ends it."""

    losses: Losses
    gradient_norm: Array
    steps: Array  # [] int32
    effective_size: Array
    drawn: Array  # [] rows of the policy loss, over epochs
    epochs: Array  # [] int32 begun
    rows: Array  # [] int32 through the gradient
    stopped: Array  # [] bool


def needs_selection(parts: Parts) -> bool:
    """Whether something of a run's rules takes more than PPO's plain loop."""
    config, rules = parts.config, parts.rules
    in_place = config.dropped == "mask" or config.recurrent != "none"
    masked = config.filter != "none" and in_place
    chosen = bool(rules.sampler or rules.stop or parts.replay)
    return masked or chosen or config.recompute_advantages


def update_on_selected(
    state: TrainState,
    batch: Batch,
    rollout: Rollout,
    hypers: Hypers,
    order: Array,
    key: Array,
    *,
    parts: Parts,
) -> tuple[TrainState, Totals]:
    """Epochs over the rows that the run's rule chooses.

    Args:
      batch: `[M]` samples; rollout: where they are from.
      order: `[epochs, M]` int32, a permutation for each epoch; or of the first K = `drawn_length`
        rows that are kept.
      key: of this iteration's draws.
    """
    sampler = parts.rules.sampler
    choice = None
    if sampler is None or not sampler.each_epoch:
        state, choice = choose(state, batch, rollout, choice_key(key), parts=parts)

    def not_last(carry: tuple[Array, TrainState, Totals]) -> Array:
        return (carry[0] < parts.config.epochs) & ~carry[2].stopped

    def epoch(carry: tuple[Array, TrainState, Totals]) -> tuple[Array, TrainState, Totals]:
        e, state, totals = carry
        now, chosen = batch, choice
        if parts.config.recompute_advantages:
            length = parts.config.sequence_length
            value = rollout_outputs(parts.policy, state.params, rollout, length).value
            now = recomputed(batch, rollout, value, hypers, config=parts.config)
        if chosen is None:
            state, chosen = choose(state, now, rollout, choice_key(key, e), parts=parts)
        draws = order[e], epoch_key(key, e)
        state, totals = _epoch(state, totals, now, chosen, rollout, hypers, draws, parts=parts)
        return e + 1, state, totals

    start = (jnp.int32(0), state, _no_totals())
    _, state, totals = jax.lax.while_loop(not_last, epoch, start)
    return state, totals


def epoch_key(key: Array, epoch: Any) -> Array:
    """The key of an epoch's draws, from that of the iteration's."""
    return jax.random.fold_in(key, epoch + 1)


def choice_key(key: Array, epoch: Any = None) -> Array:
    """The key of a choice that is made before all epochs, or before one of them."""
    return (
        jax.random.fold_in(key, 0)
        if epoch is None
        else jax.random.fold_in(epoch_key(key, epoch), 2)
    )


def first_draw(
    state: TrainState, batch: Batch, rollout: Rollout, order: Array, key: Array, *, parts: Parts
) -> tuple[TrainState, Choice, Draw]:
    """What the first epoch of an update learns from; arguments as of `update_on_selected`.

    Of a recurrent policy, the draw is one of sequences.
    """
    sampler = parts.rules.sampler
    each_epoch = sampler is not None and sampler.each_epoch
    own = choice_key(key, 0) if each_epoch else choice_key(key)
    state, choice = choose(state, batch, rollout, own, parts=parts)
    return state, choice, _drawn(choice, batch, rollout, order[0], epoch_key(key, 0), parts)


def choose(
    state: TrainState, batch: Batch, rollout: Rollout, key: Array, *, parts: Parts
) -> tuple[TrainState, Choice]:
    """What the run's sampler takes; every row that is present if it has none."""
    sampler, present = parts.rules.sampler, batch.weight > 0
    if sampler is None:
        return state, Choice(keep=present, score=batch.weight)
    standardized = standardize(batch.advantage, batch.weight)
    error = batch.return_ - batch.value
    samples = Samples(
        present,
        batch.observation,
        batch.action,
        batch.log_prob,
        batch.advantage,
        standardized,
        batch.return_,
        batch.value,
        error,
        batch.vex,
    )
    if sampler.reads_policy:
        length = parts.config.sequence_length
        output = row_outputs(parts.policy, state.params, batch, rollout, length)
        distribution = parts.policy.distribution
        samples = samples._replace(
            log_ratio=distribution.log_prob(output.policy, batch.action) - batch.log_prob,
            policy=output.policy,
            hidden=output.hidden,
            entropy=distribution.entropy(output.policy),
        )
    carried, choice = sampler.choose(state.sampler, samples, key)
    return state._replace(sampler=carried), choice


def drawn_length(parts: Parts, draws: bool = False) -> int:
    """K: the most rows that one epoch draws; of a recurrent policy, sequences.

    Args:
      draws: whether the choice gives probabilities; read of a recurrent policy alone. A mask may
        have a row in every sequence.
    """
    config, sampler = parts.config, parts.rules.sampler
    rows = pool_rows(config)
    if config.recurrent != "none":
        if not draws:
            return units(config)
        rows //= config.sequence_length
    if sampler is None or config.selection_losses == "policy":
        return rows
    return min(rows, max(1, math.ceil(sampler.share * rows - 1e-6)))


def _value_probability(choice: Choice, batch: Batch, parts: Parts) -> Any:
    """What value rows of their own are drawn by `[M]`; None if they are those of the policy loss.

    If a rule that draws touches the policy loss alone, the critic sees all rows.
    """
    if parts.config.selection_losses != "policy":
        return choice.value_probability
    if choice.probability is None:
        return None
    present = batch.weight > 0
    return present / jnp.sum(present)


def _drawn(
    choice: Choice, batch: Batch, rollout: Rollout, order: Array, key: Array, parts: Parts
) -> Draw:
    """One epoch's rows. If a rule touches the policy loss alone, the critic sees all rows."""
    choice = choice._replace(value_probability=_value_probability(choice, batch, parts))
    if parts.config.selection_losses == "policy" and choice.probability is None:
        choice = Choice(keep=batch.weight > 0)
    length = drawn_length(parts, choice.probability is not None)
    if rollout.memory is not None:
        choice = choice_of_sequences(choice, batch, rollout, parts.config.sequence_length)
    return draw(choice, order, key, length)


def _epoch(
    state: TrainState,
    totals: Totals,
    batch: Batch,
    choice: Choice,
    rollout: Rollout,
    hypers: Hypers,
    draws: tuple[Array, Array],
    *,
    parts: Parts,
) -> tuple[TrainState, Totals]:
    """One epoch; `draws` are the order of its rows and the key of its draws."""
    config, (order, key) = parts.config, draws
    drawn = _drawn(choice, batch, rollout, order, key, parts)
    mode, length = config.selection_mode, 1
    if rollout.memory is not None:
        length = config.sequence_length
        if config.filter != "none" and config.dropped == "replace":
            mode = "smaller"  # as many gradient steps as PPO's, however many rows were dropped
    full = config.rollout_steps * config.envs // length // config.minibatches
    longest = drawn_length(parts, choice.probability is not None)
    size = minibatch_size(mode, full, config.minibatches, longest)
    steps = minibatch_count(mode, drawn.number, size, config.minibatches)
    kept = drawn.number * length
    if choice.probability is None:
        kept = jnp.minimum(kept, jnp.sum(choice.keep, dtype=jnp.int32))
    totals = totals._replace(drawn=totals.drawn + kept, epochs=totals.epochs + 1)
    batch = _standardized(batch, choice, config)
    part_of: Callable[[Array, Array], Minibatch]
    part_of = partial(minibatch, batch, choice, drawn, parts=parts)
    if rollout.memory is not None:
        values = _value_probability(choice, batch, parts)
        part_of = minibatches_of_sequences(batch, choice, drawn, rollout, values, parts=parts)

    def continues(now: tuple[Array, TrainState, Totals]) -> Array:
        return (now[0] < steps) & ~now[2].stopped

    def step(now: tuple[Array, TrainState, Totals]) -> tuple[Array, TrainState, Totals]:
        i, state, totals = now
        places, counts = minibatch_places(mode, i, drawn.number, size, config.minibatches)
        part = part_of(places, counts)
        after, losses, norm = gradient_step(state, part, hypers, parts=parts)
        return i + 1, *_counted(totals, state, after, losses, norm, part)

    _, state, totals = jax.lax.while_loop(continues, step, (jnp.int32(0), state, totals))
    return state, totals


def _standardized(batch: Batch, choice: Choice, config: Config) -> Batch:
    """Advantages as the loss uses them, if they are standardised over more than a minibatch."""
    if config.normalize_over == "minibatch":
        return batch
    over = batch.weight
    if config.normalize_over == "kept" and choice.keep is not None:
        over = over * choice.keep
    return batch._replace(advantage=loss_advantage(batch.advantage, over, config))


def minibatch(
    batch: Batch, choice: Choice, drawn: Draw, places: Array, counts: Array, *, parts: Parts
) -> Minibatch:
    """The rows of one gradient step with the weights that the choice gives them.

    Args:
      places: `[B]` among the rows drawn; counts: `[B]` bool, False for a place left empty.
    """
    index, value_index = drawn.rows[places], drawn.value_rows[places]
    rows = _rows(batch, index, counts)
    for_all = parts.config.selection_losses == "all"
    separate = choice.value_probability is not None or (
        choice.probability is not None and not for_all
    )
    value_rows = _rows(batch, value_index, counts) if separate else rows
    mask, mean_scale = rows.weight, None
    if choice.keep is not None and not for_all:
        kept = mask * choice.keep[index]
        if acts_on_mean(parts):
            mean_scale = scale_of_kept(kept, mask)
        else:
            mask = kept
    advantage = minibatch_advantage(rows._replace(weight=mask), parts.config)
    value_weight = choice.value_weight if for_all else None
    scale = None if choice.weight is None else choice.weight[index]
    if rows.importance is not None:
        scale = rows.importance if scale is None else scale * rows.importance
    return Minibatch(
        rows=rows,
        value_rows=value_rows,
        advantage=advantage,
        vex_target=vex_targets(value_rows, parts.target),
        policy_mask=mask,
        policy_scale=scale,
        value_mask=value_rows.weight,
        value_scale=None if value_weight is None else value_weight[value_index],
        mean_scale=mean_scale,
    )


def _rows(batch: Batch, index: Array, counts: Array) -> Batch:
    part = jax.tree.map(lambda x: x[index], batch)
    part = part._replace(weight=part.weight * counts)
    if part.next_weight is None:
        return part
    return part._replace(next_weight=part.next_weight * counts)


def _counted(
    totals: Totals,
    before: TrainState,
    after: TrainState,
    losses: Losses,
    norm: Array,
    part: Minibatch,
) -> tuple[TrainState, Totals]:
    """Takes the step and counts it, unless the stop rule says that it is one too many."""
    stop = jnp.bool_(False) if losses.stop is None else losses.stop
    effective = losses.effective_size
    if effective is None:
        weight = times(times(part.policy_mask, part.policy_scale), part.mean_scale)
        effective = effective_size(weight)
    more = Totals(
        jax.tree.map(jnp.add, totals.losses, losses._replace(stop=None, effective_size=None)),
        totals.gradient_norm + norm,
        totals.steps + 1,
        totals.effective_size + effective,
        totals.drawn,
        totals.epochs,
        totals.rows,
        totals.stopped,
    )
    chosen: Any = jax.tree.map(
        lambda new, old: jnp.where(stop, old, new), (after, more), (before, totals)
    )
    computed = len(part.advantage) * (1 if part.value_rows is part.rows else 2)
    return chosen[0], chosen[1]._replace(rows=totals.rows + computed, stopped=totals.stopped | stop)


def _no_totals() -> Totals:
    zero = jnp.float32(0.0)
    losses = Losses(zero, zero, zero, zero, zero, zero, zero)
    none = jnp.int32(0)
    return Totals(losses, zero, none, zero, none, none, none, jnp.bool_(False))
