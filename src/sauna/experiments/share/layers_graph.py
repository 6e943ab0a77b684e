"""The layers of networks in a policy's graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sauna.config.settings import Config
from sauna.experiments.share.graph import Graph

Arrays = Mapping[str, np.ndarray]
ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu", "sigmoid": "Sigmoid"}  # of one operation
SELU = 1.0507009873554805, 1.6732632423543772  # scale and alpha (Klambauer et al. 2017)
NORM_EPSILON = 1e-6  # of flax's LayerNorm


def dense(graph: Graph, arrays: Arrays, x: str, name: str) -> str:
    """One linear layer, whose parameters are `name`: `[B, I]` -> `[B, O]`."""
    kernel = graph.constant(f"{name}/kernel", arrays[f"params/{name}/kernel"])
    bias = graph.constant(f"{name}/bias", arrays[f"params/{name}/bias"])
    return graph.add("Gemm", x, kernel, bias)


def mlp(graph: Graph, arrays: Arrays, x: str, trunk: str, config: Config) -> str:
    """See `MLP`: `[B, D]` -> `[B, hidden[-1]]`."""
    for i in range(len(config.hidden)):
        x = dense(graph, arrays, x, f"{trunk}/layer_{i}")
        if config.layer_norm:
            name = f"{trunk}/norm_{i}"
            parts = [
                graph.constant(f"{name}/{part}", arrays[f"params/{name}/{part}"])
                for part in ("scale", "bias")
            ]
            x = graph.add("LayerNormalization", x, *parts, epsilon=NORM_EPSILON)
        x = activated(graph, x, config.activation)
    return x


def activated(graph: Graph, x: str, activation: str) -> str:
    """One of `choices.ACTIVATIONS`, as flax has it."""
    if activation in ACTIVATIONS:
        return graph.add(ACTIVATIONS[activation], x)
    if activation in ("silu", "swish"):
        return graph.add("Mul", x, graph.add("Sigmoid", x))
    if activation == "leaky_relu":
        return graph.add("Max", x, graph.add("Mul", x, number(graph, 0.01)))
    if activation == "gelu":  # in its form with a tanh
        cube = graph.add("Mul", graph.add("Mul", x, x), x)
        inner = graph.add("Add", x, graph.add("Mul", cube, number(graph, 0.044715)))
        inner = graph.add("Tanh", graph.add("Mul", inner, number(graph, (2 / np.pi) ** 0.5)))
        half = graph.add("Mul", x, number(graph, 0.5))
        return graph.add("Mul", half, graph.add("Add", inner, number(graph, 1.0)))
    scale, alpha = SELU if activation == "selu" else (1.0, 1.0)
    zero = number(graph, 0.0)
    below = graph.add("Sub", graph.add("Exp", graph.add("Min", x, zero)), number(graph, 1.0))
    below = graph.add("Mul", below, number(graph, alpha))
    x = graph.add("Add", graph.add("Max", x, zero), below)
    return graph.add("Mul", x, number(graph, scale))


def number(graph: Graph, value: float) -> str:
    """A float32 constant, named by its value."""
    name = f"number/{value:g}"
    if name not in graph.constants:
        graph.constant(name, np.float32(value))
    return name


def cast(graph: Graph, x: str, before: str, after: str) -> str:
    """The value as another type, if it is another one."""
    return x if before == after else graph.add("Cast", x, to=after)


def between(graph: Graph, x: str, low: Any, high: Any, name: str) -> str:
    """The value within bounds, which are constants under `name`."""
    low, high = graph.constant(f"{name}/low", low), graph.constant(f"{name}/high", high)
    return graph.add("Min", graph.add("Max", x, low), high)
