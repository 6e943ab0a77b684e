"""Runs exported policies with what they need: numpy and safetensors, or ONNX Runtime.

    python -I results/play_exports.py FOLDER

`results/exports.py` makes the folder. What is printed, as JSON: how far the actions of each policy
are from those expected, which packages ran them, and which of the trainer's can be imported.
"""

from __future__ import annotations

import importlib.util
import json
import platform
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = ("numpy", "safetensors", "onnxruntime")
OURS = ("sauna", "jax", "jaxlib", "flax", "optax", "gymnasium")

# The parts of a batch of observations and the state -> the actions and the next state.
Step = Callable[[list[np.ndarray], Any], tuple[np.ndarray, Any]]


def numpy_form(folder: Path, case: dict[str, Any]) -> Step:
    """The function `act` of `policy.py`."""
    spec = importlib.util.spec_from_file_location("policy", folder / "policy.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def step(parts: list[np.ndarray], state: Any) -> tuple[np.ndarray, Any]:
        given: dict[str, Any] = {}
        for (argument, *keys), part in zip(case["places"], parts, strict=True):
            _put(given, [argument, *keys], part)
        if not case["state"]:
            return module.act(**given), None
        return module.act(**given, state=state)

    return step


def _put(place: dict[Any, Any], keys: list[Any], value: Any) -> None:
    *above, last = keys
    for key in above:
        place = place.setdefault(key, {})
    place[last] = value


def onnx_form(folder: Path, case: dict[str, Any]) -> Step:
    """`policy.onnx`, by ONNX Runtime."""
    from onnxruntime import InferenceSession

    session = InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    name, size = case["state"] or ("", 0)

    def step(parts: list[np.ndarray], state: Any) -> tuple[np.ndarray, Any]:
        given = dict(zip(case["names"], parts, strict=True))
        if name:
            zeros = np.zeros((len(parts[0]), size), np.float32)
            given[name] = zeros if state is None else state
        actions, *following = session.run(None, given)
        return actions, following[0] if following else None

    return step


def largest(folder: Path, case: dict[str, Any], step: Step, is_single: bool) -> float:
    """The largest difference of an action from the one expected, over its size if above 1.

    Args:
      is_single: the form also takes one observation without the axis of a batch.
    """
    arrays = np.load(folder / "arrays.npz")
    parts = [arrays[f"part_{i}"] for i in range(len(case["names"]))]
    expected, ended = arrays["expected"], arrays["ended"]
    found, state = 0.0, None
    for t in range(len(expected)):
        if state is not None:
            state = np.where(ended[t][:, None], np.float32(0), state)
        actions, state = step([part[t] for part in parts], state)
        found = max(found, _difference(expected[t], actions))
    actions, _ = step([part[0, :1] for part in parts], None)
    found = max(found, _difference(expected[0, :1], actions))
    if is_single:
        action, _ = step([part[0, 0] for part in parts], None)
        found = max(found, _difference(expected[0, 0], np.asarray(action)))
    return found


def _difference(expected: np.ndarray, actions: np.ndarray) -> float:
    assert expected.shape == actions.shape and expected.dtype == actions.dtype
    apart = np.abs(expected.astype(np.float64) - actions)
    return float(np.max(apart / np.maximum(1, np.abs(expected)), initial=0))


def main() -> None:
    found: dict[str, Any] = {}
    for folder in sorted(Path(sys.argv[1]).iterdir()):
        case = json.loads((folder / "case.json").read_text())
        found[case["kind"]] = {
            "numpy": largest(folder, case, numpy_form(folder, case), True),
            "onnx": largest(folder, case, onnx_form(folder, case), False),
        }
    answer = {
        "differences": found,
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
        "trainers": [name for name in OURS if importlib.util.find_spec(name)],
    }
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
