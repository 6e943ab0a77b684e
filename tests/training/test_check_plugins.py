"""Networks of a user's own: which forms train, and what is found before a run."""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import numpy as np
import pytest

import own_networks
import sauna
from helpers import SMALL, configured, make_job, train_here
from sauna.algorithm.policy.policy import make_policy
from sauna.envs.spaces import Spaces
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.training.check_plugins import check_plugins
from sauna.training.loop.member_state import named_params

VECTOR = Spaces("vector", (3,), "continuous", (2,), "", "")
BOARD = Spaces("image", (5, 5, 1), "discrete", (2,), "", "", 3.0)
SETTINGS = {name: value for name, value in SMALL.items() if name != "hidden"}


def of(network: str, **settings: object):
    return dataclasses.replace(configured(**settings), network=f"own_networks:{network}")


@pytest.mark.parametrize(
    "network, kernel",
    [
        ("sequence", "layers_2/Dense_0/kernel"),
        ("built", "layers_2/Dense_0/kernel"),
        ("instance", "Dense_0/kernel"),
        ("filled", "Dense_0/kernel"),
        ("Wide", "Dense_0/kernel"),
    ],
)
def test_a_class_an_instance_a_partial_and_a_function_are_taken(network: str, kernel: str) -> None:
    """Both trunks have weights of their own, of the width that was given."""
    config = of(network)
    check_plugins(config, VECTOR)
    policy = make_policy(config, VECTOR)
    named = named_params(policy, policy.init(jax.random.key(0)))
    one, other = named[f"policy_trunk/{kernel}"], named[f"value_trunk/{kernel}"]
    widths = {"sequence": 7, "built": 7, "instance": 9, "filled": 3, "Wide": 5}
    assert one.shape[-1] == widths[network] and not np.array_equal(one, other)


REFUSED = [
    ("Normed", "keeps batch_stats beside its parameters"),
    ("Counting", "keeps calls beside its parameters"),
    ("Dropping", "Dropout needs deterministic=True"),
    ("Summed", "gives (2,) for observations of shape (2, 3), instead of (2, features)"),
    ("Flattened", "for observations of shape (3, 2, 3), instead of (3, 2, features)"),
    ("Pair", "gives tuple for observations"),
    ("Rounded", "gives int32, instead of floating-point features"),
    ("Logarithm", "gives features of shape (8, 4) with NaN or infinity"),
    ("Root", "gives a gradient of shape"),
]


@pytest.mark.parametrize("network, words", REFUSED, ids=[r[0] for r in REFUSED])
def test_a_network_that_cannot_train_is_named_before_the_run(network: str, words: str) -> None:
    with pytest.raises(BadInput) as error:
        check_plugins(of(network), VECTOR)
    text = str(error.value)
    assert words in text and "\n" not in text
    assert text.startswith(f"network: own_networks:{network} ")


def test_a_small_board_trains_with_a_small_cnn_an_mlp_and_ones_own_network() -> None:
    job = make_job("small_envs:Board", arm="ppo", network="auto", **SETTINGS)
    assert (job.config.network, job.spaces.observation_high) == ("small-cnn", 3.0)
    kernel = train_here(job).final["ppo/0/params/policy_trunk/conv_0/kernel"]
    assert kernel.shape == (3, 3, 1, 16)
    job = make_job("small_envs:Board", arm="ppo", network="mlp", **SETTINGS)
    kernel = train_here(job).final["ppo/0/params/policy_trunk/layer_0/kernel"]
    assert kernel.shape == (25, 64)
    check_plugins(of("Embedded"), BOARD)
    job = make_job("small_envs:Board", arm="ppo", network="own_networks:Embedded", **SETTINGS)
    assert len(train_here(job).rows) == 4
    with pytest.raises(BadInput, match=r"\(5, 5, 1\) \(it needs 36 x 36 pixels\)"):
        make_job("small_envs:Board", network="nature-cnn")


@pytest.mark.parametrize("network", ["mlp", "nature-cnn"])
def test_bytes_are_divided_by_the_highest_one(network: str) -> None:
    """A mask of 0 and 1 is seen as a picture of 0 and 255 is."""
    mask = np.random.default_rng(0).integers(0, 2, (4, 40, 40, 1)).astype(np.uint8)
    config = dataclasses.replace(configured(), network=network)
    values = []
    for high in (1, 255):
        spaces = Spaces("image", (40, 40, 1), "discrete", (2,), "", "", float(high))
        policy = make_policy(config, spaces)
        values.append(policy.apply(policy.init(jax.random.key(0)), mask * np.uint8(high)).value)
    assert np.ptp(values[0]) > 0.01
    np.testing.assert_allclose(values[0], values[1], rtol=1e-4, atol=1e-5)


def test_an_instance_passed_by_value_trains(tmp_path) -> None:
    run = sauna.train(
        "small_envs:Scripted",
        quiet=True,
        out=tmp_path / "run",
        network=nn.Sequential([own_networks.Wide(6), nn.Dense(4)]),
        **SETTINGS,
    )
    assert run_directory.is_complete(run.path)
    assert run.policy()(np.zeros(3)).shape == (2,)
