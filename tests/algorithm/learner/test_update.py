"""The order of an update's samples on the device."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from sauna.algorithm.learner.update import device_minibatch_order, permutation
from sauna.config.presets import resolve


@pytest.mark.parametrize("number", [1, 2, 7, 1625, 1626, 70_000])  # from 1626 on, JAX sorts twice
def test_a_permutation_is_jax_s_own(number: int) -> None:
    keys = jax.random.split(jax.random.key(number), 3)
    found = jax.jit(jax.vmap(lambda key: permutation(key, number)))(keys)
    wanted = jax.vmap(lambda key: jax.random.permutation(key, number))(keys)
    assert found.dtype == wanted.dtype == np.int32
    np.testing.assert_array_equal(found, wanted)


def test_every_epoch_has_an_order_of_its_own() -> None:
    config = resolve({"env": "x", "arm": "ppo", "envs": 4, "rollout_steps": 32, "epochs": 3})
    order = np.asarray(device_minibatch_order(config, jax.random.key(0)))
    np.testing.assert_array_equal(np.sort(order, axis=1), np.tile(np.arange(128), (3, 1)))
    assert len({tuple(row) for row in order.tolist()}) == 3
