"""Losses against float64 numpy, gradients against finite differences, the update's order."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from arrays import VECTOR, hypers, losses_of_terms, losses_on, parts_of, random_batch
from helpers import configured
from sauna.algorithm.learner import ppo
from sauna.algorithm.learner.losses import standardize
from sauna.algorithm.learner.ppo import surrogate, value_error
from sauna.algorithm.learner.update import init_state, minibatch_order, update_on_all
from sauna.algorithm.policy.policy import make_policy


def numpy_losses(log_ratio, advantage, value, old, return_, vex, target, entropy, w, h):
    """The same sums, sample by sample."""
    total = w.sum()
    mean = (advantage * w).sum() / total
    std = np.sqrt((((advantage - mean) ** 2) * w).sum() / total)
    sums = dict.fromkeys(["policy", "value", "vex", "entropy", "kl", "clip"], 0.0)
    for i in np.flatnonzero(w):
        a, ratio = (advantage[i] - mean) / (std + 1e-8), np.exp(log_ratio[i])
        bounded = min(max(ratio, 1 - h.clip_range), 1 + h.clip_range)
        sums["policy"] -= min(ratio * a, bounded * a)
        near = old[i] + min(max(value[i] - old[i], -h.clip_range), h.clip_range)
        sums["value"] += 0.5 * max((value[i] - return_[i]) ** 2, (near - return_[i]) ** 2)
        sums["vex"] += (vex[i] - target[i]) ** 2
        sums["entropy"] += entropy[i]
        sums["kl"] += ratio - 1 - log_ratio[i]
        sums["clip"] += abs(ratio - 1) > h.clip_range
    m = {k: v / total for k, v in sums.items()}
    loss = m["policy"] - h.entropy_coef * m["entropy"]
    loss += h.value_coef * m["value"] + h.vex_coef * m["vex"]
    return [loss, m["policy"], m["value"], m["vex"], m["entropy"], m["kl"], m["clip"]]


def test_losses_equal_plain_sums() -> None:
    rng = np.random.default_rng(1)
    log_ratio, advantage, value, old, return_, vex, target, entropy = rng.normal(size=(8, 50))
    weight = (rng.random(50) < 0.7).astype(float)
    h = hypers()
    expected = numpy_losses(
        log_ratio * 0.3, advantage, value, old, return_, vex, target, entropy, weight, h
    )
    with jax.enable_x64(True):
        got = losses_of_terms(
            ppo,
            h,
            configured(),
            log_ratio=log_ratio * 0.3,
            advantage=standardize(jnp.asarray(advantage), jnp.asarray(weight)),
            value=value,
            old=old,
            return_=return_,
            vex=vex,
            vex_target=target,
            entropy=entropy,
            weight=weight,
        )
    np.testing.assert_allclose(got[:7], expected, atol=1e-12)


def test_surrogate_by_hand() -> None:
    """Clipped where it would profit (A > 0, r high; A < 0, r low), free where it would not."""
    log_ratio = jnp.log(jnp.array([1.5, 1.5, 0.5, 0.5]))
    advantage = jnp.array([1.0, -1.0, 1.0, -1.0])
    got = surrogate(log_ratio, advantage, 0.2)
    np.testing.assert_allclose(got, [-1.2, 1.5, -0.5, 0.8], rtol=1e-6)


def test_value_clipping_can_be_turned_off() -> None:
    value, old, return_ = jnp.array([2.0]), jnp.array([0.0]), jnp.array([2.0])
    np.testing.assert_allclose(value_error(value, old, return_, 0.2), [0.5 * 1.8**2], rtol=1e-6)
    np.testing.assert_allclose(value_error(value, old, return_, None), [0.0])


@pytest.mark.parametrize("trunk", ["separate", "shared"])
@pytest.mark.parametrize("target", ["sample", "minibatch"])
def test_gradients_equal_finite_differences(trunk: str, target: str) -> None:
    config = configured(arm="vex-head", hidden="5,4", trunk=trunk, vex_target=target)
    with jax.enable_x64(True):
        policy = make_policy(config, VECTOR)
        params = policy.init(jax.random.key(0)).astype(jnp.float64)
        params = params + 0.1 * jax.random.normal(jax.random.key(1), params.shape, jnp.float64)
        batch = jax.tree.map(jnp.asarray, random_batch())

        def loss(p):
            return losses_on(p, batch, hypers(), parts_of(config, policy, target)).total

        gradient = np.asarray(jax.jit(jax.grad(loss))(params))
        compiled = jax.jit(loss)
        picked = np.random.default_rng(0).choice(len(params), 60, replace=False)
        for i in picked:
            step = np.zeros(len(params))
            step[i] = 1e-6
            higher, lower = compiled(np.asarray(params) + step), compiled(np.asarray(params) - step)
            assert abs((higher - lower) / 2e-6 - gradient[i]) < 1e-6


def test_weight_0_samples_do_not_count_even_if_absurd() -> None:
    config = configured(hidden="5")
    policy = make_policy(config, VECTOR)
    params = policy.init(jax.random.key(0))
    batch = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), random_batch())
    out = batch.weight == 0
    absurd = batch._replace(
        log_prob=jnp.where(out, -1e30, batch.log_prob),
        advantage=jnp.where(out, 1e6, batch.advantage),
        return_=jnp.where(out, 1e6, batch.return_),
    )

    parts = parts_of(config, policy)
    gradient_of = jax.jit(jax.grad(lambda p, part: losses_on(p, part, hypers(), parts).total))

    def gradient(part):
        return gradient_of(params, part)

    np.testing.assert_array_equal(gradient(batch), gradient(absurd))


def test_update_is_epochs_of_shuffled_minibatches_of_clipped_adam() -> None:
    """An independent loop: baselines' formulas for clipping and Adam, numpy for the rest."""
    config = configured(
        hidden="4", epochs=3, minibatches=2, rollout_steps=24, steps=24, max_grad_norm=0.05
    )
    h = hypers(max_grad_norm=0.05, learning_rate=0.02)
    with jax.enable_x64(True):
        policy = make_policy(config, VECTOR)
        parts = parts_of(config, policy)
        batch = jax.tree.map(jnp.asarray, random_batch())
        order = minibatch_order(config, seed=7, iteration=2)
        state = init_state(parts, jax.random.key(0))
        state = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == np.float32 else x, state)
        update = jax.jit(partial(update_on_all, parts=parts))
        got, _, norm = update(state, batch, h, order)

        @jax.jit
        @jax.grad
        def gradient(p, part):
            return losses_on(p, part, h, parts).total

        params = np.asarray(state.params)
        mean, square, norms = np.zeros_like(params), np.zeros_like(params), []
        count = 0
        for epoch in order:
            assert sorted(epoch) == list(range(24))
            for rows in epoch.reshape(2, 12):
                part = jax.tree.map(lambda x, rows=rows: x[rows], batch)
                g = np.asarray(gradient(jnp.asarray(params), part))
                norms.append(np.sqrt((g**2).sum()))
                g = g * min(1.0, 0.05 / norms[-1])
                count += 1
                mean = 0.9 * mean + 0.1 * g
                square = 0.999 * square + 0.001 * g**2
                step = (mean / (1 - 0.9**count)) / (np.sqrt(square / (1 - 0.999**count)) + 1e-5)
                params = params - 0.02 * step
    np.testing.assert_allclose(got.params, params, atol=1e-9)
    np.testing.assert_allclose(norm, np.mean(norms), rtol=1e-9)
    assert min(norms) > 0.05  # the clipping was active, and global rather than per element
    assert isinstance(got.optimizer, optax.ScaleByAdamState)


def test_the_order_of_samples_depends_on_seed_iteration_and_epoch() -> None:
    config = configured(epochs=3, minibatches=2, rollout_steps=24, steps=24)
    orders = [minibatch_order(config, seed, i) for seed in (0, 1) for i in (0, 1)]
    rows = {tuple(row) for order in orders for row in order.tolist()}
    assert len(rows) == 12
    np.testing.assert_array_equal(orders[3], minibatch_order(config, 1, 1))
