"""A convolution of pictures and its gradient on a CPU, as products of matrices.

The pixels under each position of the kernel become one row of a matrix of patches (Chellapilla et
al. 2006). BLAS multiplies it with the kernel. A few pictures take their turn at a time, so that
their patches stay in the cache.

A compiled JAX program calls these functions by XLA's foreign function interface (`jax.ffi`). XLA
hands over one pointer, to a call frame that names the buffers. The positions below are those of
`xla/ffi/api/c_api.h` of jaxlib 0.5 to 0.10, all of major version 0.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from sauna.system.compiled import compiled

FORWARD, BACKWARD = "sauna_convolve", "sauna_convolve_back"
PATCHES = 200_000  # numbers that the cache holds

MAJOR = 0  # version of the interface; its minor versions leave the positions as they are
EXTENSION, INTERFACE, ARGUMENTS, RESULTS = 1, 2, 9, 14  # of a call frame, in words of 8 bytes
INTERFACE_VERSION = 4  # of the interface: the major version in the low half of the word
METADATA = 3  # of an extension
VERSIONS, TRAITS = 3, 4  # of the metadata
DATA, SHAPE = 3, 5  # of a buffer


@functools.cache
def register() -> None:
    """Lets compiled programs of this process call `FORWARD` and `BACKWARD`."""
    for name, function in ((FORWARD, forward), (BACKWARD, backward)):
        compiled_for_c = numba.cfunc(types.int64(types.CPointer(types.int64)), cache=True)(function)
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(compiled_for_c.ctypes))
        _kept.append(compiled_for_c)


_kept: list[Any] = []  # whose machine code must stay


@compiled
def convolve(kernel: Any, bias: Any, x: Any, stride: int, rectified: int, out: Any) -> None:
    """Writes `out[B, H', W', F]`: the convolution of x `[B, H, W, C]` without a border.

    Args:
      kernel: `[K, K, C, F]`; bias: `[F]`.
      rectified: whether what is negative becomes 0.
    """
    width, features = kernel.shape[0], kernel.shape[3]
    inputs = width * width * kernel.shape[2]
    count, pixels = out.shape[0], out.shape[1] * out.shape[2]
    weights, output = kernel.reshape(inputs, features), out.reshape(count * pixels, features)
    pictures = of_a_turn(pixels * inputs, count)
    patches = np.empty((pictures * pixels, inputs), np.float32)
    for first in range(0, count, pictures):
        last = min(first + pictures, count)
        unfold(x, first, last, width, stride, out.shape[1], out.shape[2], patches)
        rows = output[first * pixels : last * pixels]
        np.dot(patches[: len(rows)], weights, rows)
        for i in range(len(rows)):
            for j in range(features):
                value = rows[i, j] + bias[j]
                rows[i, j] = max(value, np.float32(0.0)) if rectified else value


@compiled
def convolve_back(
    kernel: Any,
    x: Any,
    out: Any,
    cotangent: Any,
    stride: int,
    rectified: int,
    of_kernel: Any,
    of_bias: Any,
    of_x: Any,
) -> None:
    """Writes the gradients of `convolve` by its kernel, its bias and, unless it is empty, x."""
    width, features = kernel.shape[0], kernel.shape[3]
    inputs = width * width * kernel.shape[2]
    count, pixels = out.shape[0], out.shape[1] * out.shape[2]
    weights, total = kernel.reshape(inputs, features), of_kernel.reshape(inputs, features)
    output = out.reshape(count * pixels, features)
    arriving = cotangent.reshape(count * pixels, features)
    pictures = of_a_turn(pixels * inputs, count)
    patches = np.empty((pictures * pixels, inputs), np.float32)
    delta = np.empty((pictures * pixels, features), np.float32)
    part = np.empty((inputs, features), np.float32)
    total[:] = 0.0
    of_bias[:] = 0.0
    of_x[:] = 0.0
    for first in range(0, count, pictures):
        last = min(first + pictures, count)
        begin, n = first * pixels, (last - first) * pixels
        for i in range(n):
            for j in range(features):
                passes = output[begin + i, j] > 0.0 or not rectified
                delta[i, j] = arriving[begin + i, j] if passes else np.float32(0.0)
                of_bias[j] += delta[i, j]
        unfold(x, first, last, width, stride, out.shape[1], out.shape[2], patches)
        np.dot(patches[:n].T, delta[:n], part)
        for i in range(inputs):
            for j in range(features):
                total[i, j] += part[i, j]
        if of_x.size:
            np.dot(delta[:n], weights.T, patches[:n])
            fold(patches, first, last, width, stride, out.shape[1], out.shape[2], of_x)


@compiled
def of_a_turn(numbers: int, count: int) -> int:
    """How many of `count` pictures, each with patches of so many numbers, take a turn together."""
    return min(max(PATCHES // numbers, 1), count)


@compiled
def unfold(
    x: Any, first: int, last: int, width: int, stride: int, rows: int, columns: int, patches: Any
) -> None:
    """Writes the patches of the pictures from `first` on, one row for each position."""
    run = width * x.shape[3]  # numbers beside each other in a picture
    step = stride * x.shape[3]
    lines, numbers = x.reshape(x.shape[0] * x.shape[1], -1), patches.reshape(-1)
    for b in range(first, last):
        for i in range(rows):
            for k in range(width):
                line = lines[b * x.shape[1] + i * stride + k]
                begin = (((b - first) * rows + i) * columns * width + k) * run
                for j in range(columns):
                    to = numbers[begin + j * width * run : begin + (j * width + 1) * run]
                    of = line[j * step : j * step + run]
                    for c in range(run):
                        to[c] = of[c]


@compiled
def fold(
    patches: Any, first: int, last: int, width: int, stride: int, rows: int, columns: int, x: Any
) -> None:
    """Adds each row of `patches` to the pixels that `unfold` took it from."""
    run = width * x.shape[3]
    step = stride * x.shape[3]
    lines, numbers = x.reshape(x.shape[0] * x.shape[1], -1), patches.reshape(-1)
    for b in range(first, last):
        for i in range(rows):
            for k in range(width):
                line = lines[b * x.shape[1] + i * stride + k]
                begin = (((b - first) * rows + i) * columns * width + k) * run
                for j in range(columns):
                    of = numbers[begin + j * width * run : begin + (j * width + 1) * run]
                    to = line[j * step : j * step + run]
                    for c in range(run):
                        to[c] += of[c]


def _pointer_to(kind: Any) -> Any:
    """A function of compiled code that makes a pointer of an address."""

    @intrinsic
    def pointer(_: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(kind)(address), generate

    return pointer


words = _pointer_to(types.int64)
integers = _pointer_to(types.int32)
floats = _pointer_to(types.float32)


@compiled
def vector(address: Any) -> Any:
    """The buffer `[N]` at an address."""
    buffer = words(address)
    return numba.carray(floats(buffer[DATA]), words(buffer[SHAPE])[0])


@compiled
def pictures(address: Any) -> Any:
    """The buffer of four axes at an address."""
    buffer = words(address)
    sizes = words(buffer[SHAPE])
    return numba.carray(floats(buffer[DATA]), (sizes[0], sizes[1], sizes[2], sizes[3]))


@compiled
def asks_for_the_version(frame: Any) -> bool:
    """Whether XLA does not call yet, but asks what the function was written for; answers that."""
    if frame[EXTENSION] == 0:
        return False
    metadata = words(words(frame[EXTENSION])[METADATA])
    here = words(frame[INTERFACE])[INTERFACE_VERSION]
    metadata[VERSIONS] = here if np.int32(here) == MAJOR else MAJOR  # which XLA then refuses
    metadata[TRAITS] = 0
    return True


def forward(frame: Any) -> int:
    """`convolve` of kernel, bias, x and `[stride, rectified]` into the one result."""
    if not asks_for_the_version(frame):
        given, results = words(frame[ARGUMENTS]), words(frame[RESULTS])
        how = integers(words(given[3])[DATA])
        parts = pictures(given[0]), vector(given[1]), pictures(given[2])
        convolve(*parts, how[0], how[1], pictures(results[0]))
    return 0


def backward(frame: Any) -> int:
    """`convolve_back` of kernel, x, output, cotangent and `[stride, rectified]`."""
    if not asks_for_the_version(frame):
        given, results = words(frame[ARGUMENTS]), words(frame[RESULTS])
        how = integers(words(given[4])[DATA])
        parts = pictures(given[0]), pictures(given[1]), pictures(given[2]), pictures(given[3])
        gradients = pictures(results[0]), vector(results[1]), pictures(results[2])
        convolve_back(*parts, how[0], how[1], *gradients)
    return 0
