"""Each sampler against float64 numpy, and with its numbers changed: the difference is noticed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithm.selection import oracle
from arrays import hypers, no_key, unscored
from helpers import configured
from sauna.algorithm.learner.vex_targets import TARGETS
from sauna.algorithm.policy.bounded import beta, squashed
from sauna.algorithm.policy.distributions import bernoulli, gaussian, multi_categorical
from sauna.algorithm.selection.control import controlled
from sauna.algorithm.selection.gigaflow import gigaflow
from sauna.algorithm.selection.gradient_norm import gradient_norm, head_gradient
from sauna.algorithm.selection.kondo import kondo
from sauna.algorithm.selection.pods import pods, widest
from sauna.algorithm.selection.positive import cut_at_zero, positive
from sauna.algorithm.selection.prioritized import prioritized
from sauna.algorithm.selection.scores import count_of
from sauna.algorithm.selection.top_advantage import top_advantage
from sauna.algorithm.selection.vex_filter import sauna_per_env
from sauna.algorithm.selection.vex_oracle import vex_oracle
from sauna.algorithm.types import Sampler, Samples
from selections import (
    DISCRETE,
    ENVS,
    ROWS,
    SETUP,
    STEPS,
    chosen,
    of_present,
    random_samples,
    spread,
)

SEEDS = range(3)
Found = dict[str, np.ndarray]


def largest_of(samples: Samples, score: np.ndarray, share: float) -> np.ndarray:
    """The count is that of all slots: a rollout with empty ones gives up no more rows."""
    return spread(samples, oracle.largest(score, oracle.kept_count(share, ROWS)))


def expected_top(s: Samples) -> Found:
    (advantage,) = of_present(s, "advantage")
    return {"keep": largest_of(s, np.abs(advantage), 0.5)}


def expected_positive(s: Samples) -> Found:
    return {"keep": spread(s, oracle.positive_keep(of_present(s, "advantage")[0]))}


def expected_kondo(s: Samples) -> Found:
    advantage, log_prob, entropy = of_present(s, "standardized", "log_prob", "entropy")
    chi = advantage * oracle.surprisal(log_prob, entropy)
    return {"keep": largest_of(s, chi, 0.3)}


def expected_pods(s: Samples) -> Found:
    advantage = np.asarray(s.advantage, np.float64) * np.asarray(s.present)
    kept = oracle.pods_keep(oracle.segment_scores(advantage.reshape(STEPS, ENVS), 6))
    rows = oracle.segments_to_rows(kept, STEPS, 6).ravel()
    return {"keep": rows & np.asarray(s.present)}


def expected_vex(s: Samples, which: Any = "high") -> Found:
    advantage, value = of_present(s, "advantage", "value")
    share = oracle.vex_share(advantage, value + advantage)
    count = oracle.kept_count(0.5, ROWS)
    return {"keep": spread(s, oracle.vex_keep(share, count / len(share), which))}


def expected_informative(s: Samples, threshold: float = 0.3) -> Found:
    """Each env by itself, its returns' variance, too."""
    columns = [np.asarray(x).reshape(STEPS, ENVS) for x in (s.advantage, s.value, s.present)]
    share = np.zeros((STEPS, ENVS))
    for n, (advantage, value, on) in enumerate(zip(*(x.T for x in columns), strict=True)):
        share[on, n] = oracle.vex_share(advantage[on], (value + advantage)[on])
    keep = oracle.informative_keep(np.maximum(share, -5.0), threshold, columns[2])
    return {"keep": keep.ravel()}


def expected_prioritized(s: Samples, correction: float = 0.2) -> Found:
    p = oracle.prioritized_probabilities(of_present(s, "advantage")[0])
    weight = oracle.prioritized_weights(p, correction)
    return {"probability": spread(s, p), "weight": spread(s, weight)}


def expected_gradient_norm(s: Samples, head: np.ndarray) -> Found:
    p = oracle.mixed_probabilities(head)
    value_p = oracle.mixed_probabilities(np.abs(of_present(s, "error")[0]))
    return {
        "probability": spread(s, p),
        "weight": spread(s, oracle.importance_weights(p)),
        "value_probability": spread(s, value_p),
        "value_weight": spread(s, oracle.importance_weights(value_p)),
    }


def expected_gaussian(s: Samples) -> Found:
    names = ("standardized", "action", "policy", "hidden")
    advantage, action, policy, hidden = of_present(s, *names)
    mean, log_std = np.split(policy, 2, -1)
    head = oracle.gaussian_gradient_norm(advantage, action, mean, np.exp(log_std), hidden)
    return expected_gradient_norm(s, head)


def expected_categorical(s: Samples) -> Found:
    names = ("standardized", "action", "policy", "hidden")
    advantage, action, policy, hidden = of_present(s, *names)
    pi = np.exp(policy - policy.max(-1, keepdims=True))
    pi /= pi.sum(-1, keepdims=True)
    head = oracle.categorical_gradient_norm(advantage, action[:, 0], pi, hidden)
    return expected_gradient_norm(s, head)


class Case:
    """A rule with its own numbers, what it has to give, and other numbers, which give another."""

    def __init__(
        self,
        rule: Callable[..., Sampler],
        expected: Callable[[Samples], Found],
        *other: dict[str, Any],
        setup: Any = SETUP,
        **numbers: Any,
    ) -> None:
        self.rule, self.expected, self.other = rule, expected, other
        self.setup, self.numbers = setup, numbers

    def agrees(self, seed: int, **numbers: Any) -> bool:
        samples = random_samples(seed, setup=self.setup)
        choice = chosen(self.rule(self.setup, **{**self.numbers, **numbers}), samples)
        return all(
            np.allclose(getattr(choice, name), wanted, rtol=2e-5, atol=1e-7)
            for name, wanted in self.expected(samples).items()
        )


CASES = {
    "top-advantage": Case(top_advantage, expected_top, {"share": 0.6}, {"leak": 0.5}),
    "kondo": Case(kondo, expected_kondo, {"share": 0.35}, {"centred": False}),
    "pods": Case(pods, expected_pods, {"share": 0.4}, {"length": 5}, length=6),
    "vex": Case(vex_oracle, expected_informative, {"threshold": 0.5}, {"share": 0.8}),
    "vex-high": Case(vex_oracle, expected_vex, {"share": 0.4}, {"keep": "low"}, share=0.5),
    "vex-low": Case(vex_oracle, lambda s: expected_vex(s, "low"), {"keep": "both"}, keep="low"),
    "vex-both": Case(vex_oracle, lambda s: expected_vex(s, "both"), {"keep": "high"}, keep="both"),
    "prioritized": Case(prioritized, expected_prioritized, {"power": 0.7}, {"correction": 0.3}),
    "gradient-norm": Case(gradient_norm, expected_gaussian, {"uniform": 0.2}),
    "gradient-norm-discrete": Case(
        gradient_norm, expected_categorical, {"uniform": 0.2}, setup=DISCRETE
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_rule_takes_what_numpy_says_and_its_numbers_matter(name: str) -> None:
    case = CASES[name]
    assert all(case.agrees(seed) for seed in SEEDS)
    for other in case.other:
        assert not all(case.agrees(seed, **other) for seed in SEEDS), other


def test_gigaflow_follows_the_largest_advantage_over_rollouts() -> None:
    """Its last rollout is so small that M outlives it: nothing is kept."""

    def agrees(sampler: Sampler) -> bool:
        state, maximum, same = sampler.init(), None, True
        for seed, scale in enumerate((1.0, 0.1, 3.0, 1e-4)):
            s = random_samples(seed)
            s = s._replace(advantage=s.advantage * scale)
            keep, maximum = oracle.gigaflow_keep(of_present(s, "advantage")[0], maximum)
            state, choice = sampler.choose(state, s, jax.random.key(0))
            same &= np.array_equal(choice.keep, spread(s, keep))
            same &= np.allclose(state, maximum, rtol=1e-6)
        assert not keep.any()
        return same

    assert agrees(gigaflow(SETUP))
    assert not agrees(gigaflow(SETUP, rate=0.3))
    assert not agrees(gigaflow(SETUP, threshold=0.02))


def test_positive_keeps_what_went_better_than_expected() -> None:
    for seed in SEEDS:
        s = random_samples(seed)
        keep = chosen(positive(SETUP), s).keep
        np.testing.assert_array_equal(keep, expected_positive(s)["keep"])
        lower = s._replace(advantage=s.advantage - 0.1)
        assert not np.array_equal(keep, expected_positive(lower)["keep"])


def test_advantages_cut_at_zero_are_scaled_and_not_centred() -> None:
    s = random_samples(0)
    weight = jnp.asarray(s.present, jnp.float32)
    cut = np.asarray(cut_at_zero(s.advantage, weight))
    advantage = of_present(s, "advantage")[0]
    expected = oracle.positive_advantage(advantage)
    np.testing.assert_allclose(cut[np.asarray(s.present)], expected, rtol=1e-5)
    centred = oracle.positive_advantage(advantage - advantage.mean())
    assert not np.allclose(cut[np.asarray(s.present)], centred, rtol=1e-2)


def test_the_correction_rises_to_one_over_the_budget() -> None:
    s, sampler = random_samples(1), prioritized(SETUP)
    for count, correction in ((0, 0.2), (2, 0.6), (4, 1.0), (9, 1.0)):
        state, choice = sampler.choose(jnp.int32(count), s, jax.random.key(0))
        expected = expected_prioritized(s, correction)["weight"]
        np.testing.assert_allclose(choice.weight, expected, rtol=1e-5)
        assert state == count + 1
    assert not np.allclose(choice.weight, expected_prioritized(s, 0.9)["weight"], rtol=1e-3)


@pytest.mark.parametrize("tail", [1, 3])
def test_prioritized_leaves_the_policy_loss_its_size(tail: int) -> None:
    """The mean weight of a drawn term is 1, PPO's, at every time and however many rows there are.

    Divided by the largest weight, which is that of the row of |A| nearest 0, it is below 0.01 at
    the end of a budget.
    """
    rows = 8192
    setup = SETUP._replace(rollout_steps=rows, envs=1)
    s = random_samples(4, rows=rows, absent=0.1)
    s = s._replace(advantage=jnp.cbrt(s.advantage) ** tail)
    for count in range(SETUP.iterations):
        choice = chosen(prioritized(setup), s, jnp.int32(count))
        mean = np.sum(choice.probability.astype(float) * choice.weight)
        assert mean == pytest.approx(1.0, rel=1e-4)
    assert mean / choice.weight.max() < 0.01


def test_where_scores_tie_the_lower_rows_are_kept() -> None:
    s = random_samples(0, absent=0.0)
    s = s._replace(advantage=jnp.asarray(np.arange(ROWS) % 3, jnp.float32))
    keep = chosen(top_advantage(SETUP, share=0.5), s).keep
    np.testing.assert_array_equal(keep, oracle.top_advantage_keep(s.advantage, 0.5))


@pytest.mark.parametrize("threshold", [None, 0.8])
def test_the_oracle_is_saunas_filter_that_predicts_its_target(threshold: Any) -> None:
    """Arm `sauna`'s own filter keeps the same steps if its head gives the head's target itself."""
    given = {} if threshold is None else {"threshold": threshold}
    limit = configured(arm="sauna", **given).threshold
    for seed in SEEDS:
        s = random_samples(seed, absent=0.0)
        s = s._replace(advantage=3.0 * s.advantage)  # some shares are below -5
        value, advantage = (x.reshape(STEPS, ENVS) for x in (s.value, s.advantage))
        ones = jnp.ones((STEPS, ENVS))
        target = TARGETS["sample"].target(value + advantage, value, ones, 0 * ones)
        rule = sauna_per_env("all", STEPS)
        state, keep = rule.init(ENVS, STEPS), []
        h = hypers(threshold=limit)
        for vex in target:
            state, kept = rule.keep(state, unscored(s.observation[:ENVS], vex), no_key(), h)
            keep.append(kept)
        got = chosen(vex_oracle(SETUP, **given), s).keep
        np.testing.assert_array_equal(got, np.stack(keep).ravel())
        assert not got.all()
        assert not np.array_equal(got, chosen(vex_oracle(SETUP, threshold=limit + 0.2), s).keep)


def test_ranks_of_the_oracle_are_ranks_by_the_advantage() -> None:
    """So that `high` and `low` are no tests of SAUNA's idea, and its own test is another set."""
    s = random_samples(0)
    top = top_advantage(SETUP)
    low = chosen(controlled("low-advantage", top), s).keep
    np.testing.assert_array_equal(chosen(vex_oracle(SETUP, keep="high"), s).keep, low)
    np.testing.assert_array_equal(
        chosen(vex_oracle(SETUP, keep="low"), s).keep, chosen(top, s).keep
    )
    own = chosen(vex_oracle(SETUP), s).keep
    assert (own & ~low).any() and (own & low).any() and own.sum() > low.sum()


@pytest.mark.parametrize("numbers", [{}, {"share": 0.3333}])
def test_the_oracle_does_not_prefer_replayed_rows_of_another_policy(numbers: Any) -> None:
    """A truncated ratio of 0.01 leaves `R - V` next to nothing: scored by that, old rows would be
    kept first."""
    setup, count = SETUP._replace(rollout_steps=400, replay_rollouts=1), 2400
    s = random_samples(6, rows=count, absent=0.0)
    rho = jnp.where(jnp.arange(count) < 1200, 1.0, 0.01)
    s = s._replace(error=rho * s.advantage, return_=s.value + rho * s.advantage)
    new, old = chosen(vex_oracle(setup, **numbers), s).keep.reshape(2, -1).mean(1)
    assert abs(new - old) < 0.08
    by_error = oracle.vex_share(np.asarray(s.error), np.asarray(s.return_))
    new, old = oracle.vex_keep(by_error, 0.3333, "high").reshape(2, -1).mean(1)
    assert old - new > 0.3


def test_each_replayed_rollout_has_its_own_history() -> None:
    setup = SETUP._replace(replay_rollouts=1)
    s = random_samples(7, rows=2 * ROWS)
    both = chosen(vex_oracle(setup), s).keep.reshape(2, -1)
    for i, keep in enumerate(both):
        one = jax.tree.map(lambda x, i=i: x[i * ROWS : (i + 1) * ROWS], s)
        np.testing.assert_array_equal(keep, chosen(vex_oracle(SETUP), one).keep)


def test_a_share_of_the_others_leaks() -> None:
    rows = 4000
    setup = SETUP._replace(rollout_steps=rows, envs=1)
    s = random_samples(3, rows=rows)
    top = chosen(top_advantage(setup, share=0.25), s).keep
    others = np.asarray(s.present) & ~top
    leaked = chosen(top_advantage(setup, share=0.25, leak=0.3), s).keep
    assert leaked[top].all() and not leaked[~np.asarray(s.present)].any()
    number = others.sum()
    assert abs(leaked[others].sum() - 0.3 * number) < 5 * np.sqrt(number * 0.3 * 0.7)
    everything = chosen(top_advantage(setup, share=0.25, leak=1.0), s).keep
    np.testing.assert_array_equal(everything, s.present)


def test_segments_are_no_longer_than_the_rollout() -> None:
    """So that half of a short rollout's rows is a share of a half, not of all rows.

    CartPole's preset has 8 envs of 32 steps. An epoch draws `share M` rows: with a share of 1 it
    goes through the kept half twice.
    """
    setup = SETUP._replace(rollout_steps=32, envs=8)
    short = pods(setup)
    assert short.share == 0.5
    s = random_samples(0, rows=256, absent=0.0)
    keep = chosen(short, s).keep
    assert keep.sum() == 128 and (keep.reshape(32, 8).sum(0) % 32 == 0).all()
    np.testing.assert_array_equal(keep, chosen(pods(setup, length=32), s).keep)
    assert pods(setup._replace(rollout_steps=128)).share == 0.5
    assert pods(setup._replace(rollout_steps=65, envs=1)).share == 64 / 65


@pytest.mark.parametrize("seed", SEEDS)
def test_no_other_set_of_segments_varies_more(seed: int) -> None:
    score = np.random.default_rng(seed).normal(size=8).astype(np.float32)
    kept = np.asarray(widest(jnp.asarray(score), 4))
    assert kept.sum() == 4
    np.testing.assert_allclose(score[kept].var(), oracle.largest_variance(score, 4), rtol=1e-5)
    assert score[:4].var() < score[kept].var()


@pytest.mark.parametrize(
    "kind, sizes, distribution",
    [
        ("continuous", (2,), gaussian(2)),
        ("squashed", (2,), squashed(2)),
        pytest.param("beta", (2,), beta(2), marks=pytest.mark.slow),
        ("discrete", (3,), multi_categorical((3,))),
        ("multi_discrete", (3, 2), multi_categorical((3, 2))),
        ("multi_binary", (3,), bernoulli(3)),
    ],
)
def test_the_bound_is_the_gradients_norm_at_the_head(kind, sizes, distribution) -> None:
    """By automatic differentiation of one row's log-probability over W, b and the log-std."""
    rng = np.random.default_rng(2)
    rows, width, hidden = 6, distribution.num_outputs, 4
    name = kind if kind in ("squashed", "beta") else "gaussian"
    kind = "continuous" if distribution.continuous else kind
    w, b, log_std = (rng.normal(size=s) for s in ((hidden, width), width, width))
    h = rng.normal(size=(rows, hidden))

    def parameters(w: Any, b: Any, log_std: Any, h: Any) -> Any:
        head = h @ w + b
        return jnp.concatenate([head, log_std]) if distribution.has_log_std else head

    policy = jnp.stack([parameters(w, b, log_std, x) for x in h])
    noise = distribution.draw(jax.random.key(0), (rows,))
    action = distribution.sample(policy, noise)
    got = head_gradient(
        SETUP._replace(action_kind=kind, action_sizes=sizes, distribution=name),
        policy,
        action,
        jnp.asarray(h),
    )

    def log_prob(w: Any, b: Any, log_std: Any, h: Any, action: Any) -> Any:
        return distribution.log_prob(parameters(w, b, log_std, h), action)

    of_row = jax.grad(log_prob, argnums=(0, 1, 2))
    of_rows = jax.jit(jax.vmap(of_row, in_axes=(None, None, None, 0, 0)))
    gradient = of_rows(*map(jnp.asarray, (w, b, log_std, h, action)))
    squares = (np.sum(np.asarray(x).reshape(rows, -1) ** 2, -1) for x in gradient)
    np.testing.assert_allclose(got, np.sqrt(sum(squares)), rtol=1e-4)


@pytest.mark.parametrize("rule", [gradient_norm, prioritized])
def test_weights_of_a_draw_undo_its_probabilities(rule: Callable[..., Sampler]) -> None:
    """Summed over every row that can be drawn, the weighted mean is the mean of all rows.

    With prioritized that is so at the end of the budget.
    """
    s, state = random_samples(5), None
    term = np.random.default_rng(0).normal(size=ROWS)
    on = np.asarray(s.present)
    if rule is prioritized:
        state = jnp.int32(SETUP.iterations - 1)
    choice = chosen(rule(SETUP), s, state)
    np.testing.assert_allclose(np.sum(choice.probability), 1.0, rtol=1e-5)
    mean = np.sum(choice.probability * choice.weight * term)
    np.testing.assert_allclose(mean, term[on].mean(), rtol=1e-4)
    unweighted = np.sum(choice.probability * term)
    assert abs(unweighted - term[on].mean()) > 0.01
    if rule is gradient_norm:
        value = np.sum(choice.value_probability * choice.value_weight * term)
        np.testing.assert_allclose(value, term[on].mean(), rtol=1e-4)


def test_rows_without_a_gradient_are_drawn_evenly() -> None:
    s = random_samples(1)
    s = s._replace(standardized=jnp.zeros(ROWS), error=jnp.zeros(ROWS))
    choice = chosen(gradient_norm(SETUP), s)
    even = np.asarray(s.present) / np.asarray(s.present).sum()
    np.testing.assert_allclose(choice.probability, even, rtol=1e-6)
    np.testing.assert_allclose(choice.value_probability, even, rtol=1e-6)


def test_counts_round_up_and_not_for_a_last_bit() -> None:
    assert [count_of(share, 60) for share in (0.1, 0.101, 1e-9, 1.0)] == [6, 7, 1, 60]
    assert all(count_of(k / 100, 100) == k for k in range(1, 101))


@pytest.mark.parametrize(
    "rule, numbers, text",
    [
        (gigaflow, {"threshold": -1.0}, "threshold must be a number at least 0"),
        (gigaflow, {"rate": "a"}, "rate must be a number between 0 and 1"),
        (top_advantage, {"share": 0}, "share must be above 0"),
        (top_advantage, {"share": 1.5}, "share must be a number between 0 and 1"),
        (top_advantage, {"leak": True}, "leak must be a number"),
        (prioritized, {"correction": 2}, "correction must be a number between 0 and 1"),
        (gradient_norm, {"uniform": -0.1}, "uniform must be a number"),
        (kondo, {"share": float("nan")}, "share must be a number"),
        (pods, {"length": 0}, "length must be a number at least 1"),
        (pods, {"length": 1.5}, "length must be a whole number"),
        (
            vex_oracle,
            {"keep": "top"},
            "keep must be one of informative, high, low, both, not 'top'",
        ),
        (vex_oracle, {"keep": "informative", "share": 0.5}, "share is read with keep high, low or"),
        (vex_oracle, {"keep": "low", "threshold": 0.5}, "threshold is read with keep informative"),
        (vex_oracle, {"threshold": -1}, "threshold must be a number at least 0"),
        (kondo, {"on": "std"}, "on must be one of mean, all, not 'std'"),
    ],
)
def test_numbers_that_make_no_rule_are_refused(rule, numbers, text) -> None:
    with pytest.raises(ValueError, match=text):
        rule(SETUP, **numbers)
