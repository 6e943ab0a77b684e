"""Optimizers by optax's name, weight decay, and the rate that follows the KL divergence."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree

from arrays import VECTOR, hypers, parts_of, random_batch
from helpers import configured
from sauna.algorithm.learner.optimizers import moved_rate, scaling
from sauna.algorithm.learner.update import Parts, gradient_step, init_state, plain_minibatch
from sauna.algorithm.policy.policy import make_policy
from sauna.config.choices import OPTIMIZERS
from sauna.config.settings import Config
from sauna.system.errors import BadInput
from sauna.training.check_plugins import check_optimizer
from sauna.training.loop.member_state import named_learner, unpack_learner

TREE = {"a": np.float32([0.5, -1.0, 2.0]), "b": np.float32([[0.1, 0.2], [-0.3, 1.5]])}
START, UNRAVEL = ravel_pytree(TREE)


class Tree:
    """As much of a policy as an optimizer reads."""

    unravel = staticmethod(UNRAVEL)


def small(**settings: Any) -> Config:
    return configured(arm="ppo", hidden="2", rollout_steps=24, minibatches=1, **settings)


def descended(transform: Any, start: Any, rate: float, steps: int) -> Any:
    """The end of a descent of `|x - 1|^2 / 2`."""

    def step(_: int, now: Any) -> Any:
        x, state = now
        off, state = transform.update(x - 1.0, state, x)
        return x - rate * off, state

    x = jnp.asarray(start)
    return np.asarray(jax.lax.fori_loop(0, steps, step, (x, transform.init(x)))[0])


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_every_optimizer_goes_downhill(name: str) -> None:
    end = descended(scaling(small(optimizer=name), Tree()), START, 0.02, 1000)  # type: ignore[arg-type]
    assert np.abs(end - 1.0).max() < 0.1 * np.abs(START - 1.0).max()


@pytest.mark.parametrize(
    "settings, oracle",
    [
        ({"optimizer": "adam"}, optax.adam(0.1, eps=1e-5)),
        ({"optimizer": "adamw"}, optax.adamw(0.1)),
        ({"optimizer": "adamw", "weight_decay": 0.2}, optax.adamw(0.1, weight_decay=0.2)),
        ({"optimizer": "adam", "weight_decay": 0.2}, optax.adamw(0.1, eps=1e-5, weight_decay=0.2)),
        (
            {"optimizer": "sgd", "optimizer_kwargs": '{"momentum": 0.9, "nesterov": true}'},
            optax.sgd(0.1, 0.9, nesterov=True),
        ),
        ({"optimizer": "lion", "optimizer_kwargs": '{"b1": 0.5}'}, optax.lion(0.1, b1=0.5)),
        ({"optimizer": "optax:adan"}, optax.adan(0.1)),
        ({"optimizer": "lamb"}, optax.lamb(0.1)),
    ],
)
def test_an_optimizer_is_optax_s_on_the_parameter_tree(settings: dict, oracle: Any) -> None:
    found = descended(scaling(small(**settings), Tree()), START, 0.1, 5)  # type: ignore[arg-type]
    tree, state = UNRAVEL(START), oracle.init(UNRAVEL(START))
    for _ in range(5):
        gradient = jax.tree.map(lambda x: x - 1.0, tree)
        step, state = oracle.update(gradient, state, tree)
        tree = optax.apply_updates(tree, step)
    np.testing.assert_allclose(found, ravel_pytree(tree)[0], rtol=1e-5)


def test_decay_takes_its_share_times_the_rate() -> None:
    """SGD on a gradient of 0: x becomes x - 0.1 * 0.2 x."""
    transform = scaling(small(optimizer="sgd", weight_decay=0.2), Tree())  # type: ignore[arg-type]
    off, _ = transform.update(jnp.zeros(START.shape), transform.init(START), START)
    np.testing.assert_allclose(START - 0.1 * off, 0.98 * START, rtol=1e-6)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"optimizer": "adan"}, "unknown value 'adan'.*module:name"),
        ({"optimizer": "optax:no_such"}, "has no 'no_such'"),
        ({"optimizer": "rmsprop", "adam_epsilon": 1e-3}, "adam_epsilon: not read"),
        ({"optimizer_kwargs": '{"eps": 1}'}, "eps is a setting of its own: adam_epsilon"),
        ({"optimizer_kwargs": '{"no": 1}'}, "adam cannot be made.*'no'"),
        ({"optimizer": "sgd", "optimizer_kwargs": '{"learning_rate": 1}'}, "of its own"),
        ({"optimizer": "optax:sigmoid_binary_cross_entropy"}, "cannot be made"),
        ({"optimizer": "optax:lbfgs"}, "cannot make a step"),
        (
            {"optimizer": "lion", "weight_decay": 0.1, "optimizer_kwargs": '{"weight_decay": 1}'},
            "weight_decay is a setting of its own",
        ),
    ],
)
def test_an_optimizer_that_cannot_be_used_is_refused(settings: dict, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        config = small(**settings)
        check_optimizer(config, make_policy(config, VECTOR))


def test_the_rate_moves_by_half_as_much_again_within_bounds() -> None:
    config = small(learning_rate_schedule="kl", desired_kl=0.01, learning_rate_max=4e-4)
    cases = [
        (3e-4, 0.0201, 2e-4),
        (3e-4, 0.0199, 3e-4),
        (3e-4, 0.0051, 3e-4),
        (2e-4, 0.0049, 3e-4),
        (3e-4, 0.0, 4e-4),
        (1.2e-5, 1.0, 1e-5),
    ]
    for rate, kl, expected in cases:
        found = moved_rate(jnp.float32(rate), jnp.float32(kl), config)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def learning(**settings: Any) -> tuple[Parts, Any]:
    config = small(**settings)
    parts = parts_of(config, make_policy(config, VECTOR))
    state = init_state(parts, jax.random.key(0))
    minibatch = plain_minibatch(random_batch(24), parts)
    minibatch = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), minibatch)

    @jax.jit
    def step(state: Any, rate: Any) -> Any:
        h = hypers()._replace(learning_rate=jnp.asarray(rate, jnp.float32))
        return gradient_step(state, minibatch, h, parts=parts)

    return state, step


def test_a_step_has_the_rate_that_its_kl_calls_for() -> None:
    """The random batch is far from the policy: the KL is large, and each step divides by 1.5."""
    state, step = learning(learning_rate_schedule="kl")
    plain, constant = learning(learning_rate_schedule="constant")
    assert float(state.learning_rate) == 0 and plain.learning_rate == ()
    for rate in (3e-4 / 1.5, 3e-4 / 1.5**2):
        state, losses, _ = step(state, 3e-4)
        plain, _, _ = constant(plain, rate)
        assert float(losses.kl) > 0.02
        np.testing.assert_allclose(state.learning_rate, rate, rtol=1e-6)
        np.testing.assert_allclose(state.params, plain.params, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize(
    "settings",
    [
        {"learning_rate_schedule": "kl"},
        {"optimizer": "lion"},
        {"optimizer": "adam", "weight_decay": 0.1},
    ],
)
def test_a_learner_s_state_comes_back(settings: dict) -> None:
    state, step = learning(**settings)
    config = small(**settings)
    policy = make_policy(config, VECTOR)
    after, _, _ = step(state, 3e-4)
    again = unpack_learner(policy, named_learner(policy, after), state)
    assert jax.tree.structure(again) == jax.tree.structure(after)
    jax.tree.map(np.testing.assert_array_equal, again, after)
