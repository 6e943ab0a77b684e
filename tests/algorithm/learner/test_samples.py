"""What a rollout becomes before the update, and the keys and orders that an iteration draws."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arrays import (
    batch_of,
    hypers,
    losses_of_terms,
    losses_on,
    no_key,
    parts_of,
    random_batch,
    random_rollout,
    unscored,
)
from helpers import configured
from sauna.algorithm.learner import ppo
from sauna.algorithm.learner.metrics import head_statistics
from sauna.algorithm.learner.samples import advantages_over_all
from sauna.algorithm.learner.update import minibatch_order
from sauna.algorithm.learner.vex_targets import TARGETS
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.rollout.program import decide, make_program
from sauna.algorithm.selection.history import empty_history
from sauna.algorithm.selection.random_drop import random_drop
from sauna.algorithm.selection.vex_filter import informative, sauna_per_env
from sauna.algorithm.types import Hypers, Keys, Rollout, member_keys
from sauna.envs.spaces import Spaces

VECTOR = Spaces("vector", (3,), "continuous", (2,), "", "")
CONFIG = configured(rollout_steps=40, envs=3, minibatches=4)
over_all = jax.jit(advantages_over_all, static_argnums=2)


def single(rollout: Rollout) -> Rollout:
    return jax.tree.map(
        lambda x: jnp.asarray(x, np.float32) if x.dtype == float else jnp.asarray(x), rollout
    )


def scalars(**values: float) -> Hypers:
    return jax.tree.map(np.float32, hypers(**values))


@pytest.mark.parametrize("name", ["rollout", "sample"])
def test_returns_and_targets_are_those_of_the_kept_steps(name: str) -> None:
    rollout = random_rollout(7, keep_rate=0.6)
    batch = batch_of(single(rollout), scalars(), no_key(), config=CONFIG, target=TARGETS[name])
    advantage = np.asarray(over_all(single(rollout), scalars(), True))
    columns = [
        np.asarray(x).reshape(40, 3)
        for x in (batch.return_, batch.log_prob, batch.value, batch.vex_target)
    ]
    for n in range(3):
        keep = rollout.keep[:, n]
        return_, log_prob, value, target = (column[: keep.sum(), n] for column in columns)
        expected = (advantage[:, n] + rollout.value[:, n])[keep]
        np.testing.assert_allclose(return_, expected, atol=1e-5)
        np.testing.assert_array_equal(log_prob, rollout.log_prob[keep, n].astype(np.float32))
        square = (expected - value) ** 2
        square = square if name == "sample" else square.mean()
        wanted = np.clip(1 - square / expected.var(), -5.0 if name == "sample" else -np.inf, 1.0)
        np.testing.assert_allclose(target, np.broadcast_to(wanted, target.shape), atol=1e-3)


def test_a_target_per_minibatch_is_computed_on_the_minibatch() -> None:
    """And no other one is: what the batch holds counts for those."""
    assert [name for name in TARGETS if TARGETS[name].per_minibatch] == ["minibatch"]
    policy = make_policy(CONFIG, VECTOR)
    params = policy.init(jax.random.key(0))
    batch = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), random_batch())
    output = jax.jit(policy.apply)(params, batch.observation)
    for name in ("minibatch", "sample"):
        losses = losses_on(params, batch, scalars(), parts_of(CONFIG, policy, name))
        on = np.asarray(batch.weight) > 0
        residual, return_ = (
            np.asarray(batch.return_ - batch.value)[on],
            np.asarray(batch.return_)[on],
        )
        target = 1 - residual.var() / return_.var()
        wanted = target if name == "minibatch" else np.asarray(batch.vex_target)[on]
        expected = np.mean((np.asarray(output.vex)[on] - wanted) ** 2)
        np.testing.assert_allclose(losses.vex_loss, expected, rtol=1e-4)


def test_a_masked_slot_counts_for_nothing_whatever_is_in_it() -> None:
    weight = jnp.array([1.0, 1.0, 0.0])
    ones = jnp.ones(3)
    names = ("advantage", "value", "old", "return_", "vex", "vex_target", "entropy")
    terms = {**dict.fromkeys(names, ones), "weight": weight}
    plain, wild = (
        losses_of_terms(ppo, scalars(), CONFIG, log_ratio=[0.1, -0.2, odd], **terms)[:7]
        for odd in (0.0, 500.0)
    )
    assert all(np.isfinite(x) for x in wild)
    np.testing.assert_array_equal(plain, wild)


@pytest.mark.parametrize("number", [5, 6])
def test_the_median_of_odd_and_even_numbers(number: int) -> None:
    vex = jnp.arange(8.0)[:, None] ** 2
    valid = (jnp.arange(8) < number)[:, None]
    middle = head_statistics(vex, valid)[2]
    np.testing.assert_allclose(middle, np.median(np.arange(number) ** 2.0))


def test_every_block_iteration_and_member_has_noise_of_its_own() -> None:
    program = make_program(CONFIG, VECTOR)
    keys = [member_keys(seed) for seed in (0, 1)]
    places = [(k, i, b) for k in keys for i in (0, 1) for b in (0, 1)]
    draws = [np.asarray(program.draw(k.action, np.int32(i), np.int32(b))) for k, i, b in places]
    assert len({draw.tobytes() for draw in draws}) == len(places)
    parts = {np.asarray(jax.random.key_data(key)).tobytes() for k in keys for key in k}
    assert len(parts) == 2 * len(Keys._fields)


def test_every_epoch_iteration_and_member_has_an_order_of_its_own() -> None:
    samples = np.arange(120)
    orders = [minibatch_order(CONFIG, seed, iteration) for seed in (0, 1) for iteration in (0, 1)]
    rows = [row for order in orders for row in order]
    assert len({row.tobytes() for row in rows}) == 4 * CONFIG.epochs
    for row in rows:
        np.testing.assert_array_equal(np.sort(row), samples)
        assert not np.array_equal(row, samples)


def test_a_ratio_that_reaches_the_threshold_exactly_is_kept() -> None:
    """3 / 4 in binary, the epsilon being lost in float32's rounding."""
    history = empty_history((1,), 4)
    history = history._replace(
        ordered=history.ordered.at[0, 0].set(-4e4), number=history.number + 1
    )
    for vex, kept in ((3e4, True), (-3e4, True), (2.9e4, False)):
        got = jax.jit(informative)(jnp.array([vex], jnp.float32), history, jnp.float32(0.75))
        assert bool(got[0]) is kept


@pytest.mark.parametrize(
    "filter", [sauna_per_env("all", 12), sauna_per_env("kept", 12), random_drop()]
)
def test_stretches_decide_as_one_long_segment_does(filter) -> None:
    """Padding behind a segment is not looked at, and a step's key is that of its place."""
    vex = np.random.default_rng(0).normal(size=(12, 2)).astype(np.float32)
    observation, key = np.zeros((12, 2, 3), np.float32), jax.random.key(1)
    given = scalars(threshold=0.8, drop_rate=0.5)
    decided = jax.jit(partial(decide, filter))

    def run(lengths: list[int]) -> np.ndarray:
        state, first, masks = filter.init(2, 12), 0, []
        for length in lengths:
            rows = np.full((12, 2), 99.0, np.float32)
            rows[:length] = vex[first : first + length]
            steps = unscored(observation, rows)
            state, mask = decided(state, steps, np.int32(first), np.int32(length), key, given)
            assert not mask[length:].any()
            masks.append(np.asarray(mask)[:length])
            first += length
        return np.concatenate(masks)

    whole = run([12])
    assert 0 < whole.mean() < 1
    np.testing.assert_array_equal(run([5, 4, 3]), whole)
    np.testing.assert_array_equal(run([1] * 12), whole)
