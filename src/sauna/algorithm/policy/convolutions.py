"""Convolutions of pictures without a border, and the Nature CNN's three (Mnih et al. 2015).

XLA has no fast convolution for a CPU if a gradient is taken inside a loop, as in every update. So
on a CPU a compiled function of our own takes its place.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.types import Array

LAYERS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))  # features, width of the kernel, stride

Layer = tuple[Array, Array]  # kernel [K, K, C, F], bias [F]


def convolutions(layers: list[Layer], x: Array, high: float = 255.0) -> Array:
    """`[B, H, W, C]` -> `[B, H', W', 64]`: each of `LAYERS`, and a ReLU."""
    for layer, (_, _, stride) in zip(layers, LAYERS, strict=True):
        x = convolution(*layer, x, stride, rectified=True, high=high)
    return x


def convolution(
    kernel: Array, bias: Array, x: Array, stride: int, rectified: bool = False, high: float = 255.0
) -> Array:
    """A convolution without a border, `[B, H, W, C]` -> `[B, H', W', F]`.

    Args:
      kernel: `[K, K, C, F]`; bias: `[F]`.
      x: numbers, or bytes, which are divided by `high` and have no gradient.
      stride: by how many pixels the kernel moves.
      rectified: whether a ReLU follows.
    """
    of_bytes = x.dtype == jnp.uint8
    x = x.astype(jnp.float32)
    if of_bytes:
        x = x / high
    if jax.default_backend() == "cpu":
        return _by_patches(kernel, bias, x, stride, rectified, not of_bytes)
    axes = ("NHWC", "HWIO", "NHWC")
    out = jax.lax.conv_general_dilated(x, kernel, (stride,) * 2, "VALID", dimension_numbers=axes)
    return jnp.maximum(out + bias, 0.0) if rectified else out + bias


@partial(jax.custom_vjp, nondiff_argnums=(3, 4, 5))
def _by_patches(
    kernel: Array, bias: Array, x: Array, stride: int, rectified: bool, of_x: bool
) -> Array:
    """`convolution` by `compiled_convolution`, whose buffers are float32.

    Args:
      of_x: whether x has a gradient.
    """
    side = [(n - kernel.shape[0]) // stride + 1 for n in x.shape[1:3]]
    out = jax.ShapeDtypeStruct((len(x), *side, kernel.shape[-1]), jnp.float32)
    return _call("FORWARD", out, (kernel, bias, x), stride, rectified)


def _call(which: str, results: Any, given: tuple[Array, ...], stride: int, rectified: bool) -> Any:
    """Calls `FORWARD` or `BACKWARD` of `compiled_convolution`; returns arrays like `results`."""
    from sauna.algorithm.policy import compiled_convolution  # and Numba, which takes a while

    compiled_convolution.register()
    name = getattr(compiled_convolution, which)
    call = jax.ffi.ffi_call(name, results, vmap_method="sequential")
    return call(*given, np.array([stride, rectified], np.int32))


def _forward(
    kernel: Array, bias: Array, x: Array, stride: int, rectified: bool, of_x: bool
) -> tuple[Array, tuple[Array, Array, Array]]:
    out = _by_patches(kernel, bias, x, stride, rectified, of_x)
    return out, (kernel, x, out)


def _backward(
    stride: int, rectified: bool, of_x: bool, saved: tuple[Array, Array, Array], cotangent: Array
) -> tuple[Array, Array, Array | None]:
    kernel, x, out = saved
    shapes = kernel.shape, kernel.shape[-1:], x.shape if of_x else (0,) * 4
    gradients = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    given = kernel, x, out, cotangent
    by_kernel, by_bias, by_x = _call("BACKWARD", gradients, given, stride, rectified)
    return by_kernel, by_bias, by_x if of_x else None


_by_patches.defvjp(_forward, _backward)
