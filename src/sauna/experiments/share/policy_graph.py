"""The operations from a raw observation to the most likely action, for each kind of policy.

It says again what `FrozenPolicy` does, by `networks.py`, `distributions.py` and `spaces.py`; what
is exported is compared with that before it is given away.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sauna.algorithm.policy.normalize import EPSILON
from sauna.algorithm.policy.observation import INVALID
from sauna.algorithm.policy.recurrent import STATES
from sauna.config.choices import BOUNDED, NETWORKS
from sauna.config.settings import Config
from sauna.envs.actions import stretch
from sauna.envs.pictures import is_bytes, is_float_picture, is_picture
from sauna.envs.shapes import leaves, mask_in
from sauna.envs.spaces import Spaces, board_of, describe
from sauna.experiments.share.graph import Graph
from sauna.experiments.share.layers_graph import Arrays, between, cast, dense, mlp, number
from sauna.experiments.share.picture_graph import Picture, convolved, pixels, read_picture
from sauna.system.errors import BadInput


def policy_graph(
    config: Config, arrays: Arrays, observation_space: Any, action_space: Any
) -> Graph:
    """Writes down what a policy computes.

    Args:
      arrays: of one member, named as in a checkpoint without its name.
      observation_space, action_space: of the environment.

    Raises:
      BadInput: the network is code of the user's.
    """
    if config.network not in NETWORKS:
        raise BadInput(
            f"network: {config.network} is code of your own, which export does not write as ONNX "
            "or numpy; its weights are in policy.safetensors"
        )
    mask, observation_space = mask_in(observation_space)
    graph, spaces = Graph(), describe(observation_space, action_space)
    features = _trunk(graph, config, arrays, observation_space, spaces)
    state = ""
    if config.recurrent != "none":
        cell = "cell" if config.trunk == "shared" else "policy_cell"
        features, state = {"lstm": _lstm, "gru": _gru}[config.recurrent](
            graph, arrays, features, cell, config.recurrent_width
        )
    parameters = dense(graph, arrays, features, "policy_head")
    if mask:
        parameters = _valid(graph, parameters, mask)
    if spaces.action_kind == "continuous" and config.distribution in BOUNDED:
        parameters = _bounded(graph, config.distribution, spaces.action_width, parameters)
    _action(graph, spaces, action_space, parameters, config.rescale_actions)
    if state:
        size = STATES[config.recurrent] * config.recurrent_width
        graph.output("next_state", state, (size,), np.float32)
    return graph


def _trunk(graph: Graph, config: Config, arrays: Arrays, space: Any, spaces: Spaces) -> str:
    """The policy's features `[B, F]` of what the environment gives; see `make_trunk`."""
    name = "trunk" if config.trunk == "shared" else "policy_trunk"
    is_mlp = config.network == "mlp"
    numbers, pictures = _seen(graph, config, arrays, space)
    if not pictures and not is_mlp:  # numbers that are a small picture
        board = board_of(spaces)
        numbers, pictures = "", [Picture(graph.add("Reshape", numbers, shape=board), board)]

    def features(picture: Picture, name: str) -> str:
        if is_mlp:
            return pixels(graph, picture)
        return convolved(graph, arrays, picture, config.network, name)

    if spaces.is_combined:
        found = [features(picture, f"{name}/picture_{i}") for i, picture in enumerate(pictures)]
        x = graph.add("Concat", *filter(None, [numbers]), *found)
        return mlp(graph, arrays, x, f"{name}/{name}", config)
    x = features(pictures[0], name) if pictures else numbers
    return mlp(graph, arrays, x, name, config) if is_mlp else x


def _seen(graph: Graph, config: Config, arrays: Arrays, space: Any) -> tuple[str, list[Picture]]:
    """The numbers of an observation `[B, D]`, normalised, and its pictures.

    The numbers are in the order of `gym.flatten`. If there are none, their name is empty.
    """
    is_whole = is_bytes(space) or is_float_picture(space)
    dtype = "float64" if config.normalize_observations else "float32"
    parts: list[str] = []
    pictures: list[Picture] = []
    for keys, part in leaves(space):
        if is_whole or is_picture(part):
            pictures.append(read_picture(graph, keys, part))
        else:
            parts.append(_part(graph, keys, part, dtype))
    if not parts:
        return "", pictures
    numbers = parts[0] if len(parts) == 1 else graph.add("Concat", *parts)
    if config.normalize_observations:
        numbers = _normalized(graph, arrays, numbers, config.clip_observations)
    return numbers, pictures


def _part(graph: Graph, keys: tuple[Any, ...], space: Any, dtype: str) -> str:
    """One part as floats `[B, n]`; numbers of choices become one-hot."""
    from gymnasium import spaces as gym

    name, shape = graph.name_of(keys), tuple(space.shape or ())
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
    return cast(graph, x, str(space.dtype), dtype)


def _one_hot(graph: Graph, x: str, values: np.ndarray, name: str, dtype: str) -> str:
    known = graph.constant(f"{name}/values", values.astype(np.int64))
    return graph.add("Cast", graph.add("Equal", x, known), to=dtype)


def _normalized(graph: Graph, arrays: Arrays, x: str, clip: float) -> str:
    """`clip((x - mean) / sqrt(var + eps), +-clip)`, in float64 as `normalize`; then float32."""
    mean = graph.constant("normaliser/mean", arrays["observation_moments/mean"])
    variance = arrays["observation_moments/variance"]
    std = graph.constant("normaliser/std", (variance + EPSILON) ** 0.5)
    x = graph.add("Div", graph.add("Sub", x, mean), std)
    x = between(graph, x, np.float64(-clip), np.float64(clip), "normaliser")
    return graph.add("Cast", x, to="float32")


def _recurrent_products(
    graph: Graph, arrays: Arrays, x: str, cell: str, size: int, first: int
) -> tuple[str, str, str]:
    """The cell's products of its input and of h, and the state `[B, size]`; h begins at `first`."""
    state = graph.input("state", (), (size,), np.float32, "state")
    h = graph.add("Slice", state, start=first, end=size) if first else state
    kernel = graph.constant(f"{cell}/recurrent_kernel", arrays[f"params/{cell}/recurrent_kernel"])
    return dense(graph, arrays, x, f"{cell}/input"), graph.add("MatMul", h, kernel), state


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
    rest = graph.add("Mul", graph.add("Sub", number(graph, 1.0), z), n)
    h = graph.add("Add", rest, graph.add("Mul", z, state))
    return h, h


def _valid(graph: Graph, logits: str, mask: int) -> str:
    """The logits with those of masked actions at `INVALID`."""
    given = graph.input("action_mask", (), (mask,), np.int8, "action_mask")
    is_valid = graph.add("Greater", graph.add("Cast", given, to="float32"), number(graph, 0.0))
    invalid = graph.constant("mask/invalid", np.float32(INVALID))
    return graph.add("Where", is_valid, logits, invalid)


def _bounded(graph: Graph, distribution: str, width: int, x: str) -> str:
    """The deterministic action in [-1, 1], of a distribution of `bounded.py`."""
    if distribution == "squashed":
        return graph.add("Tanh", x)
    one = graph.constant("beta/one", np.float32(1))
    both = graph.add("Add", graph.add("Softplus", x), one)
    a, b = (graph.add("Slice", both, start=i, end=i + width) for i in (0, width))
    return graph.add("Div", graph.add("Sub", a, b), graph.add("Add", a, b))


def _action(graph: Graph, spaces: Spaces, space: Any, parameters: str, rescale: bool) -> None:
    """The distribution's mode as the environment takes it; see `actions.action_writer`."""
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
        x = between(graph, x, low.astype(np.float32), high.astype(np.float32), "action")
        return cast(graph, x, "float32", dtype)
    bounded, center, half = stretched
    edge = np.where(bounded, 1.0, np.inf).astype(np.float32)
    x = graph.add("Cast", between(graph, x, -edge, edge, "stretch"), to="float64")
    x = graph.add("Mul", x, graph.constant("stretch/half", half))
    x = graph.add("Add", x, graph.constant("stretch/center", center))
    return between(graph, cast(graph, x, "float64", dtype), low, high, "action")
