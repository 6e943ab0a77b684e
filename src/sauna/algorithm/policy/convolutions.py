"""The Nature CNN's convolutions (Mnih et al. 2015), a few pictures at a time on a CPU.

All that lies between the layers of a minibatch is many times larger than a CPU's cache, and waiting
for memory takes most of the time. So forward and backward go through the minibatch in pieces that
the cache holds; the gradients of the weights are added up on the way.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array

LAYERS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))  # features, width of the kernel, stride
PICTURES = 8  # of a piece

Layer = tuple[Array, Array]  # kernel [K, K, C, F], bias [F]


@jax.custom_vjp
def convolutions(layers: list[Layer], x: Array) -> Array:
    """`[B, H, W, C]` -> `[B, H', W', 64]`: each of `LAYERS`, and a ReLU.

    uint8 pictures are scaled to [0, 1]. Without a gradient, XLA's own convolution is faster.
    """

    def piece(x: Array) -> Array:
        if x.dtype == jnp.uint8:
            x = x.astype(jnp.float32) / 255.0
        for (kernel, bias), (_, _, stride) in zip(layers, LAYERS, strict=True):
            x = jnp.maximum(plain_convolution(kernel, x, stride) + bias, 0.0)
        return x

    return joined(jax.lax.map(piece, in_pieces(x)), len(x))


def plain_convolution(kernel: Array, x: Array, stride: int) -> Array:
    """A VALID convolution `[B, H, W, C]` -> `[B, H', W', F]` by XLA."""
    axes = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (stride,) * 2, "VALID", dimension_numbers=axes)


def _forward(layers: list[Layer], x: Array) -> tuple[Array, tuple[list[Layer], Array, list[Array]]]:
    def piece(x: Array) -> list[Array]:
        outputs = []
        for (kernel, bias), (_, _, stride) in zip(layers, LAYERS, strict=True):
            x = jnp.maximum(convolution(kernel, bias, x, stride), 0.0)
            outputs.append(x)
        return outputs

    outputs = jax.lax.map(piece, in_pieces(x))
    return joined(outputs[-1], len(x)), (layers, x, outputs)


def _backward(
    saved: tuple[list[Layer], Array, list[Array]], cotangent: Array
) -> tuple[list[Layer], Array | None]:
    layers, x, outputs = saved
    has_gradient = jnp.issubdtype(x.dtype, jnp.floating)  # bytes have none

    def piece(total: list[Layer], of: tuple[Array, list[Array], Array]) -> tuple[list[Layer], Any]:
        x, outputs, d = of
        gradients: list[Layer] = []
        for i in reversed(range(len(LAYERS))):
            d = jnp.where(outputs[i] > 0, d, 0.0)
            layer = partial(convolution, stride=LAYERS[i][2])
            _, pull = jax.vjp(layer, *layers[i], outputs[i - 1] if i else x)
            of_kernel, of_bias, d = pull(d)
            gradients.insert(0, (of_kernel, of_bias))
        return jax.tree.map(jnp.add, total, gradients), d if has_gradient else ()

    zeros = jax.tree.map(jnp.zeros_like, layers)
    pieces = (in_pieces(x), outputs, in_pieces(cotangent))
    total, of_x = jax.lax.scan(piece, zeros, pieces)
    return total, joined(of_x, len(x)) if has_gradient else None


convolutions.defvjp(_forward, _backward)


def in_pieces(x: Array) -> Array:
    """`[B, ...]` -> `[B / PICTURES, PICTURES, ...]`, filled up with zeros; elsewhere one piece."""
    size = min(PICTURES, len(x)) if jax.default_backend() == "cpu" else len(x)
    filled = jnp.pad(x, [(0, -len(x) % size)] + [(0, 0)] * (x.ndim - 1))
    return filled.reshape(-1, size, *x.shape[1:])


def joined(pieces: Array, length: int) -> Array:
    """What `in_pieces` made of `[length, ...]`."""
    return pieces.reshape(-1, *pieces.shape[2:])[:length]


def convolution(kernel: Array, bias: Array, x: Array, stride: int) -> Array:
    """A VALID convolution `[B, H, W, C]` -> `[B, H', W', F]` as a few products of matrices.

    The picture is cut into blocks of `stride` x `stride` pixels, after which the kernel moves by
    one; then one product per row of the kernel. XLA's own convolution is many times slower than
    this on a CPU if a gradient is taken inside a loop, as in every update.

    Args:
      kernel: `[K, K, C, F]`, K a multiple of `stride`.
    """
    width, features = kernel.shape[0], kernel.shape[-1]
    across = width // stride  # blocks that the kernel covers
    blocks = into_blocks(x, width, stride)
    columns = blocks.shape[2] - across + 1
    beside = jnp.concatenate([blocks[:, :, j : j + columns] for j in range(across)], -1)
    if beside.dtype == jnp.uint8:
        beside = beside.astype(jnp.float32) / 255.0
    per_block = (across, stride, across, stride, -1, features)
    rows = kernel.reshape(per_block).transpose(0, 2, 1, 3, 4, 5).reshape(across, -1, features)
    height = blocks.shape[1] - across + 1
    return sum((beside[:, i : i + height] @ rows[i] for i in range(across)), start=bias)


def into_blocks(x: Array, kernel: int, stride: int) -> Array:
    """`[B, H, W, C]` -> `[B, H / stride, W / stride, stride * stride * C]`.

    Pixels that no step of the kernel reaches are cut off.
    """
    height, width = ((n - kernel) // stride * stride + kernel for n in x.shape[1:3])
    x = x[:, :height, :width].reshape(len(x), height // stride, stride, width // stride, -1)
    return x.transpose(0, 1, 3, 2, 4).reshape(len(x), height // stride, width // stride, -1)
