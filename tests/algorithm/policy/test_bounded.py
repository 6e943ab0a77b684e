"""A Gaussian under a tanh and the Beta distribution: scipy and quadrature are the oracles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import betaln, expit

from sauna.algorithm.policy.bounded import (
    INSIDE,
    TRIES,
    beta,
    from_env,
    log_slope,
    squashed,
    to_env,
)
from sauna.algorithm.policy.distributions import Distribution, gaussian

LOG_2 = np.log(2.0)
MEANS = np.array([-2.5, -0.3, 0.0, 1.7])
STDS = np.array([0.05, 0.6, 1.0, 2.7])


def of_normal() -> np.ndarray:
    """Parameters `[4, 2]` of one component: mean and log-std."""
    return np.stack([MEANS, np.log(STDS)], -1).astype(np.float32)


def of_beta() -> tuple[np.ndarray, np.ndarray]:
    """Parameters `[5, 2]` of one component, and the alpha and beta that they stand for."""
    outputs = np.array([[0.0, 0.0], [-6.0, 3.0], [2.0, -1.0], [30.0, 20.0], [-40.0, -40.0]])
    return outputs.astype(np.float32), 1.0 + np.logaddexp(0.0, outputs)


def log_squashed(a: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Of the action, by the rule of change of variables."""
    return stats.norm(mean, std).logpdf(np.arctanh(a)) - np.log(1.0 - a**2)


def test_the_slope_of_tanh_is_right_and_finite_far_out() -> None:
    u = np.linspace(-5, 5, 21)
    np.testing.assert_allclose(log_slope(jnp.asarray(u)), np.log(1 - np.tanh(u) ** 2), atol=2e-6)
    far = np.asarray(jax.vmap(jax.grad(log_slope))(jnp.asarray([-1e4, -90.0, 90.0, 1e4])))
    np.testing.assert_allclose(far, [2.0, 2.0, -2.0, -2.0])
    np.testing.assert_allclose(log_slope(jnp.float32(1e4)), 2 * LOG_2 - 2e4, rtol=1e-6)


def test_log_probabilities_are_those_of_the_action() -> None:
    """At actions in the middle and near the bound, of two components with their product."""
    u = np.array([[-3.0, 0.2], [0.0, -0.4], [1.2, 2.9], [0.5, 0.0]], np.float32)
    action = np.tanh(u.astype(float))
    parameters = np.concatenate(
        [np.stack([MEANS, MEANS[::-1]], -1), np.log(np.stack([STDS, STDS[::-1]], -1))], -1
    ).astype(np.float32)
    each = [
        log_squashed(action[:, i], parameters[:, i], np.exp(parameters[:, 2 + i])) for i in (0, 1)
    ]
    got = squashed(2).log_prob(jnp.asarray(parameters), jnp.asarray(u))
    np.testing.assert_allclose(got, each[0] + each[1], rtol=2e-5, atol=2e-4)

    outputs, (a, b) = of_beta()[0][:4], of_beta()[1][:4].T
    both = jnp.asarray(
        np.stack([outputs[:, 0], outputs[::-1, 0], outputs[:, 1], outputs[::-1, 1]], 1)
    )
    logs = -np.logaddexp(0.0, -2.0 * u), -np.logaddexp(0.0, 2.0 * u)  # of x and of 1 - x
    expected = sum(
        (one - 1) * logs[0][:, i] + (other - 1) * logs[1][:, i] - betaln(one, other) - LOG_2
        for i, (one, other) in enumerate([(a, b), (a[::-1], b[::-1])])
    )
    inside = stats.beta(a, b).logpdf((1 + action[:, 0]) / 2)
    np.testing.assert_allclose(
        inside[:3] - LOG_2,
        ((a - 1) * logs[0][:, 0] + (b - 1) * logs[1][:, 0] - betaln(a, b) - LOG_2)[:3],
        rtol=1e-5,
    )
    got = beta(2).log_prob(both, jnp.asarray(u))
    np.testing.assert_allclose(got, expected, rtol=2e-5, atol=2e-4)


@pytest.mark.parametrize("made", [squashed, beta])
def test_an_action_at_the_bound_has_a_finite_probability_and_gradient(made) -> None:
    """No inverse of tanh is taken, where float32 knows no number below 1."""
    distribution, u = made(1), jnp.asarray([[50.0], [-50.0]])
    assert np.abs(np.asarray(to_env(distribution, np.asarray(u)))).tolist() == [[1.0], [1.0]]
    parameters = jnp.asarray([[0.1, 0.2], [0.3, -0.1]])
    value, gradient = jax.value_and_grad(lambda p: distribution.log_prob(p, u).sum())(parameters)
    assert np.isfinite(value) and np.isfinite(np.asarray(gradient)).all()


def test_entropies_are_the_integrals() -> None:
    found = np.asarray(squashed(1).entropy(jnp.asarray(of_normal())))
    for got, mean, std in zip(found, MEANS, STDS, strict=True):
        u = np.linspace(mean - 9 * std, mean + 9 * std, 20_001)
        log_p = stats.norm(mean, std).logpdf(u)
        slope = 2 * (LOG_2 - u - np.logaddexp(0, -2 * u))
        expected = np.trapezoid(np.exp(log_p) * (slope - log_p), u)
        assert got == pytest.approx(expected, abs=3e-3)
    outputs, shapes = of_beta()
    expected = stats.beta(*shapes.T).entropy() + LOG_2
    np.testing.assert_allclose(beta(1).entropy(jnp.asarray(outputs)), expected, atol=2e-4)


@pytest.mark.parametrize("made", [squashed, beta])
def test_gradients_are_the_finite_differences(made) -> None:
    """Of log-probability and entropy, in float64."""
    with jax.enable_x64(True):
        distribution = made(2)
        p = jnp.asarray([0.3, -1.2, -0.5, 0.4])
        u = jnp.asarray([0.2, -0.9])
        steps = 1e-5 * jnp.eye(4)

        @jax.jit
        def both(p):
            def pair(p):
                return jnp.stack([distribution.log_prob(p, u), distribution.entropy(p)])

            up, down = jax.vmap(pair)(p + steps), jax.vmap(pair)(p - steps)
            return jax.jacobian(pair)(p), (up - down).T / 2e-5

        gradient, expected = both(p)
        np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-7)


def sampled(distribution: Distribution, parameters: np.ndarray, number: int) -> np.ndarray:
    """`[number, A]` as the environment gets them."""
    noise = distribution.draw(jax.random.key(5), (number,))
    parameters = jnp.broadcast_to(jnp.asarray(parameters), (number, len(parameters)))
    return np.asarray(to_env(distribution, jax.jit(distribution.sample)(parameters, noise)))


def test_samples_have_their_distribution() -> None:
    """A Kolmogorov-Smirnov test at a fixed seed; the control has a parameter that is 10% off."""
    for outputs, (a, b) in zip(*(part[[0, 1, 3]] for part in of_beta()), strict=True):
        x = (1 + sampled(beta(1), outputs, 10_000)[:, 0]) / 2
        assert stats.kstest(x, stats.beta(a, b).cdf).pvalue > 0.01
        assert stats.kstest(x, stats.beta(1.1 * a, b).cdf).pvalue < 1e-4
    for parameters, mean, std in zip(of_normal()[1:3], MEANS[1:3], STDS[1:3], strict=True):
        u = np.arctanh(sampled(squashed(1), parameters, 4000)[:, 0].astype(float))
        inside = np.isfinite(u)
        assert inside.mean() > 0.99
        assert stats.kstest(u[inside], stats.norm(mean, std).cdf).pvalue > 0.01


def test_components_are_independent_and_have_their_own_parameters() -> None:
    x = sampled(beta(2), np.array([1.0, 4.0, 4.0, 1.0], np.float32), 4000)
    assert abs(np.corrcoef(x.T)[0, 1]) < 0.05
    assert x[:, 0].mean() < -0.2 and x[:, 1].mean() > 0.2


def test_hardly_a_variate_needs_more_proposals_than_are_drawn() -> None:
    """At shape 1, where most fail, it is 1 in 20 of the first."""
    from sauna.algorithm.policy import bounded

    number = 60_000
    z = np.random.default_rng(0).normal(size=number)
    e = np.random.default_rng(1).exponential(size=number)
    d = 2.0 / 3.0
    root = 1 + z / np.sqrt(9 * d)
    fits = (root > 0) & (-e < z**2 / 2 + d * (1 - root**3 + 3 * np.log(np.maximum(root, 1e-9))))
    share = 1 - fits.mean()
    assert share == pytest.approx(0.049, abs=0.004)
    assert share**TRIES < 2e-8
    proposals = jnp.asarray(np.stack([z, e]).reshape(2, -1, 1, 2), jnp.float32)
    got = bounded.log_gamma_variate(jnp.ones((number // 2, 1)), (proposals[0], proposals[1]))
    first = np.where(fits[::2], np.log(d) + 3 * np.log(np.maximum(root[::2], 1e-3)), np.nan)
    there = np.isfinite(first)
    np.testing.assert_allclose(np.asarray(got)[there, 0], first[there], rtol=1e-3, atol=1e-4)


def test_the_deterministic_action_is_the_median_and_the_mean() -> None:
    parameters = of_normal()
    got = to_env(squashed(1), squashed(1).mode(jnp.asarray(parameters)))[:, 0]
    np.testing.assert_allclose(got, np.tanh(MEANS), rtol=1e-5)
    outputs, shapes = of_beta()
    got = to_env(beta(1), beta(1).mode(jnp.asarray(outputs)))[:, 0]
    np.testing.assert_allclose(got, 2 * stats.beta(*shapes.T).mean() - 1, atol=1e-5)
    np.testing.assert_allclose(
        expit(2 * np.arctanh(np.asarray(got, float))), shapes[:, 0] / shapes.sum(1), atol=1e-4
    )


def test_what_is_not_bounded_goes_to_the_environment_as_it_is() -> None:
    action = np.array([[3.0]], np.float32)
    assert to_env(gaussian(1), action) is action


def test_an_action_of_the_environment_is_held_as_what_gives_it_again() -> None:
    action = np.array([[-0.9, 0.0], [0.3, 0.998], [-1.0, 1.0]], np.float32)
    held = from_env(beta(2), action)
    again = to_env(beta(2), held)
    np.testing.assert_allclose(again[:2], action[:2], rtol=1e-5)
    np.testing.assert_allclose(again[2], [-INSIDE, INSIDE], rtol=1e-5)
    assert np.abs(held - action).max() > 1
    np.testing.assert_array_equal(from_env(gaussian(2), action), action)
