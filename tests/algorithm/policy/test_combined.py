"""The combined network: what each picture's network gives beside the numbers, and then an MLP."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import configured, make_job
from sauna.algorithm.policy.networks import MLP, NatureCNN
from sauna.algorithm.policy.policy import make_policy
from sauna.config.settings import Config
from sauna.envs.small import Signpost
from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput

SIDE = 36
PICTURE = SIDE * SIDE
SPACES = Spaces("vector", (3 + 2 * PICTURE,), "discrete", (4,), "", "")
SPACES = SPACES._replace(pictures=((SIDE, SIDE, 1, 255.0), (SIDE, SIDE, 1, 9.0)))


def of(network: str) -> Config:
    return dataclasses.replace(configured(hidden="5", trunk="shared"), network=network)


def seen() -> np.ndarray:
    rng = np.random.default_rng(0)
    numbers, bytes_ = rng.normal(size=(2, 3)), rng.integers(0, 10, (2, 2 * PICTURE))
    return np.concatenate([numbers, bytes_], -1).astype(np.float32)


def test_the_features_are_those_of_the_parts_put_together_by_hand() -> None:
    policy = make_policy(of("nature-cnn"), SPACES)
    params = policy.init(jax.random.key(0))
    trunk: Any = policy.unravel(params)["params"]["trunk"]
    given = seen()
    pictures = given[:, 3:].reshape(2, 2, SIDE, SIDE, 1).astype(np.uint8)
    found = [given[:, :3]]
    for i, high in enumerate((255.0, 9.0)):
        network = NatureCNN(high=high)
        found.append(network.apply({"params": trunk[f"picture_{i}"]}, pictures[:, i]))
    wanted = MLP((5,)).apply({"params": trunk["trunk"]}, jnp.concatenate(found, -1))
    output = policy.apply(params, given)
    np.testing.assert_allclose(output.hidden, wanted, rtol=1e-5, atol=1e-6)


def test_with_the_mlp_pixels_in_units_of_their_highest_stand_beside_the_numbers() -> None:
    policy = make_policy(of("mlp"), SPACES)
    params = policy.init(jax.random.key(0))
    trunk: Any = policy.unravel(params)["params"]["trunk"]
    given = seen()
    unit = np.repeat([1.0, 255.0, 9.0], [3, PICTURE, PICTURE]).astype(np.float32)
    wanted = MLP((5,)).apply({"params": trunk["trunk"]}, given / unit)
    np.testing.assert_allclose(policy.apply(params, given).hidden, wanted, rtol=1e-5, atol=1e-6)


def test_numbers_alone_are_normalized_and_the_head_reads_hidden() -> None:
    job = make_job("sauna.envs.small:Signpost", arm="ppo", hidden="7", envs=2)
    assert job.config.network == "nature-cnn" and job.config.hidden == (7,)
    assert job.spaces.normalized == 1 and job.config.normalize_observations
    shown = make_job("sauna.envs.small:Signpost", arm="ppo", env_kwargs='{"shows": "number"}')
    assert shown.config.network == "mlp" and not shown.spaces.pictures
    alone = {"env_kwargs": '{"shows": "picture"}'}
    with pytest.raises(BadInput, match="hidden: not read"):
        make_job("sauna.envs.small:Signpost", arm="ppo", hidden="7", **alone)


def test_the_small_envs_are_solved_by_what_they_say() -> None:
    """The corner that is bright, so many corners further on."""
    env = Signpost()
    observation, _ = env.reset(seed=3)
    total, ended = 0.0, False
    while not ended:
        quarter = observation["picture"].reshape(2, 18, 2, 18).mean((1, 3))
        corner = [quarter[0, 0], quarter[0, 1], quarter[1, 1], quarter[1, 0]]
        action = (int(np.argmax(corner)) + int(observation["number"][0])) % 4
        observation, reward, ended, _, _ = env.step(action)
        total += reward
    assert total == 16.0
