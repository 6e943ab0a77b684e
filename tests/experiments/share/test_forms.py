"""ONNX and numpy forms act as the policy does, for each kind of numbers, network and action."""

from __future__ import annotations

import ast
import dataclasses
import json
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import flax.linen as nn
import numpy as np
import pytest
from gymnasium import spaces as gym

from helpers import configured
from policy_forms import made, numpy_file, sampled
from policy_kinds import BOX, VECTORS
from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.config.choices import ACTIVATIONS
from sauna.experiments.share.graph import Graph
from sauna.experiments.share.layers_graph import activated
from sauna.experiments.share.numpy_file import to_numpy
from sauna.experiments.share.onnx_file import to_onnx
from sauna.experiments.share.policy_graph import policy_graph
from sauna.experiments.share.same import check_same, numpy_policy, onnx_policy, stacked
from sauna.system.errors import BadInput, SaunaError

MANY = 1000  # observations


@cache
def policy_of(kind: str) -> tuple[FrozenPolicy, Graph, Any]:
    """A policy with random weights, the graph of it, and its observation space."""
    policy, graph = made(*VECTORS[kind])
    return policy, graph, VECTORS[kind][0]


@pytest.mark.parametrize("kind", VECTORS)
def test_numpy_acts_as_the_policy(kind: str, tmp_path: Path) -> None:
    policy, graph, space = policy_of(kind)
    act, seen = numpy_file(graph, tmp_path), sampled(space, MANY)
    check_same("numpy", policy, act, seen)
    policy.reset()
    assert len(np.unique(policy(stacked(seen)), axis=0)) > 1  # or nothing would be compared
    policy.reset()
    one = numpy_policy(tmp_path / "policy.py", graph)(seen[0])
    expected = policy(seen[0])
    np.testing.assert_allclose(one, expected, rtol=1e-5, atol=1e-5)
    assert np.shape(one) == np.shape(expected)
    assert len((tmp_path / "policy.py").read_text().splitlines()) <= 60


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_each_activation_is_flaxs(name: str, tmp_path: Path) -> None:
    graph, x = Graph(), np.linspace(-4, 4, 81, dtype=np.float32)[:, None]
    graph.input("observation", (), (1,), np.float32)
    graph.output("action", activated(graph, "observation", name), (1,), np.float32)
    np.testing.assert_allclose(
        numpy_file(graph, tmp_path)(x), getattr(nn, name)(x), rtol=1e-5, atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", VECTORS)
def test_onnx_acts_as_the_policy(kind: str) -> None:
    pytest.importorskip("onnxruntime", reason="needs `pip install 'sauna-rl[onnx]'`")
    policy, graph, space = policy_of(kind)
    for number in (MANY, 1):
        act = onnx_policy(to_onnx(graph, kind), graph)
        check_same("onnx", policy, act, sampled(space, number))


def test_a_form_that_acts_otherwise_is_refused(tmp_path: Path) -> None:
    policy, graph, space = policy_of("normalised, tanh, clipped")
    seen = sampled(space, 10)
    right, wrong = numpy_file(graph, tmp_path), np.array(seen) + 1e-3
    with pytest.raises(SaunaError, match="differs from the policy's by"):
        check_same("numpy", policy, lambda batch: right(wrong), seen)
    with pytest.raises(SaunaError, match=r"float64\[10, 2\], the policy's float32\[10, 2\]"):
        check_same("numpy", policy, lambda batch: policy(batch).astype(np.float64), seen)


def test_a_title_of_somebody_elses_ends_no_text(tmp_path: Path) -> None:
    _, graph, _ = policy_of("bits")
    text = to_numpy(graph, '"""\nraise SystemExit\n"""\\')
    (first, *_) = ast.parse(text).body
    assert isinstance(first, ast.Expr) and "raise SystemExit" in ast.get_docstring(ast.parse(text))


def test_a_network_of_ones_own_is_refused() -> None:
    config = dataclasses.replace(configured(), network="own_networks:Net")
    with pytest.raises(BadInput, match="network: own_networks:Net is code of your own"):
        policy_graph(config, {}, BOX, gym.Discrete(2))


def test_numpy_alone_runs_the_file(tmp_path: Path) -> None:
    policy, graph, space = policy_of("normalised, tanh, clipped")
    numpy_file(graph, tmp_path)
    seen = sampled(space, 3)
    code = (
        "import json, sys\n"
        "for name in ('jax', 'flax', 'gymnasium', 'sauna'): sys.modules[name] = None\n"
        "import policy\n"
        f"print(json.dumps(policy.act({np.array(seen).tolist()}).tolist()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    np.testing.assert_allclose(json.loads(done.stdout), policy(np.array(seen)), atol=1e-5)
