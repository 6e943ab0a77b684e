"""Whether an exported form of a policy acts as the policy does, tried before it is given away."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sauna.envs.host.answers import first_of, five_of
from sauna.experiments.share.graph import Graph
from sauna.system.errors import BadInput, SaunaError

Act = Callable[[Any], Any]
OBSERVATIONS = 100  # that are tried
TOLERANCE = 1e-5  # of an action, times its size if that is above 1


def observations_of(env: Any, number: int = OBSERVATIONS, seed: int = 0) -> list[Any]:
    """What an environment gives under random actions: `number` raw observations."""
    env.action_space.seed(seed)
    found: list[Any] = []
    ended = True
    while len(found) < number:
        if ended:
            observation, ended = first_of(env.reset(seed=seed + len(found))), False
        else:
            observation, _, terminated, truncated, _ = five_of(env.step(env.action_space.sample()))
            ended = bool(terminated or truncated)
        found.append(observation)
    return found


def stacked(seen: Sequence[Any]) -> Any:
    """Observations as one batch, part by part."""
    first = seen[0]
    if isinstance(first, Mapping):
        return {key: stacked([one[key] for one in seen]) for key in first}
    if isinstance(first, tuple):
        return tuple(stacked([one[i] for one in seen]) for i in range(len(first)))
    return np.stack([np.asarray(one) for one in seen])


def check_same(what: str, policy: Act, other: Act, seen: Sequence[Any]) -> None:
    """Refuses a form that acts otherwise.

    Args:
      what: its name, for the message.
      policy, other: a batch of observations -> the actions.

    Raises:
      SaunaError: with the largest difference.
    """
    batch = stacked(seen)
    expected, got = np.asarray(policy(batch)), np.asarray(other(batch))
    if expected.shape != got.shape or expected.dtype != got.dtype:
        raise SaunaError(
            f"{what}: its actions are {got.dtype}{list(got.shape)}, the policy's "
            f"{expected.dtype}{list(expected.shape)}"
        )
    difference = np.abs(expected.astype(np.float64) - got)
    if np.any(difference > TOLERANCE * np.maximum(1, np.abs(expected))):
        raise SaunaError(f"{what}: an action differs from the policy's by {difference.max():g}")


def onnx_policy(blob: bytes, graph: Graph) -> Act:
    """A model as a function of a batch of observations, by ONNX Runtime.

    Raises:
      BadInput: onnxruntime is not installed.
    """
    try:
        from onnxruntime import InferenceSession
    except ImportError as error:
        raise BadInput(f"onnx: {error}; pip install 'sauna-rl[onnx]'") from error
    session = InferenceSession(blob, providers=["CPUExecutionProvider"])

    def act(observation: Any) -> Any:
        given = {}
        for part in graph.inputs:
            value = observation
            for key in part.keys:
                value = value[key]
            given[part.name] = np.asarray(value, part.dtype)
        return session.run(None, given)[0]

    return act


def numpy_policy(path: Path) -> Act:
    """The function `act` of a file that `numpy_file` wrote just now."""
    spec = importlib.util.spec_from_file_location("exported_policy", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.act
