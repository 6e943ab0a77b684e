"""ONNX and numpy forms act as the policy does for each network that sees pictures."""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces as gym

from policy_forms import made, numpy_file, sampled
from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.envs.masked import MaskedSpace
from sauna.envs.shapes import leaves
from sauna.experiments.share.graph import Graph
from sauna.experiments.share.onnx_file import to_onnx
from sauna.experiments.share.same import check_same, onnx_policy
from sauna.system.errors import SaunaError

NUMBER = 6  # observations
ACTIONS = gym.Box(-np.inf, np.inf, (3,))
CHOICES = gym.MultiDiscrete([2, 4])
NUMBERS = gym.Box(-np.inf, np.inf, (3,))
CAMERA = gym.Box(0, 255, (36, 37, 2), np.uint8)
SCREEN = gym.Box(0, 7, (2, 37, 36), np.uint8)
PICTURES: dict[str, tuple[Any, dict[str, Any]]] = {
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
KINDS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    f"{network}, {form}": (space, ACTIONS, {"network": network, **settings})
    for network, (form, (space, settings)) in itertools.product(NETWORKS, PICTURES.items())
}
KINDS |= {
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
FAST = (
    "mlp, combined",
    "nature-cnn, floats, channels first",
    "small-cnn, combined",
    "board of numbers, channels first",
)
EVERY = [kind if kind in FAST else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]


@cache
def policy_of(kind: str) -> tuple[FrozenPolicy, Graph]:
    return made(*KINDS[kind])


@pytest.mark.parametrize("kind", EVERY)
def test_numpy_acts_as_the_policy(kind: str, tmp_path: Path) -> None:
    policy, graph = policy_of(kind)
    act, seen = numpy_file(graph, tmp_path), sampled(KINDS[kind][0], NUMBER)
    check_same("numpy", policy, act, seen)
    assert len((tmp_path / "policy.py").read_text().splitlines()) <= 100


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_onnx_acts_as_the_policy(kind: str) -> None:
    pytest.importorskip("onnxruntime", reason="needs `pip install 'sauna-rl[onnx]'`")
    policy, graph = policy_of(kind)
    act = onnx_policy(to_onnx(graph, kind), graph)
    check_same("onnx", policy, act, sampled(KINDS[kind][0], NUMBER))


@pytest.mark.parametrize(
    "kind, keys",
    [
        pytest.param(kind, keys, marks=() if kind in FAST else pytest.mark.slow)
        for kind, (space, acted, _) in KINDS.items()
        if acted is ACTIONS
        for keys, _ in leaves(space)
    ],
)
def test_a_form_that_sees_a_part_otherwise_is_refused(
    kind: str, keys: tuple[str, ...], tmp_path: Path
) -> None:
    """Each part of an observation counts: with one changed the actions are others."""
    policy, graph = policy_of(kind)
    act, seen = numpy_file(graph, tmp_path), sampled(KINDS[kind][0], NUMBER)
    with pytest.raises(SaunaError, match="differs from the policy's by"):
        check_same("numpy", policy, lambda batch: act(changed(batch, keys)), seen)


def changed(batch: Any, keys: tuple[str, ...]) -> Any:
    """A batch with one part of each observation upside down; a choice is the next one."""
    if keys:
        return {**batch, keys[0]: changed(batch[keys[0]], keys[1:])}
    return (batch + 1) % 3 if batch.ndim == 1 else np.flip(batch, 1)
