"""Loss weights, objectives, stop rules, critics and auxiliary losses against float64 numpy."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithm.selection import oracle, oracle_loss
from sauna.algorithm.learner.ppo import surrogate
from sauna.algorithm.selection.avec import avec
from sauna.algorithm.selection.delight import delight
from sauna.algorithm.selection.merl import next_observation, shuffled_observation
from sauna.algorithm.selection.objectives import spo, unclipped
from sauna.algorithm.selection.sample_dropout import sample_dropout
from sauna.algorithm.selection.stops import espo, target_kl
from sauna.algorithm.types import LossTerms

ROWS, SEEDS = 48, range(3)


def random_terms(seed: int, *, spread: float = 0.5, continuous: bool = True) -> LossTerms:
    rng = np.random.default_rng(seed)
    draw = lambda: rng.normal(size=ROWS).astype(np.float32)  # noqa: E731
    present = (rng.random(ROWS) < 0.8).astype(np.float32)
    return LossTerms(4 * draw() - 2, spread * draw(), draw(), draw(), present, continuous)


def weigh(rule: Any, terms: LossTerms) -> tuple[np.ndarray, np.ndarray]:
    mask, scale = rule.weight(terms._replace(**{k: jnp.asarray(getattr(terms, k)) for k in ARRAYS}))
    return np.asarray(mask), np.asarray(scale)


ARRAYS = ("log_prob", "log_ratio", "advantage", "entropy", "present")


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize("centred", [True, False])
def test_delight_favours_the_rare_and_good(continuous: bool, centred: bool) -> None:
    """By today's log-probability; a discrete policy's surprisal is not centred."""
    for seed in SEEDS:
        terms = random_terms(seed, continuous=continuous)
        entropy = terms.entropy if centred and continuous else None
        mask, scale = weigh(delight(temperature=0.7, centred=centred), terms)
        expected = oracle.delight_weight(terms.advantage, terms.log_prob, entropy, 0.7)
        np.testing.assert_allclose(scale, expected, rtol=1e-4, atol=1e-6)
        np.testing.assert_array_equal(mask, terms.present)
        other = oracle.delight_weight(terms.advantage, terms.log_prob, entropy, 0.6)
        assert not np.allclose(scale, other, rtol=1e-2)
    plain = weigh(delight(), random_terms(0, continuous=False))[1]
    default = oracle.delight_weight(random_terms(0).advantage, random_terms(0).log_prob)
    np.testing.assert_allclose(plain, default, rtol=1e-4, atol=1e-6)


def test_no_gradient_flows_through_delight() -> None:
    terms = random_terms(0)

    def total(advantage: jax.Array) -> jax.Array:
        return jnp.sum(delight().weight(terms._replace(advantage=advantage))[1])

    assert not np.any(jax.grad(total)(jnp.asarray(terms.advantage)))
    assert delight().on_mean and not delight(on="all").on_mean


def test_sample_dropout_leaves_out_far_ratios() -> None:
    for seed in SEEDS:
        terms = random_terms(seed)
        on = terms.present > 0
        mask, scale = weigh(sample_dropout(0.4), terms)
        zero = np.zeros(on.sum())
        expected = oracle.sample_dropout_keep(terms.log_ratio[on], zero, 0.4)
        np.testing.assert_array_equal(mask[on] > 0, expected)
        assert not mask[~on].any() and (scale == 1).all() and 0 < expected.mean() < 1
        assert not np.array_equal(mask, weigh(sample_dropout(0.5), terms)[0])


def test_sample_dropout_keeps_all_if_none_is_near() -> None:
    terms = random_terms(0)
    far = terms._replace(log_ratio=np.where(terms.present > 0, 2.0, 0.0).astype(np.float32))
    np.testing.assert_array_equal(weigh(sample_dropout(), far)[0], terms.present)
    one = far.log_ratio.copy()
    first = int(np.flatnonzero(terms.present)[0])
    one[first] = 0.1
    near = weigh(sample_dropout(), far._replace(log_ratio=one))[0]
    np.testing.assert_array_equal(np.flatnonzero(near), [first])


@pytest.mark.parametrize("scale", [0.05, 0.15, 0.2, 0.3, 0.5])
def test_a_stop_rule_measures_the_rows_that_count(scale: float) -> None:
    """Rows of weight 0 have ratios that would stop anything."""
    for seed in SEEDS:
        terms = random_terms(seed, spread=scale)
        on = terms.present > 0
        log_ratio = np.where(on, terms.log_ratio, 9.0).astype(np.float32)
        new, old = terms.log_ratio[on], np.zeros(on.sum())
        kl, deviation = oracle_loss.approximate_kl(new, old), oracle_loss.ratio_deviation(new, old)
        for limit in (0.01, 0.02, 0.03):
            got = target_kl(limit).exceeded(log_ratio, terms.present)
            assert bool(got) == (oracle_loss.target_kl_stop([kl], limit) == 0)
        for limit in (0.1, 0.25):
            got = espo(limit).exceeded(log_ratio, terms.present)
            assert bool(got) == (oracle_loss.espo_stop([deviation], limit, "before") == 0)


def test_a_stop_rules_own_numbers_are_the_published_ones() -> None:
    """At the limit itself ESPO stops and target KL does not."""
    one = jnp.ones(1)

    def log_ratio_of(kl: float) -> jax.Array:
        x = np.linspace(0.0, 1.0, 2_000_001)
        return jnp.asarray([x[np.argmin(np.abs(np.exp(x) - 1 - x - kl))]], jnp.float32)

    assert not target_kl().exceeded(log_ratio_of(0.0299), one)
    assert target_kl().exceeded(log_ratio_of(0.0301), one)
    for ratio, stops in ((1.2499, False), (1.2501, True), (0.7501, False), (0.7499, True)):
        assert bool(espo().exceeded(jnp.log(jnp.array([ratio])), one)) is stops
    assert espo(0.0).exceeded(jnp.zeros(1), one) and not target_kl(0.0).exceeded(jnp.zeros(1), one)


@pytest.mark.parametrize(
    "form, objective",
    [
        (spo, oracle_loss.spo_objective),
        (unclipped, oracle_loss.unclipped_objective),
        (surrogate, oracle_loss.ppo_clip_objective),
    ],
)
def test_an_objective_is_the_negative_of_numpys(form: Any, objective: Any) -> None:
    for seed in SEEDS:
        terms = random_terms(seed)
        got = np.asarray(form(terms.log_ratio, terms.advantage, 0.2))
        ratio = np.exp(terms.log_ratio.astype(float))
        np.testing.assert_allclose(got, -objective(ratio, terms.advantage, 0.2), rtol=1e-4)
        if form is not unclipped:
            other = -objective(ratio, terms.advantage, 0.25)
            assert not np.allclose(got, other, rtol=1e-2)


def test_at_ratio_one_every_objective_has_ppos_gradient() -> None:
    """And away from it none has: SPO turns round at 1 + eps, where the clip's gradient ends."""
    advantage = jnp.asarray(random_terms(0).advantage)

    def gradient(form: Any, log_ratio: float) -> np.ndarray:
        given = jnp.full(ROWS, log_ratio)
        return np.asarray(jax.grad(lambda x: jnp.sum(form(x, advantage, 0.2)))(given))

    at_one = gradient(surrogate, 0.0)
    np.testing.assert_allclose(at_one, -advantage, rtol=1e-6)
    for form in (spo, unclipped):
        np.testing.assert_allclose(gradient(form, 0.0), at_one, rtol=1e-6)
        assert not np.allclose(gradient(form, 0.3), gradient(surrogate, 0.3), rtol=1e-2)
    up = np.asarray(advantage) > 0
    assert np.allclose(gradient(spo, np.log(1.2))[up], 0.0, atol=1e-6)
    assert (gradient(spo, np.log(1.3))[up] > 0).all() and (gradient(spo, 0.1)[up] < 0).all()


def test_avec_is_half_the_variance_of_the_errors() -> None:
    for seed in SEEDS:
        terms = random_terms(seed)
        error = terms.advantage + 3.0
        got = float(avec(jnp.asarray(error), jnp.asarray(terms.present)))
        expected = 0.5 * oracle_loss.avec_loss(error, terms.present)
        np.testing.assert_allclose(got, expected, rtol=1e-4)
        moved = float(avec(jnp.asarray(error) - 3.0, jnp.asarray(terms.present)))
        np.testing.assert_allclose(got, moved, rtol=1e-3)
        assert abs(got - 0.5 * oracle.weighted_mean(error**2, terms.present)) > 1.0


def test_the_heads_of_merl_and_of_its_released_code() -> None:
    rng = np.random.default_rng(0)
    prediction, observation, following = rng.normal(size=(3, ROWS, 3)).astype(np.float32)
    weight = random_terms(0).present
    weight[0], following[1] = 0.0, 0.0
    got = next_observation(*map(jnp.asarray, (prediction, observation, following, weight)))
    expected = oracle_loss.merl_next_loss(prediction, following, weight)
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    released = shuffled_observation(*map(jnp.asarray, (prediction, observation, following, weight)))
    quirk = oracle_loss.merl_released_loss(prediction, observation)
    np.testing.assert_allclose(released, quirk, rtol=1e-5)
    assert abs(float(got) - float(released)) > 1e-3
    zeros = jnp.zeros((ROWS, 3))
    gradient = jax.grad(lambda p: next_observation(p, zeros, zeros, jnp.ones(ROWS)))(zeros)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize(
    "rule, numbers, text",
    [
        (delight, {"temperature": 0}, "temperature must be a number at least 1e-06"),
        (delight, {"on": "std"}, "on must be one of mean, all, not 'std'"),
        (sample_dropout, {"deviation": -1}, "deviation must be a number at least 0"),
        (target_kl, {"limit": "0.1"}, "limit must be a number"),
        (espo, {"limit": -0.1}, "limit must be a number at least 0"),
    ],
)
def test_numbers_that_make_no_rule_are_refused(rule: Any, numbers: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        rule(**numbers)
