"""ONNX and numpy forms act as the policy does for each network that sees pictures."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from policy_forms import made, numpy_file, sampled
from policy_kinds import ACTIONS, PICTURES
from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.envs.shapes import leaves
from sauna.experiments.share.graph import Graph
from sauna.experiments.share.onnx_file import to_onnx
from sauna.experiments.share.same import check_same, onnx_policy
from sauna.system.errors import SaunaError

NUMBER = 6  # observations
FAST = (
    "mlp, combined",
    "nature-cnn, floats, channels first",
    "small-cnn, combined",
    "board of numbers, channels first",
)
EVERY = [kind if kind in FAST else pytest.param(kind, marks=pytest.mark.slow) for kind in PICTURES]


@cache
def policy_of(kind: str) -> tuple[FrozenPolicy, Graph]:
    return made(*PICTURES[kind])


@pytest.mark.parametrize("kind", EVERY)
def test_numpy_acts_as_the_policy(kind: str, tmp_path: Path) -> None:
    policy, graph = policy_of(kind)
    act, seen = numpy_file(graph, tmp_path), sampled(PICTURES[kind][0], NUMBER)
    check_same("numpy", policy, act, seen)
    assert len((tmp_path / "policy.py").read_text().splitlines()) <= 100


@pytest.mark.slow
@pytest.mark.parametrize("kind", PICTURES)
def test_onnx_acts_as_the_policy(kind: str) -> None:
    pytest.importorskip("onnxruntime", reason="needs `pip install 'sauna-rl[onnx]'`")
    policy, graph = policy_of(kind)
    act = onnx_policy(to_onnx(graph, kind), graph)
    check_same("onnx", policy, act, sampled(PICTURES[kind][0], NUMBER))


@pytest.mark.parametrize(
    "kind, keys",
    [
        pytest.param(kind, keys, marks=() if kind in FAST else pytest.mark.slow)
        for kind, (space, acted, _) in PICTURES.items()
        if acted is ACTIONS
        for keys, _ in leaves(space)
    ],
)
def test_a_form_that_sees_a_part_otherwise_is_refused(
    kind: str, keys: tuple[str, ...], tmp_path: Path
) -> None:
    """Each part of an observation counts: with one changed the actions are others."""
    policy, graph = policy_of(kind)
    act, seen = numpy_file(graph, tmp_path), sampled(PICTURES[kind][0], NUMBER)
    with pytest.raises(SaunaError, match="differs from the policy's by"):
        check_same("numpy", policy, lambda batch: act(changed(batch, keys)), seen)


def changed(batch: Any, keys: tuple[str, ...]) -> Any:
    """A batch with one part of each observation upside down; a choice is the next one."""
    if keys:
        return {**batch, keys[0]: changed(batch[keys[0]], keys[1:])}
    return (batch + 1) % 3 if batch.ndim == 1 else np.flip(batch, 1)
