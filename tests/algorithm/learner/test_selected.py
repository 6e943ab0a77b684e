"""The update under rules of selection: which rows each step takes, what it counts, what stays."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithm.selection import oracle, oracle_loss
from arrays import batch_of, hypers, losses_on, no_key, parts_of, random_batch, random_rollout
from helpers import configured
from sauna.algorithm.learner import ppo
from sauna.algorithm.learner.learn import learn
from sauna.algorithm.learner.losses import Losses, Minibatch
from sauna.algorithm.learner.metrics import UpdateMetrics
from sauna.algorithm.learner.samples import recomputed
from sauna.algorithm.learner.selected import choose, minibatch
from sauna.algorithm.learner.update import (
    Parts,
    gradient_step,
    init_state,
    loss_advantage,
    minibatch_losses,
    plain_minibatch,
    update_on_all,
)
from sauna.algorithm.learner.vex_targets import TARGETS
from sauna.algorithm.policy.distributions import gaussian
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.selection.control import controlled
from sauna.algorithm.selection.delight import delight
from sauna.algorithm.selection.gigaflow import gigaflow
from sauna.algorithm.selection.gradient_norm import gradient_norm
from sauna.algorithm.selection.kondo import kondo
from sauna.algorithm.selection.registry import Rules
from sauna.algorithm.types import (
    Batch,
    Choice,
    Draw,
    Hypers,
    LossWeight,
    PolicyOutput,
    Rollout,
    Sampler,
    SamplerSetup,
    StopRule,
    TrainState,
    member_keys,
    selection_key,
)
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces

STEPS, ENVS, EPOCHS, MINIBATCHES = 12, 2, 2, 3
ROWS, SIZE = STEPS * ENVS, STEPS * ENVS // MINIBATCHES
SPACES = Spaces("vector", (2,), "continuous", (1,), "", "")
CONFIG = configured(
    arm="ppo", rollout_steps=STEPS, envs=ENVS, minibatches=MINIBATCHES, epochs=EPOCHS, hidden="4,4"
)
SETUP = SamplerSetup(STEPS, ENVS, 5, "continuous", (1,))


class Given(NamedTuple):
    """What one update starts from, in float32; the policy that acted is the one that learns."""

    parts: Parts
    state: TrainState
    rollout: Rollout
    batch: Batch
    hypers: Hypers
    order: Any


def floats(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x, np.float32 if x.dtype == float else None), tree)


@pytest.fixture(scope="module")
def given() -> Given:
    policy = make_policy(CONFIG, SPACES)
    parts = parts_of(CONFIG, policy)
    state, rollout = init_state(parts, jax.random.key(1)), floats(random_rollout(3, STEPS, ENVS))
    output = jax.jit(policy.apply)(state.params, rollout.observation)
    rollout = rollout._replace(log_prob=policy.distribution.log_prob(output.policy, rollout.action))
    h = floats(hypers(entropy_coef=0.0))
    batch = batch_of(rollout, h, no_key(), config=CONFIG, target=TARGETS["sample"])
    rng = np.random.default_rng(0)
    order = rng.permuted(np.tile(np.arange(ROWS, dtype=np.int32), (EPOCHS, 1)), axis=1)
    return Given(parts, state, rollout, batch, h, jnp.asarray(order))


@pytest.fixture(scope="module")
def plain(given: Given) -> tuple[TrainState, Losses, Any]:
    update = jax.jit(partial(update_on_all, parts=given.parts))
    return update(given.state, given.batch, given.hypers, given.order)


@pytest.fixture(scope="module")
def step(given: Given) -> Any:
    """One gradient step on rows that are given with weights."""

    def run(state: TrainState, rows: Any, weight: Any) -> TrainState:
        part = jax.tree.map(lambda x: x[rows], given.batch)._replace(weight=weight)
        here = plain_minibatch(part, given.parts)
        return gradient_step(state, here, given.hypers, parts=given.parts)[0]

    return jax.jit(run)


def learner(given: Given, *, each_epoch: bool = False, share: float = 1.0, **settings: Any) -> Any:
    """`(keep [M], limit) -> (state, metrics)`: rows to keep, and a stop rule's limit, are traced.

    The sampler's state counts how often it was asked.
    """
    config = dataclasses.replace(CONFIG, **settings)

    def run(keep: Any, limit: Any) -> tuple[TrainState, UpdateMetrics]:
        sampler = Sampler(
            lambda: jnp.int32(0),
            lambda count, s, key: (count + 1, Choice(keep=keep & s.present)),
            share=share,
            each_epoch=each_epoch,
        )
        far = StopRule(lambda log_ratio, weight: jnp.max(jnp.abs(log_ratio)) > limit)
        parts = given.parts._replace(config=config, rules=Rules(sampler=sampler, stop=far))
        state = given.state._replace(sampler=jnp.int32(0))
        data = (given.rollout, given.batch, given.hypers, given.order)
        return learn(state, *data, no_key(), parts=parts)

    return jax.jit(run)


@pytest.fixture(scope="module")
def fewer(given: Given) -> Any:
    return learner(given)


EVERY = np.ones(ROWS, bool)
TEN = np.isin(np.arange(ROWS), [0, 1, 4, 5, 8, 11, 13, 17, 20, 22])
ONE, NONE = np.arange(ROWS) == 7, np.zeros(ROWS, bool)
NEVER = np.float32(np.inf)


def counts(metrics: UpdateMetrics) -> list[float]:
    work = metrics.work
    return [float(x) for x in (work.gradient_steps, work.samples_forward, work.samples_backward)]


def close(one: TrainState, other: TrainState) -> None:
    np.testing.assert_allclose(one.params, other.params, rtol=1e-4, atol=2e-6)


def test_a_sampler_that_keeps_all_rows_and_a_stop_that_never_comes_are_ppo(
    fewer: Any, plain: Any
) -> None:
    state, metrics = fewer(EVERY, NEVER)
    close(state, plain[0])
    for name in ("policy_loss", "value_loss", "entropy", "kl", "clip_fraction"):
        mean = np.asarray(getattr(plain[1], name))
        np.testing.assert_allclose(getattr(metrics, name), mean, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(metrics.gradient_norm, plain[2], rtol=1e-4)
    assert counts(metrics) == [EPOCHS * MINIBATCHES, EPOCHS * ROWS, EPOCHS * ROWS]
    assert metrics.work.sample_rate == 1.0 and metrics.work.effective_sample_size == SIZE
    assert state.sampler == 1 and bool(metrics.finite)


def test_each_step_learns_from_the_rows_that_numpy_says(
    given: Given, fewer: Any, step: Any
) -> None:
    """10 rows kept: per epoch a full minibatch of 8, and one of 2 filled with 6 from the front."""
    state, metrics = fewer(TEN, NEVER)
    expected = given.state
    for order in np.asarray(given.order):
        for rows in oracle.minibatches(TEN, order, SIZE, "filled"):
            expected = step(expected, rows, np.ones(SIZE, np.float32))
    close(state, expected)
    other, _ = fewer(np.roll(TEN, 1), NEVER)
    assert not np.allclose(other.params, expected.params, rtol=1e-4, atol=2e-6)
    assert counts(metrics) == [4, 32, 32]
    np.testing.assert_allclose(metrics.work.sample_rate, 10 / 24)


def test_rows_kept_beyond_the_share_are_neither_learned_from_nor_counted(given: Given) -> None:
    _, metrics = learner(given, share=0.5)(EVERY, NEVER)
    assert metrics.work.samples_backward == EPOCHS * ROWS / 2
    assert metrics.work.sample_rate == 0.5


def test_nothing_kept_changes_nothing(given: Given, fewer: Any) -> None:
    state, metrics = fewer(NONE, NEVER)
    for new, old in zip(jax.tree.leaves(state[:2]), jax.tree.leaves(given.state[:2]), strict=True):
        assert np.asarray(new).tobytes() == np.asarray(old).tobytes()
    assert counts(metrics) == [0, 0, 0] and metrics.work.sample_rate == 0.0
    assert bool(metrics.finite) and np.isnan(metrics.policy_loss), "means of no step are left out"


def test_one_row_alone_is_learned_from_and_stays_finite(given: Given, fewer: Any) -> None:
    """Alone in its minibatch it has advantage 0: only the value learns."""
    state, metrics = fewer(ONE, NEVER)
    assert counts(metrics) == [2, 16, 16] and bool(metrics.finite)
    assert np.isfinite(state.params).all() and not np.array_equal(state.params, given.state.params)
    head = lambda s: given.parts.policy.unravel(s.params)["params"]["policy_head"]  # noqa: E731
    np.testing.assert_array_equal(head(state)["kernel"], head(given.state)["kernel"])


def test_a_stop_rule_is_asked_before_each_step(given: Given, fewer: Any, step: Any) -> None:
    """At the first step every ratio is 1; at the second it is not, and that one is not taken."""
    at_once, metrics = fewer(EVERY, np.float32(-1.0))
    assert np.array_equal(at_once.params, given.state.params)
    assert counts(metrics) == [0, SIZE, SIZE], "the gradient of the step that is not taken"
    state, metrics = fewer(EVERY, np.float32(1e-6))
    first = step(given.state, np.asarray(given.order)[0, :SIZE], np.ones(SIZE, np.float32))
    close(state, first)
    assert counts(metrics) == [1, 2 * SIZE, 2 * SIZE]
    assert metrics.work.sample_rate == 1.0 and bool(metrics.finite)


def test_smaller_steps_share_what_is_kept(given: Given, step: Any) -> None:
    """K = 12 rows: minibatches of at most 4. 10 rows: 3, 3 and 4. The sampler is asked anew."""
    smaller = learner(given, share=0.5, selection_mode="smaller", each_epoch=True)
    state, metrics = smaller(TEN, NEVER)
    expected = given.state
    for order in np.asarray(given.order):
        rows = order[TEN[order]]
        for part in (rows[:3], rows[3:6], rows[6:]):
            weight = np.arange(SIZE) < len(part)
            expected = step(expected, np.resize(part, SIZE), weight.astype(np.float32))
    close(state, expected)
    assert counts(metrics) == [6, 24, 24] and state.sampler == EPOCHS
    state, metrics = smaller(ONE, NEVER)
    assert counts(metrics) == [2, 8, 8] and bool(metrics.finite), "no step without a row"


def test_a_rule_for_the_policy_alone_leaves_the_critic_its_rows(given: Given) -> None:
    policy_only = learner(given, selection_losses="policy")
    state, metrics = policy_only(NONE, NEVER)
    new, old = (given.parts.policy.unravel(s.params)["params"] for s in (state, given.state))
    for name in ("policy_head", "log_std"):
        for a, b in zip(jax.tree.leaves(new[name]), jax.tree.leaves(old[name]), strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.array_equal(new["value_head"]["kernel"], old["value_head"]["kernel"])
    assert counts(metrics) == [6, 48, 48] and metrics.work.sample_rate == 0.0


def test_rows_drawn_for_the_policy_alone_leave_the_critics_unweighted(given: Given) -> None:
    """The critic's rows are then drawn evenly, and weights undo no other probabilities."""
    p = jnp.arange(1.0, ROWS + 1) / (ROWS * (ROWS + 1) / 2)
    choice = Choice(probability=p, weight=1 / (ROWS * p), value_probability=p, value_weight=1 / p)
    drawn = Draw(jnp.arange(SIZE), jnp.arange(SIZE) + 3, jnp.int32(ROWS))
    for losses, scaled in (("all", True), ("policy", False)):
        config = dataclasses.replace(CONFIG, selection_losses=losses)
        parts = given.parts._replace(config=config)
        of = jax.jit(partial(minibatch, parts=parts))
        got = of(given.batch, choice, drawn, jnp.arange(SIZE), jnp.ones(SIZE, bool))
        assert (got.value_scale is not None) is scaled
        np.testing.assert_allclose(got.policy_scale, 1 / (ROWS * p[:SIZE]))
        np.testing.assert_array_equal(got.value_rows.return_, given.batch.return_[3 : SIZE + 3])
        np.testing.assert_array_equal(got.rows.return_, given.batch.return_[:SIZE])


def test_what_a_sampler_only_looks_at_is_counted(given: Given) -> None:
    """Rows of its own for the value loss: each step goes through the network twice."""
    parts = given.parts._replace(rules=Rules(sampler=gradient_norm(SETUP)))
    data = (given.state, given.rollout, given.batch, given.hypers, given.order)
    state, metrics = jax.jit(partial(learn, parts=parts))(*data, no_key())
    assert counts(metrics) == [6, 2 * 48 + ROWS, 2 * 48] and bool(metrics.finite)
    assert 1 < metrics.work.effective_sample_size < SIZE
    assert not np.array_equal(state.params, given.state.params)


def test_a_control_takes_as_many_steps_of_other_rows(given: Given) -> None:
    """The rule keeps a part of the rows that fills no whole number of minibatches."""
    rule = gigaflow(SETUP, threshold=0.3)
    start = given.state._replace(sampler=rule.init())
    data = (start, given.rollout, given.batch, given.hypers, given.order)
    found = []
    for sampler in (rule, controlled("random", rule)):
        parts = given.parts._replace(rules=Rules(sampler=sampler))
        found.append(jax.jit(partial(learn, parts=parts))(*data, no_key()))
    (one, by_rule), (other, by_control) = found
    assert by_rule.work == by_control.work and 0 < by_rule.work.sample_rate < 1
    assert one.sampler == other.sampler
    assert not np.allclose(one.params, other.params, rtol=1e-4, atol=2e-6)


# ---------------------------------------------------------------------- advantages


@pytest.mark.parametrize("over", ["minibatch", "rollout", "kept"])
def test_positive_advantages_are_cut_at_zero_over_any_set(over: str) -> None:
    """Not below it: standardised advantages are centred, and half of the good ones were lost."""
    rng = np.random.default_rng(0)
    advantage = jnp.asarray(rng.normal(size=50) + 1.0, jnp.float32)
    config = dataclasses.replace(CONFIG, advantage_sign="positive", normalize_over=over)
    got = loss_advantage(advantage, jnp.ones(50), config)
    expected = oracle.positive_advantage(advantage)
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    assert not np.allclose(got, np.maximum(oracle.standardise(advantage), 0), atol=1e-2)


def test_avecs_values_are_right_on_average() -> None:
    """The constant added to V makes mean(R - V) 0, also where padding and episodes' ends are."""
    rollout = random_rollout(5, STEPS, ENVS)
    valid = np.arange(STEPS)[:, None] < np.array([STEPS, 7])
    rollout = floats(rollout._replace(valid=valid, keep=valid))
    h = floats(hypers())

    def mean_error(critic: str) -> float:
        config = dataclasses.replace(CONFIG, critic=critic, clip_value=False)
        batch = batch_of(rollout, h, no_key(), config=config, target=TARGETS["sample"])
        error = np.asarray(batch.return_ - batch.value) * np.asarray(batch.weight)
        return float(error.sum() / np.sum(batch.weight))

    assert abs(mean_error("avec")) < 1e-6
    assert abs(mean_error("squared")) > 0.01


@pytest.mark.parametrize("truncation", ["bootstrap", "terminate"])
def test_recomputed_advantages_are_numpys_with_todays_values(truncation: str) -> None:
    """Behind an episode's end and the last row the successor's value stays that of collection."""
    rollout = random_rollout(6, STEPS, ENVS)
    now = np.random.default_rng(1).normal(size=(STEPS, ENVS))
    ended = rollout.terminated | rollout.truncated
    outside = ended.copy()
    outside[-1] = True
    following = np.where(outside, rollout.next_value, np.roll(now, -1, 0))
    cut = ended if truncation == "terminate" else rollout.terminated
    advantage, return_ = oracle_loss.gae(rollout.reward, now, following, cut, ended, 0.9, 0.8)
    config: Config = dataclasses.replace(CONFIG, truncation=truncation, recompute_advantages=True)
    single, h = floats(rollout._replace(keep=np.ones((STEPS, ENVS), bool))), floats(hypers())
    batch = batch_of(single, h, no_key(), config=config, target=TARGETS["sample"])
    got = recomputed(batch, single, jnp.asarray(now, jnp.float32), h, config=config)
    np.testing.assert_allclose(got.advantage, advantage.ravel(), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(got.return_, return_.ravel(), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(got.value, batch.value)
    np.testing.assert_array_equal(got.log_prob, batch.log_prob)
    same = recomputed(batch, single, single.value, h, config=config)
    moved = np.asarray(same.advantage - batch.advantage)[~np.roll(ended, -1, 0).ravel()]
    assert not np.allclose(got.advantage, batch.advantage, atol=1e-2)
    assert np.isfinite(moved).all()


# ---------------------------------------------------------------------- weights of the loss


@pytest.mark.parametrize("on", ["mean", "all"])
def test_delight_on_the_mean_leaves_the_log_std_its_gradient(on: Any) -> None:
    rng = np.random.default_rng(2)
    mean, action = rng.normal(size=(2, 10, 2))
    log_std, advantage = rng.normal(size=2) * 0.3, rng.normal(size=10)
    parameters = jnp.asarray(np.concatenate([mean, np.tile(log_std, (10, 1))], -1), jnp.float32)
    distribution, zero = gaussian(2), jnp.zeros(10)
    old = distribution.log_prob(parameters, jnp.asarray(action, jnp.float32))
    h = floats(hypers())

    def policy_loss(parameters: Any, rule: Any) -> Any:
        output = PolicyOutput(parameters, zero, zero, zero[:, None], None)
        rows = Batch(zero, jnp.asarray(action, jnp.float32), old, zero, zero, zero, zero, zero + 1)
        part = Minibatch(
            rows, rows, jnp.asarray(advantage, jnp.float32), zero, zero + 1, None, zero + 1, None
        )
        losses = ppo.losses(
            output,
            output,
            part,
            h,
            config=CONFIG,
            distribution=distribution,
            rules=Rules(loss_weight=rule),
        )
        return losses.policy_loss

    def gradient_of(rule: Any) -> np.ndarray:
        return -10 * np.asarray(jax.jit(jax.grad(lambda p: policy_loss(p, rule)))(parameters))

    gradient = gradient_of(delight(on=on))
    entropy = np.asarray(distribution.entropy(parameters))
    weight = oracle.delight_weight(advantage, np.asarray(old), entropy)
    z = (action - mean) / np.exp(log_std)
    expected = oracle_loss.gaussian_score(weight, advantage, z, np.exp(log_std), on)
    np.testing.assert_allclose(gradient, np.concatenate(expected, -1), rtol=1e-3, atol=1e-4)
    without = gradient_of(None)
    same = np.allclose(gradient[:, 2:], without[:, 2:], rtol=1e-4, atol=1e-5)
    assert same is (on == "mean") and not np.allclose(gradient[:, :2], without[:, :2], rtol=1e-2)


def test_kondos_choice_of_noise_does_not_widen_a_gaussian() -> None:
    """Advantages that know nothing of the actions move the log-std as they do without a rule.

    The negative control lets the log-std learn from the kept rows, too: they widen the policy. The
    mean learns from the kept rows in both forms, and from other rows under the matched control.
    """
    count, settings = 2048, {"selection_losses": "policy", "normalize_over": "rollout"}
    config: Config = dataclasses.replace(CONFIG, rollout_steps=count, envs=1, **settings)
    policy = make_policy(config, SPACES._replace(action_sizes=(3,)))
    params, rng = policy.init(jax.random.key(0)), np.random.default_rng(0)
    seen, noise = (jnp.asarray(rng.normal(size=(count, n)), jnp.float32) for n in (2, 3))
    output, zero = policy.apply(params, seen), jnp.zeros(count)
    action = policy.distribution.sample(output.policy, noise)
    batch = Batch(seen, action, *[zero] * 5, zero + 1)._replace(
        log_prob=policy.distribution.log_prob(output.policy, action),
        advantage=jnp.asarray(oracle.standardise(rng.normal(size=count)), jnp.float32),
    )
    rows = jnp.arange(count, dtype=jnp.int32)

    def ascent(sampler: Sampler | None) -> tuple[Any, Any]:
        """The policy objective's gradient on the log-std, and on everything else."""
        parts = parts_of(config, policy, sampler=sampler)
        state, h, rollout = TrainState(params, ()), floats(hypers()), floats(random_rollout(0))
        choice = choose(state, batch, rollout, no_key(), parts=parts)[1]
        drawn = Draw(rows, rows, jnp.int32(count))
        part = minibatch(batch, choice, drawn, rows, rows >= 0, parts=parts)
        loss = lambda x: -minibatch_losses(x, part, h, parts=parts).policy_loss  # noqa: E731
        gradient = dict(policy.unravel(jax.jit(jax.grad(loss))(params))["params"])
        log_std = gradient.pop("log_std")
        return log_std, np.concatenate([x.ravel() for x in jax.tree.leaves(gradient)])

    setup = SamplerSetup(count, 1, 5, "continuous", (3,))
    rules = (None, kondo(setup), kondo(setup, on="all"), controlled("random", kondo(setup)))
    plain, kept, whole, random = map(ascent, rules)
    for log_std, _ in (kept, random):
        np.testing.assert_allclose(log_std, plain[0], rtol=1e-4, atol=1e-5)
    assert abs(np.sum(kept[0])) < 0.15 and np.sum(whole[0]) > 1.5
    np.testing.assert_allclose(kept[1], whole[1], rtol=1e-3, atol=1e-5)
    for _, other in (plain, random):
        assert not np.allclose(kept[1], other, rtol=0.1, atol=1e-3)


@pytest.mark.parametrize("algorithm", ["ppo", "a2c"])
def test_a_loss_weight_sees_the_ratio_whatever_the_objective_is(algorithm: str) -> None:
    """For A2C it was the log-probability, so that sample dropout dropped rows by that."""
    seen: list[Any] = []

    def look(terms: Any) -> tuple[Any, Any]:
        seen.append(terms)
        return terms.present, jnp.ones_like(terms.present)

    policy = make_policy(CONFIG, Spaces("vector", (3,), "continuous", (2,), "", ""))
    config = dataclasses.replace(CONFIG, algorithm=algorithm)
    batch, params = floats(random_batch()), policy.init(jax.random.key(0))
    uncompiled = losses_on.__wrapped__  # its terms are looked at
    uncompiled(
        params, batch, floats(hypers()), parts_of(config, policy, loss_weight=LossWeight(look))
    )
    now = policy.distribution.log_prob(policy.apply(params, batch.observation).policy, batch.action)
    ratio = np.where(np.asarray(batch.weight) > 0, now - batch.log_prob, 0.0)
    np.testing.assert_allclose(seen[0].log_ratio, ratio, rtol=1e-5)
    np.testing.assert_allclose(
        seen[0].log_prob[np.asarray(batch.weight) > 0], now[batch.weight > 0]
    )


def test_draws_share_no_key_with_the_orders_of_the_epochs() -> None:
    """On the device, where `split(key, epochs)[e]` is `fold_in(key, e)`."""
    keys = member_keys(0)
    for iteration in (0, 3):
        orders = jax.random.split(jax.random.fold_in(keys.order, iteration), 64)
        own = np.asarray(jax.random.key_data(selection_key(keys, iteration)))
        assert not (np.asarray(jax.random.key_data(orders)) == own).all(-1).any()


def test_recomputed_advantages_are_of_the_steps_that_a_control_keeps() -> None:
    """With the values of collection nothing changes, whichever steps were kept."""
    config = configured(
        arm="sauna+random", recompute_advantages=True, rollout_steps=STEPS, envs=ENVS, minibatches=1
    )
    rollout, h = floats(random_rollout(6, STEPS, ENVS, 0.5)), floats(hypers())
    batch = batch_of(rollout, h, jax.random.key(0), config=config, target=TARGETS["sample"])
    kept = jnp.zeros(STEPS * ENVS, bool).at[batch.row].set(batch.weight > 0)
    assert bool(jnp.any(kept != rollout.keep.ravel()))
    ended = rollout.terminated | rollout.truncated
    following = jnp.concatenate([rollout.value[1:], rollout.next_value[-1:]])
    rollout = rollout._replace(next_value=jnp.where(ended, rollout.next_value, following))
    batch = batch_of(rollout, h, jax.random.key(0), config=config, target=TARGETS["sample"])
    again = recomputed(batch, rollout, rollout.value, h, config=config)
    np.testing.assert_allclose(again.advantage, batch.advantage, rtol=1e-4, atol=1e-5)
