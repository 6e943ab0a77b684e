"""Every kind of policy: of observations, networks and actions, each at least once."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from gymnasium import spaces as gym

from sauna.envs.masked import MaskedSpace

INF = np.inf
BOX = gym.Box(-INF, INF, (5,))
BOUNDED = gym.Box(np.array([-2, -INF, 0], np.float32), np.array([3, INF, 0.5], np.float32))
FINITE = gym.Box(np.array([-2, 1], np.float32), np.array([3, 1.5], np.float32))
NESTED = gym.Dict(
    {
        "b": gym.Box(-1, 1, (2, 2), np.float64),
        "a": gym.Tuple([gym.Discrete(3, start=-1), gym.MultiDiscrete([2, 3])]),
        "it's": gym.MultiBinary(2),
    }
)
# Each kind of observation, network and action at least once: (observations, actions, settings).
VECTORS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "normalised, tanh, clipped": (BOX, gym.Box(-0.3, 0.3, (2,)), {"normalize": True}),
    "stretched": (BOX, BOUNDED, {"rescale_actions": True, "activation": "relu"}),
    "float64, shaped box": (
        gym.Box(-1, 1, (2, 3), np.float64),
        gym.Box(-9, 9, (1, 2), np.float64),
        {"normalize": True, "trunk": "shared"},
    ),
    "squashed": (BOX, FINITE, {"distribution": "squashed", "rescale_actions": True}),
    "beta": (BOX, FINITE, {"distribution": "beta", "rescale_actions": True}),
    "gsde": (BOX, FINITE, {"distribution": "gsde", "rescale_actions": True, "normalize": True}),
    "gelu, layer norm": (
        BOX,
        FINITE,
        {"hidden": (8,), "activation": "gelu", "layer_norm": True},
    ),
    "masked": (
        MaskedSpace(BOX, gym.MultiDiscrete([2, 4])),
        gym.MultiDiscrete([2, 4]),
        {"normalize": True, "action_mask": True},
    ),
    "masked, one choice": (
        MaskedSpace(BOX, gym.Discrete(4, start=1)),
        gym.Discrete(4, start=1),
        {"action_mask": True},
    ),
    "lstm": (BOX, FINITE, {"recurrent": "lstm", "recurrent_width": 4, "normalize": True}),
    "gru": (
        gym.Discrete(4),
        FINITE,
        {"recurrent": "gru", "recurrent_width": 4, "trunk": "shared"},
    ),
    "one choice": (gym.Discrete(4), gym.Discrete(3, start=2), {"hidden": (8,)}),
    "nested, choices": (NESTED, gym.MultiDiscrete([2, 4]), {"normalize": True}),
    "bits": (gym.MultiDiscrete([3, 2]), gym.MultiBinary(3), {}),
    "board, flattened": (gym.Box(0, 4, (3, 3, 2), np.uint8), gym.Discrete(4), {}),
}

ACTIONS = gym.Box(-np.inf, np.inf, (3,))
CHOICES = gym.MultiDiscrete([2, 4])
NUMBERS = gym.Box(-np.inf, np.inf, (3,))
CAMERA = gym.Box(0, 255, (36, 37, 2), np.uint8)
SCREEN = gym.Box(0, 7, (2, 37, 36), np.uint8)
SEEN: dict[str, tuple[Any, dict[str, Any]]] = {
    "bytes": (CAMERA, {"trunk": "shared"}),
    "bytes, channels first": (SCREEN, {}),
    "floats": (gym.Box(0, 1, (37, 36)), {}),
    "floats, channels first": (gym.Box(0, 1, (2, 36, 37), np.float64), {"trunk": "shared"}),
    "combined": (
        gym.Dict({"a": SCREEN, "b": NUMBERS, "c": CAMERA, "d": gym.Discrete(3)}),
        {"normalize": True, "activation": "relu"},
    ),
}
NETWORKS = ("mlp", "nature-cnn", "small-cnn", "impala-cnn")
# Of observations, actions and settings.
PICTURES: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    f"{network}, {form}": (space, ACTIONS, {"network": network, **settings})
    for network, (form, (space, settings)) in itertools.product(NETWORKS, SEEN.items())
}
PICTURES |= {
    "board of numbers": (
        gym.Box(-2, 2, (4, 5)),
        ACTIONS,
        {"network": "small-cnn", "normalize": True},
    ),
    "board of numbers, channels first": (
        gym.Box(-2, 2, (2, 5, 6), np.float64),
        ACTIONS,
        {"network": "impala-cnn", "normalize": True, "trunk": "shared"},
    ),
    "picture alone in a Dict": (gym.Dict({"a": CAMERA}), ACTIONS, {"network": "small-cnn"}),
    "board of bytes, masked": (
        MaskedSpace(gym.Box(0, 3, (4, 5, 2), np.uint8), CHOICES),
        CHOICES,
        {"network": "small-cnn", "action_mask": True},
    ),
    "combined, masked, lstm": (
        MaskedSpace(gym.Dict({"a": SCREEN, "b": NUMBERS}), CHOICES),
        CHOICES,
        {
            "network": "small-cnn",
            "action_mask": True,
            "normalize": True,
            "recurrent": "lstm",
            "recurrent_width": 4,
        },
    ),
}
