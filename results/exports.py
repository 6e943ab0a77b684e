"""Exports of every kind of policy, run where no trainer is installed: `results/exports.json`.

    python results/exports.py

Policies with random weights are written as `sauna export --numpy --onnx` writes them, with random
observations and our actions. An environment with numpy, safetensors and onnxruntime alone then runs
them (`results/play_exports.py`) and says how far its actions are from ours. Minutes of one core.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from play_exports import PACKAGES
from safetensors.numpy import save

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]
FILE = ROOT / "results" / "exports.json"
VECTORS, PICTURES = 1000, 50  # observations
STEPS, EPISODES = 200, 5  # of a policy that remembers: as many episodes at a time
ENDS = 0.05  # of the steps


def kinds() -> dict[str, tuple[Any, int]]:
    """What each policy is made of, and how many observations it gets."""
    import policy_kinds

    of_vectors = {kind: (made, VECTORS) for kind, made in policy_kinds.VECTORS.items()}
    return of_vectors | {kind: (made, PICTURES) for kind, made in policy_kinds.PICTURES.items()}


def write(folder: Path, kind: str, spaces_and_settings: Any, number: int) -> dict[str, int]:
    """Writes both forms, observations `[step, episode, ...]` and our actions there.

    Returns:
      how many observations there are, and how many different actions.
    """
    from policy_forms import made, sampled
    from sauna.experiments.share.numpy_file import to_numpy
    from sauna.experiments.share.onnx_file import to_onnx
    from sauna.experiments.share.same import stacked

    policy, graph = made(*spaces_and_settings)
    state = next((i for i in graph.inputs if i.argument == "state"), None)
    steps, episodes = (STEPS, EPISODES) if state else (1, number)
    seen = sampled(spaces_and_settings[0], steps * episodes)
    ended = np.random.default_rng(0).random((steps, episodes)) < ENDS
    parts = [i for i in graph.inputs if i is not state]
    expected, given = [], [[] for _ in parts]
    for t in range(steps):
        batch = stacked(seen[t * episodes : (t + 1) * episodes])
        policy.reset(ended[t])
        expected.append(np.asarray(policy(batch)))
        for part, arrays in zip(parts, given, strict=True):
            arrays.append(np.asarray(part_of(batch, part, graph.arguments), part.dtype))
    folder.mkdir(parents=True)
    (folder / "policy.py").write_text(to_numpy(graph, kind))
    (folder / "policy.safetensors").write_bytes(save(graph.constants))
    (folder / "policy.onnx").write_bytes(to_onnx(graph, kind))
    named = {f"part_{i}": np.stack(arrays) for i, arrays in enumerate(given)}
    np.savez(folder / "arrays.npz", ended=ended, expected=np.stack(expected), **named)
    case = {
        "kind": kind,
        "names": [part.name for part in parts],
        "places": [[part.argument, *part.keys] for part in parts],
        "state": [state.name, *state.shape] if state else [],
    }
    (folder / "case.json").write_text(json.dumps(case))
    actions = np.concatenate(expected).reshape(steps * episodes, -1)
    return {"observations": len(actions), "actions": len(np.unique(actions, axis=0))}


def part_of(batch: Any, part: Any, arguments: Iterable[str]) -> Any:
    """An input's arrays in a batch of observations, which masks may be beside."""
    value = batch[part.argument] if "action_mask" in arguments else batch
    for key in part.keys:
        value = value[key]
    return value


def environment(folder: Path) -> Path:
    """Makes an environment with the packages that exports need; returns its Python."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    versions = ["-c", str(ROOT / "constraints.txt")]
    install = ["-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    subprocess.run([str(python), *install, *versions, *PACKAGES], check=True)
    return python


def compared(folder: Path, python: Path) -> dict[str, Any]:
    """Writes every kind into a folder, and lets another Python run them."""
    numbers = {}
    for i, (kind, (spaces_and_settings, number)) in enumerate(kinds().items()):
        numbers[kind] = write(folder / f"{i:03d}", kind, spaces_and_settings, number)
    player = [str(python), "-I", str(Path(__file__).with_name("play_exports.py")), str(folder)]
    found = json.loads(subprocess.run(player, check=True, stdout=subprocess.PIPE).stdout)
    differences = found.pop("differences")
    rows = {kind: {**counted, **differences[kind]} for kind, counted in numbers.items()}
    return {**found, "kinds": rows}


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        python = environment(Path(place) / "environment")
        found = compared(Path(place) / "exports", python)
    FILE.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
