"""Pictures in a policy's graph: how one is read, and the networks that see it.

It says again what `networks.py`, `convolutions.py` and `pictures.py` of the policy do. Convolutions
see `[B, C, H, W]`, as ONNX has them; what they give is flattened as `[B, H, W, C]`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sauna.algorithm.policy.convolutions import LAYERS
from sauna.algorithm.policy.pictures import BLOCKS, SECTIONS
from sauna.envs.pictures import channels_first, channels_last, highest_byte, is_bytes
from sauna.experiments.share.graph import Graph
from sauna.experiments.share.layers_graph import Arrays, cast, dense


class Picture(NamedTuple):
    """A picture as floats: `value` `[B, *shape]`, with its axes in the environment's order."""

    value: str
    shape: tuple[int, ...]


def read_picture(graph: Graph, keys: tuple[Any, ...], space: Any) -> Picture:
    """Adds a picture that the environment gives. Its bytes are divided by their highest."""
    name = graph.name_of(keys)
    x = graph.input(name, keys, tuple(space.shape), space.dtype)
    x = cast(graph, x, str(space.dtype), "float32")
    if is_bytes(space):
        high = graph.constant(f"{name}/high", np.float32(highest_byte(space)))
        x = graph.add("Div", x, high)
    return Picture(x, tuple(space.shape))


def pixels(graph: Graph, picture: Picture) -> str:
    """A picture as one vector `[B, H * W * C]`."""
    x = picture.value
    if channels_first(picture.shape):
        x = graph.add("Transpose", x, perm=[0, 2, 3, 1])
    return graph.add("Reshape", x, shape=(math.prod(picture.shape),))


def convolved(graph: Graph, arrays: Arrays, picture: Picture, network: str, name: str) -> str:
    """What a network for pictures gives `[B, F]`; `name` is that of its parameters."""
    x, shape = picture
    if len(shape) == 2:
        x = graph.add("Reshape", x, shape=(1, *shape))
    elif not channels_first(shape):
        x = graph.add("Transpose", x, perm=[0, 3, 1, 2])
    if network == "nature-cnn":
        x = _nature(graph, arrays, x, name)
    elif network == "small-cnn":
        x = _small(graph, arrays, x, name)
    else:
        x = _impala(graph, arrays, x, name, *channels_last(shape)[:2])
    x = graph.add("Transpose", x, perm=[0, 2, 3, 1])
    size = arrays[f"params/{name}/dense/kernel"].shape[0]
    x = dense(graph, arrays, graph.add("Reshape", x, shape=(size,)), f"{name}/dense")
    return graph.add("Relu", x)


def _nature(graph: Graph, arrays: Arrays, x: str, name: str) -> str:
    """See `NatureCNN`."""
    for i, (_, _, stride) in enumerate(LAYERS):
        x = graph.add("Relu", _convolution(graph, arrays, x, f"{name}/conv_{i}", stride, pad=0))
    return x


def _small(graph: Graph, arrays: Arrays, x: str, name: str) -> str:
    """See `SmallCNN`; it takes every second pixel of its second layer."""
    for i in range(2):
        x = graph.add("Relu", _convolution(graph, arrays, x, f"{name}/conv_{i}", i + 1))
    return x


def _impala(graph: Graph, arrays: Arrays, x: str, name: str, height: int, width: int) -> str:
    """See `ImpalaCNN`."""
    for i in range(len(SECTIONS)):
        x = _convolution(graph, arrays, x, f"{name}/conv_{i}_0")
        x = graph.add("MaxPool", x, before=(height % 2, width % 2))  # flax's padding SAME
        height, width = math.ceil(height / 2), math.ceil(width / 2)
        for j in range(BLOCKS):
            first, second = (f"{name}/conv_{i}_{1 + 2 * j + k}" for k in range(2))
            inner = _convolution(graph, arrays, graph.add("Relu", x), first)
            inner = _convolution(graph, arrays, graph.add("Relu", inner), second)
            x = graph.add("Add", x, inner)
    return graph.add("Relu", x)


def _convolution(
    graph: Graph, arrays: Arrays, x: str, name: str, stride: int = 1, pad: int = 1
) -> str:
    """A square kernel that moves by `stride`, with `pad` zeros on each side of the picture."""
    kernel = arrays[f"params/{name}/kernel"].transpose(3, 2, 0, 1)
    weights = graph.constant(f"{name}/kernel", kernel)
    bias = graph.constant(f"{name}/bias", arrays[f"params/{name}/bias"])
    return graph.add("Conv", x, weights, bias, stride=stride, pad=pad)
