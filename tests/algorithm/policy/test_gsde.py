"""State-dependent exploration: its density, its gradient, its first log-std, and its noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from helpers import configured
from sauna.algorithm.policy.gsde import SMALLEST, deviation, explore, gsde, state_log_std
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.algorithm.rollout.program import draw_noise
from sauna.envs.spaces import Spaces
from sauna.training.loop.member_state import named_params

SPACES = Spaces("vector", (3,), "continuous", (2,), "", "")
SEEN = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)


def made(**settings) -> tuple[Policy, jax.Array]:
    """A policy with parameters that are drawn at random."""
    config = configured(
        distribution="gsde", hidden="5,4", rollout_steps=8, minibatches=1, **settings
    )
    policy = make_policy(config, SPACES)
    size = jax.eval_shape(policy.init, jax.random.key(1)).size
    return policy, 0.4 * jax.random.normal(jax.random.key(2), (size,))


def test_the_log_probability_is_that_of_the_noise() -> None:
    """Actions of many matrices have the density of scipy's normal with variance `h^2 @ S^2`."""
    policy, params = made()
    output = jax.jit(policy.apply)(params, SEEN)
    std = np.exp(np.asarray(policy.unravel(params)["params"]["log_std"]))
    assert std.shape == (4, 2)
    mean, hidden = np.asarray(output.policy)[:, :2], np.asarray(output.hidden)
    scale = np.sqrt(hidden**2 @ std**2 + SMALLEST)
    noise = policy.distribution.draw(jax.random.key(4), (4000, 1))
    many = jax.tree.map(
        lambda x: None if x is None else jnp.broadcast_to(x, (4000, *x.shape)), output
    )
    noise = jnp.broadcast_to(noise, (4000, 6, 8))
    actions = np.asarray(jax.jit(policy.sample)(params, many, noise))
    for row, i in ((0, 0), (5, 1)):
        normal = stats.norm(mean[row, i], scale[row, i])
        assert stats.kstest(actions[:, row, i], normal.cdf).pvalue > 0.01
        wider = stats.norm(mean[row, i], 1.2 * scale[row, i])
        assert stats.kstest(actions[:, row, i], wider.cdf).pvalue < 1e-4
    got = policy.distribution.log_prob(output.policy, actions[7])
    expected = stats.norm(mean, scale).logpdf(actions[7]).sum(-1)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)
    entropy = stats.norm(mean, scale).entropy().sum(-1)
    np.testing.assert_allclose(policy.distribution.entropy(output.policy), entropy, rtol=1e-4)
    np.testing.assert_allclose(policy.distribution.mode(output.policy), mean)


def test_one_matrix_gives_one_state_one_action() -> None:
    """By hand: the mean plus the features times the matrix, the same whenever a state comes."""
    hidden, std = np.array([[1.0, 2.0], [0.5, -1.0]]), np.array([[0.1, 1.0, 2.0], [0.2, 3.0, 0.0]])
    noise, mean = np.arange(6.0) - 2, np.array([[1.0, 0.0, -1.0]])
    got = explore(jnp.asarray(mean), jnp.asarray(hidden), jnp.asarray(std), jnp.asarray(noise))
    matrix = std * np.array([[-2.0, -1.0, 0.0], [1.0, 2.0, 3.0]])
    np.testing.assert_allclose(got, mean + hidden @ matrix, rtol=1e-6)
    assert gsde(3, 2).draw(jax.random.key(0), (5, 4)).shape == (5, 4, 6)


@pytest.mark.parametrize("learn", [False, True])
def test_the_gradient_goes_into_the_features_only_if_asked(learn: bool) -> None:
    """The log-probability at the mean: its gradient reaches the trunk by the log-std alone."""
    policy, params = made(sde_learn_features=learn)

    @jax.jit
    def log_prob(params):
        output = policy.apply(params, SEEN)
        action = jax.lax.stop_gradient(output.policy[:, :2])
        return policy.distribution.log_prob(output.policy, action).sum()

    gradient = np.asarray(jax.grad(log_prob)(params))
    named = named_params(policy, gradient)
    assert np.abs(named["log_std"]).max() > 0.01
    reached = np.abs(named["policy_trunk/layer_0/kernel"]).max()
    assert reached > 0.01 if learn else reached == 0.0
    place = list(named).index("log_std")
    start = sum(x.size for x in list(named.values())[:place])
    for index in (start, start + 5):
        step = np.zeros(len(gradient), np.float32)
        step[index] = 1e-2
        expected = (log_prob(params + step) - log_prob(params - step)) / 2e-2
        assert gradient[index] == pytest.approx(float(expected), rel=1e-2, abs=1e-3)


@pytest.mark.parametrize("hidden", [4, pytest.param(64, marks=pytest.mark.slow)])
def test_the_first_log_std_does_not_depend_on_the_width(hidden: int) -> None:
    """With features of size 1 it is `log_std_init`."""
    config = configured(distribution="gsde", hidden=str(hidden), log_std_init=-0.5)
    policy = make_policy(config, SPACES)
    log_std = policy.unravel(policy.init(jax.random.key(0)))["params"]["log_std"]
    assert log_std.shape == (hidden, 2)
    of_ones = state_log_std(jnp.ones((1, hidden)), jnp.exp(log_std))
    np.testing.assert_allclose(of_ones, -0.5, atol=1e-4)


def test_expln_is_exp_below_zero_and_slow_above() -> None:
    x = jnp.asarray([-3.0, 0.0, 1e-4, 2.0, 50.0])
    np.testing.assert_allclose(deviation(x, True)[:2], np.exp(x[:2]), rtol=1e-6)
    np.testing.assert_allclose(deviation(x, True)[2:], 1 + np.log1p(x[2:]), rtol=1e-6)
    np.testing.assert_allclose(deviation(x, False), np.exp(x), rtol=1e-6)
    slopes = jax.vmap(jax.grad(lambda x: deviation(x, True)))(jnp.asarray([-1e-4, 1e-4, 50.0]))
    np.testing.assert_allclose(slopes, [1.0, 1.0, 1 / 51], rtol=1e-3)


@pytest.mark.parametrize("freq, rows", [(0, 1), (3, 3), (8, 1), (1, 8), (100, 1)])
def test_a_matrix_is_drawn_for_so_many_steps(freq: int, rows: int) -> None:
    config = configured(
        distribution="gsde", hidden="4", rollout_steps=8, minibatches=1, sde_sample_freq=freq
    )
    policy = make_policy(config, SPACES)
    assert policy.hold == (freq or 8)
    shape = jax.eval_shape(
        lambda key: draw_noise(policy, config, key, jnp.int32(0), jnp.int32(0)), jax.random.key(0)
    ).shape
    assert shape == (rows, 1, 8)
