"""A convolution of pictures and its gradient on a CPU, as products of matrices.

The pixels under each position of the kernel become one row of a matrix of patches (Chellapilla et
al. 2006). BLAS multiplies it with the kernel. A few pictures take their turn at a time, so that
their patches stay in the cache.

A compiled JAX program calls these functions by XLA's foreign function interface (`jax.ffi`). XLA
hands over one pointer, to a call frame that names the buffers. The positions below are those of
`xla/ffi/api/c_api.h` in jaxlib 0.5.0, 0.6.2, 0.7.2, 0.8.3, 0.9.2 and 0.10.2. A minor version of
the interface leaves them as they are; XLA refuses to register these functions at another major one.
"""

from __future__ import annotations

import threading
from typing import Any

import jax
import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from sauna.system.compiled import compiled, compiled_for_c

FORWARD, BACKWARD = "sauna_convolve", "sauna_convolve_back"
PATCHES = 200_000  # numbers of the patches of a turn, which the cache holds

# Positions in words of 8 bytes.
EXTENSION, INTERFACE, ARGUMENTS, RESULTS = 1, 2, 9, 14  # in a call frame
VERSION = 4  # in the interface: its major version in the low half of the word, its minor one above
KIND, METADATA = 1, 3  # in an extension
ANSWER, TRAITS = 3, 4  # in the metadata: the version, as above, and what the function promises
DATA, SHAPE = 3, 5  # in a buffer

MAJOR = 0  # version of the interface with these positions
OLDEST = 1 << 32  # version 0.1: that of jaxlib 0.5 to 0.7, which name none when they ask
ASKS = 1  # kind of an extension that asks for the metadata

_registered: dict[str, Any] = {}  # the functions, whose machine code must stay
_one_at_a_time = threading.Lock()


def register() -> None:
    """Lets compiled programs of this process call `FORWARD` and `BACKWARD`."""
    signature = types.int64(types.CPointer(types.int64))
    with _one_at_a_time:
        for name, function in ((FORWARD, forward), (BACKWARD, backward)):
            if name not in _registered:
                for_c = compiled_for_c(signature, function)
                jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(for_c.ctypes))
                _registered[name] = for_c


@compiled
def convolve(kernel: Any, bias: Any, x: Any, stride: int, rectified: int, out: Any) -> None:
    """Writes the convolution of x `[B, H, W, C]` without a border into out `[B, H', W', F]`.

    Args:
      kernel: `[K, K, C, F]`; bias: `[F]`.
      stride: by how many pixels the kernel moves.
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
        exchange(x, first, last, width, stride, *out.shape[1:3], patches, False)
        rows = output[first * pixels : last * pixels]
        np.dot(patches[: len(rows)], weights, rows)
        for i in range(len(rows)):
            for j in range(features):
                value = rows[i, j] + bias[j]
                rows[i, j] = np.float32(0.0) if rectified and value < 0.0 else value  # NaN stays


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
    """Writes the gradients of `convolve` by its kernel, its bias and its x.

    Args:
      out, cotangent: `[B, H', W', F]`, what `convolve` wrote, and its gradient.
      of_kernel: `[K, K, C, F]`; of_bias: `[F]`.
      of_x: `[B, H, W, C]`, or an empty array, which takes no gradient.
    """
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
    sums = np.zeros(features)  # double: of each position of each picture
    total[:] = 0.0
    of_x[:] = 0.0
    for first in range(0, count, pictures):
        last = min(first + pictures, count)
        begin, n = first * pixels, (last - first) * pixels
        for i in range(n):
            for j in range(features):
                passes = output[begin + i, j] > 0.0 or not rectified
                delta[i, j] = arriving[begin + i, j] if passes else np.float32(0.0)
                sums[j] += delta[i, j]
        exchange(x, first, last, width, stride, *out.shape[1:3], patches, False)
        np.dot(patches[:n].T, delta[:n], part)
        for i in range(inputs):
            for j in range(features):
                total[i, j] += part[i, j]
        if of_x.size:
            np.dot(delta[:n], weights.T, patches[:n])
            exchange(of_x, first, last, width, stride, *out.shape[1:3], patches, True)
    of_bias[:] = sums


@compiled
def of_a_turn(numbers: int, count: int) -> int:
    """How many of `count` pictures, each with patches of so many numbers, take a turn together."""
    return max(min(PATCHES // numbers, count), 1)


@compiled
def exchange(
    x: Any,
    first: int,
    last: int,
    width: int,
    stride: int,
    rows: int,
    columns: int,
    patches: Any,
    back: bool,
) -> None:
    """Copies pixels of x to `patches`, a row for each position of the kernel from picture `first`
    on; `back`: adds each row to the pixels that it is taken from.

    Args:
      x: `[B, H, W, C]`.
      width: K, the kernel's; rows, columns: H' and W', how many positions there are.
      patches: `[(last - first) * H' * W', K * K * C]`, or more rows, which stay as they are.
    """
    run = width * x.shape[3]  # numbers beside each other in a picture
    step = stride * x.shape[3]
    lines, numbers = x.reshape(x.shape[0] * x.shape[1], -1), patches.reshape(-1)
    for b in range(first, last):
        for i in range(rows):
            for k in range(width):
                line = lines[b * x.shape[1] + i * stride + k]
                begin = (((b - first) * rows + i) * columns * width + k) * run
                for j in range(columns):
                    patch = numbers[begin + j * width * run : begin + (j * width + 1) * run]
                    pixels = line[j * step : j * step + run]
                    if back:
                        for c in range(run):
                            pixels[c] += patch[c]
                    else:
                        for c in range(run):
                            patch[c] = pixels[c]


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
    extension = words(frame[EXTENSION])
    if frame[EXTENSION] == 0 or np.int32(extension[KIND]) != ASKS:
        return False
    here = words(frame[INTERFACE])[VERSION] if frame[INTERFACE] else OLDEST
    metadata = words(extension[METADATA])
    metadata[ANSWER] = here if np.int32(here) == MAJOR else OLDEST  # which XLA then refuses
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
