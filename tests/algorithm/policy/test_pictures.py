"""Networks for pictures of any size, with XLA's own convolutions as the oracle."""

from __future__ import annotations

import dataclasses
import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import configured
from sauna.algorithm.policy import pictures
from sauna.algorithm.policy.pictures import ImpalaCNN, SmallCNN
from sauna.algorithm.policy.policy import make_policy
from sauna.envs.spaces import Spaces

KEY = jax.random.key(0)


def theirs(layer: dict, x):
    dimensions = ("NHWC", "HWIO", "NHWC")
    y = jax.lax.conv_general_dilated(
        x, layer["kernel"], (1, 1), "SAME", dimension_numbers=dimensions
    )
    return y + layer["bias"]


def moved(variables):
    """Parameters of which no bias is 0."""
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: x + 0.1 * rng.normal(size=x.shape).astype(np.float32), variables)[
        "params"
    ]


def test_the_small_cnn_is_two_padded_convolutions_and_a_layer() -> None:
    image = np.random.default_rng(0).integers(0, 4, (5, 7, 6, 3)).astype(np.uint8)
    params = moved(SmallCNN(high=3.0).init(KEY, image))
    x = nn.relu(theirs(params["conv_0"], image.astype(np.float32) / 3.0))
    x = nn.relu(theirs(params["conv_1"], x))[:, ::2, ::2].reshape(5, 4 * 3 * 32)
    expected = nn.relu(x @ params["dense"]["kernel"] + params["dense"]["bias"])
    got = SmallCNN(high=3.0).apply({"params": params}, image)
    assert got.shape == (5, 128) and float(jnp.abs(got).max()) > 0.1
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("board, axes", [((6, 7), (0, 1)), ((3, 7, 6), (1, 2, 0))])
def test_a_flattened_board_is_seen_as_its_picture(board: tuple, axes: tuple) -> None:
    """Of two axes, and with the channels first."""
    given = np.random.default_rng(0).random((4, *board)).astype(np.float32)
    picture = given.transpose(0, *(1 + axis for axis in axes))
    if len(board) == 2:
        picture = picture[..., None]
    whole, flat = SmallCNN(), SmallCNN(board=board)
    variables = whole.init(KEY, picture)
    np.testing.assert_array_equal(
        flat.apply(variables, given.reshape(4, -1)), whole.apply(variables, picture)
    )


@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 7, 3), (64, 48, 3)])
def test_both_take_pictures_of_any_size(shape: tuple) -> None:
    seen = jax.ShapeDtypeStruct((2, 3, *shape), jnp.uint8)
    for network, width in ((SmallCNN(), 128), (ImpalaCNN(), 256)):
        features = jax.eval_shape(lambda x, n=network: n.init_with_output(KEY, x)[0], seen)
        assert (features.shape, features.dtype) == ((2, 3, width), jnp.float32)


def test_impalas_network_has_its_published_parts() -> None:
    """15 convolutions; a picture of 64 x 48 leaves 8 x 6 x 32 numbers for 256 units."""
    seen = jax.ShapeDtypeStruct((1, 64, 48, 3), jnp.uint8)
    params = jax.eval_shape(ImpalaCNN().init, KEY, seen)["params"]
    channels, expected = 3, {"dense": 8 * 6 * 32 * 256 + 256}
    for i, features in enumerate((16, 32, 32)):
        for j in range(5):
            expected[f"conv_{i}_{j}"] = 9 * channels * features + features
            channels = features
    sizes = {
        name: sum(math.prod(x.shape) for x in jax.tree.leaves(part))
        for name, part in params.items()
    }
    assert sizes == expected


def test_impalas_network_is_what_it_says_also_in_pieces(monkeypatch) -> None:
    """Eleven pictures are two pieces on a CPU, with the gradient of one."""
    monkeypatch.setattr(pictures, "SECTIONS", (3, 4))
    image = np.random.default_rng(0).random((11, 5, 4, 2)).astype(np.float32)
    params = moved(ImpalaCNN().init(KEY, image))

    def by_hand(params):
        x = image
        for i in range(2):
            x = nn.max_pool(theirs(params[f"conv_{i}_0"], x), (3, 3), (2, 2), "SAME")
            for j in (1, 3):
                inner = nn.relu(theirs(params[f"conv_{i}_{j}"], nn.relu(x)))
                x = x + theirs(params[f"conv_{i}_{j + 1}"], inner)
        x = nn.relu(x).reshape(11, -1)
        return nn.relu(x @ params["dense"]["kernel"] + params["dense"]["bias"])

    def squares(function):
        return jax.jit(jax.value_and_grad(lambda params: (function(params) ** 2).mean()))(params)

    ours = squares(lambda params: ImpalaCNN().apply({"params": params}, image))
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(squares(by_hand)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)


def test_an_mlp_flattens_pictures_of_floats() -> None:
    spaces = Spaces("float_image", (40, 36, 1), "discrete", (2,), "", "")
    policy = make_policy(dataclasses.replace(configured(hidden="3"), network="mlp"), spaces)
    params = policy.unravel(policy.init(KEY))["params"]
    assert params["policy_trunk"]["layer_0"]["kernel"].shape == (40 * 36, 3)
