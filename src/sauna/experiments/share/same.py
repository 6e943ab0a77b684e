"""Whether an exported form of a policy acts as the policy does, tried before it is given away."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sauna.envs.host.answers import first_of, five_of
from sauna.envs.probe import any_action, each_observation
from sauna.experiments.share.graph import Graph
from sauna.system.errors import BadInput, SaunaError

Act = Callable[[Any], Any]
OBSERVATIONS = 100  # that are tried
TOLERANCE = 1e-5  # of an action, times its size if that is above 1


def observations_of(env: Any, number: int = OBSERVATIONS, seed: int = 0) -> list[Any]:
    """What an environment gives under random valid actions: `number` raw ones."""
    env.action_space.seed(seed)
    found: list[Any] = []
    ended = True
    while len(found) < number:
        if ended:
            observation, ended = first_of(env.reset(seed=seed + len(found))), False
        else:
            observation, _, terminated, truncated, _ = five_of(
                env.step(any_action(env, observation))
            )
            ended = bool(terminated or truncated)
        found += each_observation(env, observation)
    return found[:number]


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
    if hasattr(policy, "reset"):
        policy.reset()
    for batch in (stacked(seen), stacked(seen[::-1])):  # of a recurrent policy two steps
        _check_batch(what, np.asarray(policy(batch)), np.asarray(other(batch)))


def _check_batch(what: str, expected: np.ndarray, got: np.ndarray) -> None:
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

    return _Remembering(graph, lambda given: session.run(None, given)).act


def numpy_policy(path: Path, graph: Graph) -> Act:
    """The function `act` of a file that `numpy_file` wrote just now, with the state remembered."""
    spec = importlib.util.spec_from_file_location("exported_policy", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    is_masked, has_state = ("action_mask" in graph.arguments, "state" in graph.arguments)
    state: Any = None

    def act(observation: Any) -> Any:
        nonlocal state
        masks = [observation["action_mask"]] if is_masked else []
        inner = observation["observation"] if is_masked else observation
        if not has_state:
            return module.act(inner, *masks)
        action, state = module.act(inner, *masks, state=state)
        return action

    return act


class _Remembering:
    """A model as a function of a batch of observations, which gets its last state back."""

    def __init__(self, graph: Graph, run: Callable[[dict[str, Any]], list[Any]]) -> None:
        self._graph, self._run, self._state = graph, run, None

    def act(self, observation: Any) -> Any:
        inner, mask = observation, None
        if "action_mask" in self._graph.arguments:
            inner, mask = observation["observation"], observation["action_mask"]
        given: dict[str, Any] = {}
        for part in self._graph.inputs:
            value = {"observation": inner, "action_mask": mask, "state": self._state}[part.argument]
            for key in part.keys:
                value = value[key]
            if value is None:  # the state at an episode's start
                value = np.zeros((len(next(iter(given.values()))), *part.shape))
            given[part.name] = np.asarray(value, part.dtype)
        action, *state = self._run(given)
        self._state = state[0] if state else None
        return action
