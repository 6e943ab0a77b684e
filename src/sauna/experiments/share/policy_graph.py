"""The operations from a raw observation to the most likely action, for each kind of policy.

It says again what `FrozenPolicy` does, by `networks.py`, `distributions.py` and `spaces.py`; what
is exported is compared with that before it is given away.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sauna.algorithm.policy.convolutions import LAYERS
from sauna.algorithm.policy.normalize import EPSILON
from sauna.algorithm.policy.observation import INVALID
from sauna.algorithm.policy.recurrent import STATES
from sauna.config.choices import BOUNDED
from sauna.config.settings import Config
from sauna.envs.shapes import leaves, mask_in
from sauna.envs.spaces import Spaces, describe, stretch
from sauna.experiments.share.graph import Graph
from sauna.system.errors import BadInput

Arrays = Mapping[str, np.ndarray]
NETWORKS = ("mlp", "nature-cnn")
ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu", "sigmoid": "Sigmoid"}  # of one operation
COMPOSED = ("elu", "gelu", "leaky_relu", "selu", "silu", "swish")
SELU = 1.0507009873554805, 1.6732632423543772  # scale and alpha (Klambauer et al. 2017)
NORM_EPSILON = 1e-6  # of flax's LayerNorm


def policy_graph(
    config: Config, arrays: Arrays, observation_space: Any, action_space: Any
) -> Graph:
    """Writes down what a policy computes.

    Args:
      arrays: of one member, named as in a checkpoint without its name.
      observation_space, action_space: of the environment.

    Raises:
      BadInput: the policy is of a kind that cannot be exported.
    """
    mask, observation_space = mask_in(observation_space)
    graph, spaces = Graph(), describe(observation_space, action_space)
    _check(config, spaces)
    if spaces.observation_kind == "image":
        seen = _image(graph, config, spaces, observation_space)
    elif config.normalize_observations:
        seen = _vector(graph, observation_space, "float64")
        seen = _normalized(graph, arrays, seen, config.clip_observations)
    else:
        seen = _vector(graph, observation_space, "float32")
    trunk = "trunk" if config.trunk == "shared" else "policy_trunk"
    if config.network == "mlp":
        features = _mlp(graph, arrays, seen, trunk, config)
    else:
        features = _nature_cnn(graph, arrays, seen, trunk)
    state = ""
    if config.recurrent != "none":
        cell = "cell" if config.trunk == "shared" else "policy_cell"
        features, state = {"lstm": _lstm, "gru": _gru}[config.recurrent](
            graph, arrays, features, cell, config.recurrent_width
        )
    parameters = _dense(graph, arrays, features, "policy_head")
    if mask:
        parameters = _valid(graph, parameters, mask)
    if spaces.action_kind == "continuous" and config.distribution in BOUNDED:
        parameters = _bounded(graph, config.distribution, spaces.action_width, parameters)
    _action(graph, spaces, action_space, parameters, config.rescale_actions)
    if state:
        size = STATES[config.recurrent] * config.recurrent_width
        graph.output("next_state", state, (size,), np.float32)
    return graph


def _check(config: Config, spaces: Spaces) -> None:
    """Refuses what is not written here.

    Raises:
      BadInput: naming it.
    """
    unknown = ""
    if config.network not in NETWORKS:
        unknown = f"network {config.network}; only {' and '.join(NETWORKS)} are"
    elif config.recurrent not in ("none", *STATES):
        unknown = f"recurrent {config.recurrent}"
    elif config.network == "mlp" and config.activation not in (*ACTIVATIONS, *COMPOSED):
        unknown = f"activation {config.activation}"
    elif spaces.observation_kind not in ("vector", "one_hot", "image"):
        unknown = f"observations of kind {spaces.observation_kind}"
    elif spaces.pictures:
        unknown = "pictures beside other observations"
    if unknown:
        raise BadInput(f"export: not written as ONNX or numpy: {unknown}")


def _vector(graph: Graph, space: Any, dtype: str) -> str:
    """The observation as one vector `[B, obs]`, its parts in the order of `gym.flatten`."""
    parts = [_part(graph, keys, part, dtype) for keys, part in leaves(space)]
    return parts[0] if len(parts) == 1 else graph.add("Concat", *parts)


def _part(graph: Graph, keys: tuple[Any, ...], space: Any, dtype: str) -> str:
    """One part as floats `[B, n]`; numbers of choices become one-hot."""
    from gymnasium import spaces as gym

    number = len(graph.inputs)
    name = "observation" if not keys else f"observation_{number}"
    shape = tuple(space.shape or ())
    x = graph.input(name, keys, shape, space.dtype)
    size = int(np.prod(shape))
    if isinstance(space, gym.Discrete):
        values = np.arange(space.n) + space.start
        return _one_hot(graph, graph.add("Reshape", x, shape=(1,)), values, name, dtype)
    if isinstance(space, gym.MultiDiscrete):
        x, starts = graph.add("Reshape", x, shape=(size,)), np.ravel(getattr(space, "start", 0))
        starts = np.broadcast_to(starts, (size,))
        ones = [
            _one_hot(
                graph,
                graph.add("Slice", x, start=i, end=i + 1),
                np.arange(n) + starts[i],
                f"{name}_{i}",
                dtype,
            )
            for i, n in enumerate(space.nvec.ravel())
        ]
        return ones[0] if len(ones) == 1 else graph.add("Concat", *ones)
    if len(shape) != 1:
        x = graph.add("Reshape", x, shape=(size,))
    return _cast(graph, x, str(space.dtype), dtype)


def _cast(graph: Graph, x: str, before: str, after: str) -> str:
    return x if before == after else graph.add("Cast", x, to=after)


def _one_hot(graph: Graph, x: str, values: np.ndarray, name: str, dtype: str) -> str:
    known = graph.constant(f"{name}/values", values.astype(np.int64))
    return graph.add("Cast", graph.add("Equal", x, known), to=dtype)


def _normalized(graph: Graph, arrays: Arrays, x: str, clip: float) -> str:
    """`clip((x - mean) / sqrt(var + eps), +-clip)`, in float64 as `normalize`; then float32."""
    mean = graph.constant("normaliser/mean", arrays["observation_moments/mean"])
    variance = arrays["observation_moments/variance"]
    std = graph.constant("normaliser/std", (variance + EPSILON) ** 0.5)
    x = graph.add("Div", graph.add("Sub", x, mean), std)
    x = _between(graph, x, np.float64(-clip), np.float64(clip), "normaliser")
    return graph.add("Cast", x, to="float32")


def _between(graph: Graph, x: str, low: Any, high: Any, name: str) -> str:
    low, high = graph.constant(f"{name}/low", low), graph.constant(f"{name}/high", high)
    return graph.add("Min", graph.add("Max", x, low), high)


def _image(graph: Graph, config: Config, spaces: Spaces, space: Any) -> str:
    """A picture as floats in [0, 1]: a vector for an MLP, `[B, C, H, W]` for convolutions."""
    height, width, channels = spaces.observation_shape
    first = len(space.shape) == 3 and tuple(space.shape) != spaces.observation_shape
    x = graph.input("observation", (), tuple(space.shape), np.uint8)
    high = graph.constant("picture/high", np.float32(spaces.observation_high))
    x = graph.add("Div", graph.add("Cast", x, to="float32"), high)
    if config.network == "mlp":
        if first:
            x = graph.add("Transpose", x, perm=[0, 2, 3, 1])
        return graph.add("Reshape", x, shape=(height * width * channels,))
    if len(space.shape) == 2:
        return graph.add("Reshape", x, shape=(1, height, width))
    return x if first else graph.add("Transpose", x, perm=[0, 3, 1, 2])


def _dense(graph: Graph, arrays: Arrays, x: str, name: str) -> str:
    kernel = graph.constant(f"{name}/kernel", arrays[f"params/{name}/kernel"])
    bias = graph.constant(f"{name}/bias", arrays[f"params/{name}/bias"])
    return graph.add("Gemm", x, kernel, bias)


def _mlp(graph: Graph, arrays: Arrays, x: str, trunk: str, config: Config) -> str:
    for i in range(len(config.hidden)):
        x = _dense(graph, arrays, x, f"{trunk}/layer_{i}")
        if config.layer_norm:
            name = f"{trunk}/norm_{i}"
            parts = [
                graph.constant(f"{name}/{part}", arrays[f"params/{name}/{part}"])
                for part in ("scale", "bias")
            ]
            x = graph.add("LayerNormalization", x, *parts, epsilon=NORM_EPSILON)
        x = _activated(graph, x, config.activation)
    return x


def _activated(graph: Graph, x: str, activation: str) -> str:
    """One of `choices.ACTIVATIONS`, as flax has it."""
    if activation in ACTIVATIONS:
        return graph.add(ACTIVATIONS[activation], x)
    if activation in ("silu", "swish"):
        return graph.add("Mul", x, graph.add("Sigmoid", x))
    if activation == "leaky_relu":
        return graph.add("Max", x, graph.add("Mul", x, _number(graph, 0.01)))
    if activation == "gelu":  # in its form with a tanh
        cube = graph.add("Mul", graph.add("Mul", x, x), x)
        inner = graph.add("Add", x, graph.add("Mul", cube, _number(graph, 0.044715)))
        inner = graph.add("Tanh", graph.add("Mul", inner, _number(graph, (2 / np.pi) ** 0.5)))
        half = graph.add("Mul", x, _number(graph, 0.5))
        return graph.add("Mul", half, graph.add("Add", inner, _number(graph, 1.0)))
    scale, alpha = SELU if activation == "selu" else (1.0, 1.0)
    zero = _number(graph, 0.0)
    below = graph.add("Sub", graph.add("Exp", graph.add("Min", x, zero)), _number(graph, 1.0))
    below = graph.add("Mul", below, _number(graph, alpha))
    x = graph.add("Add", graph.add("Max", x, zero), below)
    return graph.add("Mul", x, _number(graph, scale))


def _number(graph: Graph, value: float) -> str:
    """A float32 constant, named by its value."""
    name = f"number/{value:g}"
    if name not in graph.constants:
        graph.constant(name, np.float32(value))
    return name


def _recurrent_products(
    graph: Graph, arrays: Arrays, x: str, cell: str, size: int, first: int
) -> tuple[str, str, str]:
    """The cell's products of its input and of h, and the state `[B, size]`; h begins at `first`."""
    state = graph.input("state", (), (size,), np.float32, "state")
    h = graph.add("Slice", state, start=first, end=size) if first else state
    kernel = graph.constant(f"{cell}/recurrent_kernel", arrays[f"params/{cell}/recurrent_kernel"])
    return _dense(graph, arrays, x, f"{cell}/input"), graph.add("MatMul", h, kernel), state


def _gates(graph: Graph, x: str, width: int, number: int) -> list[str]:
    return [graph.add("Slice", x, start=i * width, end=(i + 1) * width) for i in range(number)]


def _lstm(graph: Graph, arrays: Arrays, x: str, cell: str, width: int) -> tuple[str, str]:
    """h `[B, width]` after a step, and the state c beside h; see `recurrent.LSTM`."""
    inputs, of_h, state = _recurrent_products(graph, arrays, x, cell, 2 * width, width)
    i, f, g, o = _gates(graph, graph.add("Add", inputs, of_h), width, 4)
    kept = graph.add("Slice", state, start=0, end=width)
    kept = graph.add("Mul", graph.add("Sigmoid", f), kept)
    new = graph.add("Mul", graph.add("Sigmoid", i), graph.add("Tanh", g))
    c = graph.add("Add", kept, new)
    h = graph.add("Mul", graph.add("Sigmoid", o), graph.add("Tanh", c))
    return h, graph.add("Concat", c, h)


def _gru(graph: Graph, arrays: Arrays, x: str, cell: str, width: int) -> tuple[str, str]:
    """h `[B, width]` after a step, which is the state; see `recurrent.GRU`."""
    inputs, of_h, state = _recurrent_products(graph, arrays, x, cell, width, 0)
    r, z, n = _gates(graph, inputs, width, 3)
    of_r, of_z, of_n = _gates(graph, of_h, width, 3)
    z = graph.add("Sigmoid", graph.add("Add", z, of_z))
    bias = graph.constant(f"{cell}/recurrent_bias", arrays[f"params/{cell}/recurrent_bias"])
    reset = graph.add("Sigmoid", graph.add("Add", r, of_r))
    old = graph.add("Mul", reset, graph.add("Add", of_n, bias))
    n = graph.add("Tanh", graph.add("Add", n, old))
    rest = graph.add("Mul", graph.add("Sub", _number(graph, 1.0), z), n)
    h = graph.add("Add", rest, graph.add("Mul", z, state))
    return h, h


def _valid(graph: Graph, logits: str, mask: int) -> str:
    """The logits with those of masked actions at `INVALID`."""
    given = graph.input("action_mask", (), (mask,), np.int8, "action_mask")
    is_valid = graph.add("Greater", graph.add("Cast", given, to="float32"), _number(graph, 0.0))
    invalid = graph.constant("mask/invalid", np.float32(INVALID))
    return graph.add("Where", is_valid, logits, invalid)


def _nature_cnn(graph: Graph, arrays: Arrays, x: str, trunk: str) -> str:
    """`[B, C, H, W]` -> `[B, 512]`."""
    for i, (_, _, stride) in enumerate(LAYERS):
        name = f"{trunk}/conv_{i}"
        kernel = arrays[f"params/{name}/kernel"].transpose(3, 2, 0, 1)
        weights = graph.constant(f"{name}/kernel", kernel)
        bias = graph.constant(f"{name}/bias", arrays[f"params/{name}/bias"])
        x = graph.add("Relu", graph.add("Conv", x, weights, bias, strides=[stride, stride]))
    x = graph.add("Transpose", x, perm=[0, 2, 3, 1])
    size = arrays[f"params/{trunk}/dense/kernel"].shape[0]
    x = graph.add("Reshape", x, shape=(size,))
    return graph.add("Relu", _dense(graph, arrays, x, f"{trunk}/dense"))


def _bounded(graph: Graph, distribution: str, width: int, x: str) -> str:
    """The deterministic action in [-1, 1], of a distribution of `bounded.py`."""
    if distribution == "squashed":
        return graph.add("Tanh", x)
    one = graph.constant("beta/one", np.float32(1))
    both = graph.add("Add", graph.add("Softplus", x), one)
    a, b = (graph.add("Slice", both, start=i, end=i + width) for i in (0, width))
    return graph.add("Div", graph.add("Sub", a, b), graph.add("Add", a, b))


def _action(graph: Graph, spaces: Spaces, space: Any, parameters: str, rescale: bool) -> None:
    """The distribution's mode as the environment takes it; see `spaces.action_writer`."""
    shape = tuple(space.shape or ())
    if spaces.action_kind == "continuous":
        x = _in_box(graph, space, parameters, rescale)
        x = graph.add("Reshape", x, shape=shape) if len(shape) != 1 else x
    elif spaces.action_kind == "multi_binary":
        zero = graph.constant("action/zero", np.float32(0))
        x = graph.add("Cast", graph.add("Greater", parameters, zero), to=str(space.dtype))
    else:
        x = _choices(graph, spaces.action_sizes, parameters)
        starts = np.atleast_1d(np.asarray(getattr(space, "start", 0), np.int64))
        if starts.any():
            x = graph.add("Add", x, graph.constant("action/start", starts))
        x = graph.add("Reshape", x, shape=()) if spaces.action_kind == "discrete" else x
        x = graph.add("Cast", x, to=str(space.dtype))
    graph.output("action", x, shape, space.dtype)


def _choices(graph: Graph, sizes: tuple[int, ...], parameters: str) -> str:
    """The likeliest choice of each categorical, `[B, A]` int64."""
    if len(sizes) == 1:
        return graph.add("ArgMax", parameters)
    ends = np.cumsum(sizes)
    parts = [
        graph.add("ArgMax", graph.add("Slice", parameters, start=int(end - n), end=int(end)))
        for n, end in zip(sizes, ends, strict=True)
    ]
    return graph.add("Concat", *parts)


def _in_box(graph: Graph, space: Any, x: str, rescale: bool) -> str:
    """Clipped to a box, or stretched to it from [-1, 1]; `[B, A]` of the box's type."""
    low, high, dtype = space.low.ravel(), space.high.ravel(), str(space.dtype)
    stretched = stretch(space) if rescale else None
    if stretched is None:
        x = _between(graph, x, low.astype(np.float32), high.astype(np.float32), "action")
        return _cast(graph, x, "float32", dtype)
    bounded, center, half = stretched
    edge = np.where(bounded, 1.0, np.inf).astype(np.float32)
    x = graph.add("Cast", _between(graph, x, -edge, edge, "stretch"), to="float64")
    x = graph.add("Mul", x, graph.constant("stretch/half", half))
    x = graph.add("Add", x, graph.constant("stretch/center", center))
    return _between(graph, _cast(graph, x, "float64", dtype), low, high, "action")
