"""Networks for pictures of any size: a small one, and IMPALA's residual network."""

from __future__ import annotations

import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from sauna.algorithm.policy.convolutions import Layer, convolution
from sauna.algorithm.policy.networks import Convolution, dense
from sauna.algorithm.types import Array
from sauna.envs.pictures import channels_first


class SmallCNN(nn.Module):
    """Pictures `[..., H, W, C]` of any size -> `[..., 128]`.

    MinAtar's network (Young and Tian 2019: a 3 x 3 convolution of 16 features and 128 units) with a
    second convolution of 32 features in between. Both are padded, so that the smallest pictures
    pass; the second moves by two pixels.

    Attributes:
      high: what bytes are divided by.
      board: of observations that are flattened pictures `[..., D]`, their shape; else ().
    """

    high: float = 255.0
    board: tuple[int, ...] = ()

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        x, lead = pictures(observation, self.board)
        for i, features in enumerate((16, 32)):
            layer = Convolution(features, 3, name=f"conv_{i}")(x.shape[-1])
            x = padded(layer, x, stride=i + 1, rectified=True, high=self.high)
        x = nn.relu(dense(128, math.sqrt(2.0), "dense")(x.reshape((len(x), -1))))
        return x.reshape((*lead, -1))


SECTIONS = (16, 32, 32)  # features of each section of IMPALA's network
BLOCKS = 2  # residual blocks of a section
PICTURES = 8  # that a CPU takes at a time


class ImpalaCNN(nn.Module):
    """Pictures `[..., H, W, C]` of any size -> `[..., 256]` (Espeholt et al. 2018, figure 3).

    Each of `SECTIONS` is a convolution, a maximum over 3 x 3 pixels that moves by two, and two
    residual blocks of two convolutions. All are 3 x 3 and padded, and start orthogonal.

    Attributes:
      high, board: as of `SmallCNN`.
    """

    high: float = 255.0
    board: tuple[int, ...] = ()

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        x, lead = pictures(observation, self.board)
        layers, channels = [], x.shape[-1]
        for i, features in enumerate(SECTIONS):
            for j in range(1 + 2 * BLOCKS):
                layers.append(Convolution(features, 3, name=f"conv_{i}_{j}")(channels))
                channels = features
        x = by_pieces(lambda x: residual(layers, x, self.high), x)
        x = nn.relu(dense(256, math.sqrt(2.0), "dense")(x.reshape((len(x), -1))))
        return x.reshape((*lead, -1))


PICTURE_NETWORKS: dict[str, type[SmallCNN | ImpalaCNN]] = {
    "small-cnn": SmallCNN,
    "impala-cnn": ImpalaCNN,
}


def pictures(observation: Array, board: tuple[int, ...]) -> tuple[Array, tuple[int, ...]]:
    """Observations as `[B, H, W, C]`, and their leading axes."""
    axes = 1 if board else 3
    lead, x = observation.shape[:-axes], observation
    x = x.reshape((-1, *(board or x.shape[-3:])))
    if len(board) == 2:
        x = x[..., None]
    elif channels_first(board):
        x = jnp.moveaxis(x, 1, -1)
    return x, lead


def padded(
    layer: Layer, x: Array, stride: int = 1, rectified: bool = False, high: float = 255.0
) -> Array:
    """A 3 x 3 `convolution` with zeros around the picture: `[B, H, W, F]` at a stride of 1."""
    around = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    return convolution(*layer, around, stride, rectified, high)


def residual(layers: list[Layer], x: Array, high: float) -> Array:
    """The sections of `ImpalaCNN`, `[B, H, W, C]` -> `[B, H', W', 32]`, and a ReLU."""
    left = iter(layers)
    for _ in SECTIONS:
        x = nn.max_pool(padded(next(left), x, high=high), (3, 3), (2, 2), "SAME")
        for _ in range(BLOCKS):
            inner = padded(next(left), nn.relu(x), rectified=True)
            x = x + padded(next(left), inner)
    return nn.relu(x)


def by_pieces(forward: Callable[[Array], Array], x: Array) -> Array:
    """`forward(x)`, on a CPU a few pictures at a time.

    The gradient computes a piece anew: all that lies between the layers of a whole minibatch would
    need gigabytes.
    """
    if len(x) <= PICTURES or jax.default_backend() != "cpu":
        return forward(x)
    filled = jnp.pad(x, [(0, -len(x) % PICTURES)] + [(0, 0)] * (x.ndim - 1))
    pieces = filled.reshape(-1, PICTURES, *x.shape[1:])
    out = jax.lax.map(jax.checkpoint(forward), pieces)
    return out.reshape(-1, *out.shape[2:])[: len(x)]
