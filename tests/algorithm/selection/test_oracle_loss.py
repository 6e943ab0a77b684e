"""The losses' oracles against hand arithmetic, numerical gradients and identities."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from algorithm.selection import oracle as o
from algorithm.selection import oracle_loss as loss

FEW = settings(max_examples=40, deadline=None)
SEEDS = st.integers(0, 10_000)


def numbers(size: int, low: float = -9, high: float = 9) -> st.SearchStrategy:
    return arrays.arrays(np.float64, size, elements=st.floats(low, high, width=32))


# ------------------------------------------------------------------ advantages


def test_gae_by_hand() -> None:
    advantage, returns = loss.gae(
        reward=[1, 2, 3], value=[10, 20, 30], next_value=[20, 30, 40],
        terminated=[0, 0, 0], ended=[0, 0, 0], gamma=0.5, gae_lambda=0.5,
    )  # fmt: skip
    # delta = 1 + 10 - 10, 2 + 15 - 20, 3 + 20 - 30 = 1, -3, -7; A = delta + A' / 4
    np.testing.assert_allclose(advantage, [1 - 4.75 / 4, -4.75, -7])
    np.testing.assert_allclose(returns, [10 + 1 - 4.75 / 4, 15.25, 23])


def test_a_time_limit_bootstraps_and_a_death_does_not() -> None:
    """With reward 1 for ever the value is 1 / (1 - gamma); without the bootstrap it must miss."""
    steps, gamma = 6, 0.9
    ended = np.array([0, 0, 1, 0, 0, 1])
    one, value = np.ones(steps), np.full(steps, 1 / (1 - gamma))
    _, returns = loss.gae(one, value, value, np.zeros(steps), ended, gamma, 1.0)
    np.testing.assert_allclose(returns, 10)
    _, returns = loss.gae(one, value, value, ended, ended, gamma, 1.0)
    np.testing.assert_allclose(returns, [2.71, 1.9, 1] * 2)
    reward = np.array([0.0, 0, 0, 1000, 0, 0])  # of the next episode: nothing of it flows back
    advantage, _ = loss.gae(reward, one, one, np.zeros(steps), ended, gamma, 1.0)
    np.testing.assert_allclose(advantage[:3], [-0.271, -0.19, -0.1])


@FEW
@given(numbers(5), numbers(6), st.floats(0, 1))
def test_gae_at_its_two_ends(reward, values, gamma) -> None:
    value, following, never = values[:-1], values[1:], np.zeros(5)
    advantage, _ = loss.gae(reward, value, following, never, never, gamma, 0.0)
    np.testing.assert_allclose(advantage, reward + gamma * following - value, atol=1e-9)
    _, returns = loss.gae(reward, value, following, never, never, gamma, 1.0)
    discounted = sum(gamma**t * r for t, r in enumerate(reward)) + gamma**5 * values[-1]
    assert math.isclose(returns[0], discounted, abs_tol=1e-9)


def test_environments_do_not_mix() -> None:
    random = np.random.default_rng(0)
    reward, value, following = random.normal(size=(3, 7, 2))
    ended = random.random((7, 2)) < 0.3
    both, _ = loss.gae(reward, value, following, ended, ended, 0.9, 0.8)
    columns = [x[:, 1] for x in (reward, value, following, ended, ended)]
    np.testing.assert_array_equal(both[:, 1], loss.gae(*columns, 0.9, 0.8)[0])


def test_recomputing_uses_the_value_of_now() -> None:
    observation, never = np.array([1.0, 2.0, 3.0]), np.zeros(3)
    moved, reward = observation + 1, np.ones(3)
    advantage, returns = loss.recompute(
        lambda x: 2 * x, observation, moved, reward, never, never, 1.0, 0.0
    )
    np.testing.assert_array_equal(advantage, [3, 3, 3])  # 1 + 2 (x + 1) - 2 x
    np.testing.assert_array_equal(returns, [5, 7, 9])


# ------------------------------------------------------------------ objectives of the policy


@pytest.mark.parametrize(
    ("ratio", "advantage", "clipped", "parabola"),
    [
        (1.0, 3.0, 3.0, 3.0),
        (1.5, 2.0, 2.4, 3.0 - 2 * 0.25 / 0.4),
        (1.5, -2.0, -3.0, -3.0 - 2 * 0.25 / 0.4),
        (0.5, 2.0, 1.0, 1.0 - 2 * 0.25 / 0.4),
        (0.5, -2.0, -1.6, -1.0 - 2 * 0.25 / 0.4),
    ],
)
def test_objectives_by_hand(ratio, advantage, clipped, parabola) -> None:
    assert math.isclose(loss.ppo_clip_objective(ratio, advantage), clipped)
    assert math.isclose(loss.spo_objective(ratio, advantage), parabola)
    assert loss.unclipped_objective(ratio, advantage) == ratio * advantage


@FEW
@given(st.floats(0.01, 3), st.floats(-5, 5).filter(lambda a: abs(a) > 1e-3), st.floats(0.05, 0.5))
def test_spo_peaks_at_the_edge_of_the_clip_range(ratio, advantage, clip) -> None:
    peak = loss.spo_objective(1 + math.copysign(clip, advantage), advantage, clip)
    assert loss.spo_objective(ratio, advantage, clip) <= peak + 1e-12
    assert math.isclose(peak, advantage + abs(advantage) * clip / 2)


@FEW
@given(st.floats(-5, 5))
def test_all_objectives_start_with_the_same_gradient(advantage) -> None:
    step, slopes = 1e-6, []
    for objective in (loss.ppo_clip_objective, loss.spo_objective, loss.unclipped_objective):
        up, down = objective(1 + step, advantage), objective(1 - step, advantage)
        slopes.append((up - down) / (2 * step))
    np.testing.assert_allclose(slopes, advantage, atol=1e-6)


# ------------------------------------------------------------------ losses


BATCH = {
    "log_prob": np.log([1.5, 0.5]),
    "log_prob0": np.zeros(2),
    "advantage": np.array([2.0, -1.0]),
    "value": np.array([1.0, 0.0]),
    "value0": np.array([0.0, 0.0]),
    "returns": np.array([2.0, 1.0]),
    "entropy": np.array([1.0, 3.0]),
}


def test_ppo_loss_by_hand() -> None:
    found = loss.ppo_loss(**BATCH, entropy_coefficient=0.1)
    # min(3, 2.4) and min(-0.5, -0.8); max(1, 1.8^2) / 2 and 1 / 2
    assert math.isclose(found["policy"], -(2.4 - 0.8) / 2)
    assert math.isclose(found["value"], (3.24 / 2 + 0.5) / 2)
    assert found["entropy"] == 2
    assert math.isclose(found["total"], -0.8 + 0.5 * 1.06 - 0.2)
    assert loss.ppo_loss(**BATCH, value_clip=None)["value"] == 0.5


def test_each_weight_touches_its_own_loss() -> None:
    plain = loss.ppo_loss(**BATCH)
    first = np.array([1.0, 0.0])
    only = loss.ppo_loss(**BATCH, weight=first)
    assert math.isclose(only["policy"], -2.4)
    assert (only["value"], only["entropy"]) == (plain["value"], plain["entropy"])
    assert math.isclose(loss.ppo_loss(**BATCH, value_weight=first)["value"], 1.62)
    assert loss.ppo_loss(**BATCH, entropy_weight=first)["entropy"] == 1


@FEW
@given(SEEDS, st.integers(2, 9))
def test_weight_zero_is_absence(seed, number) -> None:
    random = np.random.default_rng(seed)
    batch = {name: random.normal(size=number) for name in BATCH}
    keep = random.random(number) < 0.6
    keep[0] = True
    same = {f"{name}weight": keep.astype(float) for name in ("", "value_", "entropy_")}
    masked = loss.ppo_loss(**batch, **same)
    present = loss.ppo_loss(**{name: x[keep] for name, x in batch.items()})
    for name in present:
        assert math.isclose(masked[name], present[name], abs_tol=1e-12)


@FEW
@given(numbers(6), st.floats(-9, 9))
def test_avec_is_blind_to_a_constant(error, bias) -> None:
    assert math.isclose(loss.avec_loss(error), np.var(error), abs_tol=1e-9)
    assert math.isclose(loss.avec_loss(error + bias), loss.avec_loss(error), abs_tol=1e-6)


@FEW
@given(numbers(6), numbers(6), st.floats(-9, 9))
def test_avecs_bias_is_put_back(value, returns, bias) -> None:
    corrected = loss.avec_value(value, returns)
    assert math.isclose((returns - corrected).mean(), 0, abs_tol=1e-9)
    np.testing.assert_allclose(loss.avec_value(value + bias, returns), corrected, atol=1e-9)


def test_avec_by_hand() -> None:
    assert loss.avec_loss([1, 3]) == 1
    assert loss.avec_loss([1, 3, 100], [1, 1, 0]) == 1
    np.testing.assert_array_equal(loss.avec_value([0, 0], [1, 3]), [2, 2])


def test_cosine_distance_by_hand() -> None:
    a, b = (
        np.array([[1.0, 0], [1, 0], [1, 0], [0, 0]]),
        np.array([[5.0, 0], [0, 2], [-3, 0], [1, 0]]),
    )
    np.testing.assert_array_equal(loss.cosine_distance(a, b), [0, 1, 2, 1])
    assert loss.merl_next_loss(a, b) == 1
    assert loss.merl_next_loss(a, b, [1, 1, 0, 0]) == 0.5


def test_the_released_merl_fits_the_next_row_of_a_shuffled_minibatch() -> None:
    random = np.random.default_rng(1)
    stream = random.normal(size=(9, 3))
    observation, following = stream[:-1], stream[1:]
    perfect = following.copy()  # a head that knows the future
    assert math.isclose(loss.merl_next_loss(perfect, following), 0, abs_tol=1e-12)
    assert math.isclose(loss.merl_released_loss(perfect, observation), 0, abs_tol=1e-12)  # in order
    order = np.array([3, 0, 6, 1, 7, 4, 2, 5])
    assert math.isclose(loss.merl_next_loss(perfect[order], following[order]), 0, abs_tol=1e-12)
    assert loss.merl_released_loss(perfect[order], observation[order]) > 0.3  # punished for it
    pairs = [loss.cosine_distance(perfect[i], observation[j]) for i, j in itertools.pairwise(order)]
    assert math.isclose(loss.merl_released_loss(perfect[order], observation[order]), np.mean(pairs))


# ------------------------------------------------------------------ when to stop


def test_deviation_and_kl_by_hand() -> None:
    log_prob = np.log([2.0, 0.5])
    assert loss.ratio_deviation(log_prob, np.zeros(2)) == 0.75
    assert math.isclose(loss.approximate_kl(log_prob, np.zeros(2)), 0.25)  # mean(1, -0.5)
    assert loss.approximate_kl(log_prob, log_prob) == 0


@FEW
@given(numbers(6, -3, 3), numbers(6, -3, 3))
def test_the_kl_estimate_is_never_negative(log_prob, log_prob0) -> None:
    assert loss.approximate_kl(log_prob, log_prob0) >= -1e-12


def test_stops_by_hand() -> None:
    assert loss.espo_stop([0.1, 0.25, 0.9]) == 2  # at the limit, and its own step was taken
    assert loss.espo_stop([0.1, 0.25, 0.9], measured="before") == 1
    assert loss.espo_stop([0.1, 0.24]) == 2
    assert loss.target_kl_stop([0.0, 0.03, 0.031, 0.0], target=0.02) == 2  # 0.03 itself goes on
    assert loss.target_kl_stop([0.0, 0.03, 0.031, 0.0], target=0.02, measured="after") == 3
    assert loss.target_kl_stop([0.9], target=0.02) == 0


# ------------------------------------------------------------------ gradients at the policy head


def numerical_gradient(function, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    gradient = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        up, down = x.copy(), x.copy()
        up[i] += step
        down[i] -= step
        gradient[i] = (function(up) - function(down)) / (2 * step)
    return gradient


def norm(*parts: np.ndarray) -> float:
    return math.sqrt(sum(float((part**2).sum()) for part in parts))


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_the_gaussian_norm_is_the_gradients(seed) -> None:
    random = np.random.default_rng(seed)
    h, action, advantage = random.normal(size=4), random.normal(size=2), random.normal()
    weights, bias, log_std = (
        random.normal(size=(2, 4)),
        random.normal(size=2),
        random.normal(size=2),
    )

    def log_prob(weights, bias, log_std) -> float:
        z = (action - weights @ h - bias) / np.exp(log_std)
        return float((-(z**2) / 2 - log_std - math.log(2 * math.pi) / 2).sum())

    before = log_prob(weights, bias, log_std)
    surrogate = lambda *head: advantage * math.exp(log_prob(*head) - before)  # noqa: E731
    numerical = (
        numerical_gradient(lambda x: surrogate(x, bias, log_std), weights),
        numerical_gradient(lambda x: surrogate(weights, x, log_std), bias),
        numerical_gradient(lambda x: surrogate(weights, bias, x), log_std),
    )
    mean, std = weights @ h + bias, np.exp(log_std)
    explicit = loss.gaussian_head_gradient(advantage, action, mean, std, h)
    for found, expected in zip(explicit, numerical, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * (1 + norm(*explicit)))
    measured = o.gaussian_gradient_norm([advantage], action[None], mean[None], std, h[None])
    assert math.isclose(measured[0], norm(*explicit), rel_tol=1e-9)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_the_categorical_norm_is_the_gradients(seed) -> None:
    random = np.random.default_rng(seed)
    h, action, advantage = random.normal(size=3), int(random.integers(4)), random.normal()
    weights, bias = random.normal(size=(4, 3)), random.normal(size=4)

    def policy(weights, bias) -> np.ndarray:
        raised = np.exp(weights @ h + bias)
        return raised / raised.sum()

    pi = policy(weights, bias)
    surrogate = lambda *head: advantage * policy(*head)[action] / pi[action]  # noqa: E731
    numerical = (
        numerical_gradient(lambda x: surrogate(x, bias), weights),
        numerical_gradient(lambda x: surrogate(weights, x), bias),
    )
    explicit = loss.categorical_head_gradient(advantage, action, pi, h)
    for found, expected in zip(explicit, numerical, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
    measured = o.categorical_gradient_norm([advantage], [action], pi[None], h[None])
    assert math.isclose(measured[0], norm(*explicit), rel_tol=1e-9)


def test_drawing_by_the_norm_gives_the_smallest_spread() -> None:
    """Of all p the one in proportion to |g_i| makes E|w g|^2 smallest; uniform is far from it."""
    random = np.random.default_rng(2)
    size = np.abs(random.standard_cauchy(50))
    spread = lambda p: float((p * (o.importance_weights(p) * size) ** 2).sum())  # noqa: E731
    best = spread(o.mixed_probabilities(size, uniform=0.0))
    assert math.isclose(best, size.mean() ** 2)
    mixed = spread(o.mixed_probabilities(size))
    assert best <= mixed <= spread(np.full(50, 0.02))
    for _ in range(50):
        assert best <= spread(random.dirichlet(np.ones(50))) * (1 + 1e-12)


def test_delight_on_the_mean_leaves_the_width_alone() -> None:
    """Rare actions weigh more, so the weighted log-std gradient widens where the plain one is 0."""
    z = np.array([[2.0], [-2.0], [0.5], [-0.5]])
    advantage, std = np.array([1.0, -1.0, -1.0, 1.0]), np.array([0.5])
    entropy = math.log(0.5) + 0.5 * math.log(2 * math.pi * math.e)
    log_prob = -(z[:, 0] ** 2) / 2 - math.log(0.5) - 0.5 * math.log(2 * math.pi)
    weight = o.delight_weight(advantage, log_prob, np.full(4, entropy))
    np.testing.assert_allclose(o.surprisal(log_prob, entropy), (z[:, 0] ** 2 - 1) / 2)
    on_all, on_mean = (loss.gaussian_score(weight, advantage, z, std, on) for on in ("all", "mean"))
    np.testing.assert_array_equal(on_all[0], on_mean[0])
    np.testing.assert_allclose(on_mean[0][:, 0], weight * advantage * z[:, 0] / 0.5)
    assert math.isclose(on_mean[1].sum(), 0, abs_tol=1e-12) and on_all[1].sum() > 1
