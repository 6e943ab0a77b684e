"""Cloning finds the policy of largest likelihood, and the values of what was played."""

from __future__ import annotations

import math

import jax
import numpy as np

from helpers import configured
from sauna.algorithm.learner.cloning import (
    Cloner,
    Fit,
    Rows,
    clone_order,
    make_cloner,
    returns_to_go,
)
from sauna.algorithm.policy.policy import make_policy
from sauna.envs.spaces import Spaces

SIZE = 512


def rows(observation: np.ndarray, action: np.ndarray, value: np.ndarray) -> Rows:
    """Single steps of reward `value`, each of which terminates."""
    number = len(action)
    return Rows(
        observation.astype(np.float32),
        action,
        value.astype(np.float32),
        np.zeros(number, np.float32),
        np.zeros(number, np.int32),
        np.zeros((1, observation.shape[1]), np.float32),
    )


def cloned(data: Rows, kind: str, sizes: tuple[int, ...]) -> Fit:
    """How well what was fitted to `data` fits it."""
    return cloned_alike([data], kind, sizes, 60)[0]


def cloned_alike(
    each: list[Rows], kind: str, sizes: tuple[int, ...], epochs: int, mask: int = 0
) -> list[Fit]:
    """The same for several data of one shape, whose last `mask` numbers say what is valid."""
    config = configured(hidden="16", clone_learning_rate=1e-2, init_from="data:x")
    spaces = Spaces("vector", each[0].observation.shape[1:], kind, sizes, (), (), mask=mask)
    policy = make_policy(config, spaces)
    cloner: Cloner = make_cloner(config, policy, 0.5)
    fits = []
    for data in each:
        state = cloner.start(policy.init(jax.random.key(0)))
        for epoch in range(epochs):
            state, _ = cloner.epoch(state, data, clone_order(len(data.action), 0, epoch))
        fits.append(cloner.fit(state.params, data))
    return fits


def test_returns_go_to_the_end_of_their_own_episode() -> None:
    reward, length = np.array([1.0, 2.0, 4.0, 8.0, 16.0]), np.array([3, 2])
    returns, discount = returns_to_go(reward, length, np.array([False, True]), 0.5)
    np.testing.assert_array_equal(returns, [3.0, 4.0, 4.0, 16.0, 16.0])
    np.testing.assert_array_equal(discount, [0.0, 0.0, 0.0, 0.25, 0.5])


def test_an_epoch_takes_each_row_at_most_once() -> None:
    order = clone_order(200, 3, 1)
    assert order.shape == (3, 64) and len(np.unique(order)) == 192
    assert clone_order(10, 3, 1).shape == (1, 10)
    assert not np.array_equal(order, clone_order(200, 3, 2))
    assert not np.array_equal(order, clone_order(200, 4, 1))


def test_where_all_look_alike_the_frequencies_of_actions_are_learned() -> None:
    action = (np.arange(SIZE) % 4 == 0).astype(np.int32)[:, None]
    fit = cloned(rows(np.ones((SIZE, 1)), action, 3.0 + action[:, 0]), "discrete", (2,))
    entropy = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)
    assert abs(float(fit.log_likelihood) + entropy) < 0.005
    assert float(fit.agreement) == 0.75
    # V is the mean, 3.25: what is left is the spread about it.
    left = math.sqrt(0.1875 / (0.25 * 16 + 0.75 * 9))
    assert abs(float(fit.value_error) - left) < 0.01


def test_only_valid_actions_count_into_the_likelihood() -> None:
    """Where 0 and 1 are valid, 3 of 4 actions are 0; where 0 and 2 are, each second one is.

    So the policy of largest likelihood has 3:1:3, and two entropies are what it leaves. Without
    masks the same actions are 5, 1 and 2 of 8.
    """
    number = np.arange(SIZE)
    first = number % 2 == 0
    action = np.where(first, number % 8 == 0, 2 * (number % 4 == 1)).astype(np.int32)[:, None]
    mask = np.where(first[:, None], [1, 1, 0], [1, 0, 1])
    seen = np.concatenate([np.ones((SIZE, 1)), mask], 1)
    masked = cloned_alike([rows(seen, action, number * 0.0)], "discrete", (3,), 60, mask=3)[0]
    plain = cloned(rows(seen[:, :1], action, number * 0.0), "discrete", (3,))
    quarter = 0.25 * math.log(0.25) + 0.75 * math.log(0.75)
    assert abs(float(masked.log_likelihood) - (quarter + math.log(0.5)) / 2) < 0.005
    eighths = sum(n / 8 * math.log(n / 8) for n in (5, 1, 2))
    assert abs(float(plain.log_likelihood) - eighths) < 0.005


def test_a_rule_is_learned_and_noise_is_not() -> None:
    generator = np.random.default_rng(0)
    seen = generator.normal(size=(SIZE, 2))
    rule = np.stack([seen[:, 0] > 0, seen[:, 1] > seen[:, 0]], 1).astype(np.int32)
    noise = generator.permutation(rule)
    learned, chance = cloned_alike(
        [rows(seen, actions, seen[:, 0]) for actions in (rule, noise)], "multi_discrete", (2, 2), 20
    )
    assert float(learned.agreement) > 0.9 and float(learned.value_error) < 0.2
    assert float(chance.agreement) < 0.5


def test_a_gaussian_takes_over_mean_and_spread() -> None:
    generator = np.random.default_rng(0)
    seen = generator.normal(size=(SIZE, 1))
    noise = generator.normal(size=(SIZE, 1))
    noise = 0.3 * (noise - noise.mean()) / noise.std()
    fit = cloned(rows(seen, (seen + noise).astype(np.float32), seen[:, 0]), "continuous", (1,))
    most = -0.5 * math.log(2 * math.pi * math.e * 0.09)  # of the true mean, with its own spread
    assert most - 0.02 < float(fit.log_likelihood) < most + 0.1
    assert 0.89 < float(fit.agreement) < 0.95  # 1 - 0.09 / (1 + 0.09) = 0.917


def test_values_go_on_behind_an_end_that_is_no_termination() -> None:
    """Reward 1 for ever, in episodes cut after 4 steps: V = 1 / (1 - gamma) = 2."""
    gamma, number = 0.5, 256
    returns, discount = returns_to_go(
        np.ones(number), np.full(number // 4, 4), np.ones(number // 4, bool), gamma
    )
    action = np.zeros((number, 1), np.int32)
    data = rows(np.ones((number, 1)), action, returns)._replace(
        discount=discount.astype(np.float32), final=np.ones((1, 1), np.float32)
    )
    config = configured(hidden="16", clone_learning_rate=1e-2, init_from="data:x")
    policy = make_policy(config, Spaces("vector", (1,), "discrete", (2,), (), ()))
    cloner = make_cloner(config, policy, 0.5)
    state = cloner.start(policy.init(jax.random.key(0)))
    for epoch in range(60):
        state, _ = cloner.epoch(state, data, clone_order(number, 0, epoch))
    value = policy.apply(state.params, np.ones((1, 1), np.float32)).value[0]
    assert abs(float(value) - 2.0) < 0.05
    # Without what follows, V is the mean of the cut returns.
    assert abs(returns.mean() - 2.0) > 0.4
