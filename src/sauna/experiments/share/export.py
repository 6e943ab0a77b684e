"""`sauna export`: one trained policy as a folder that can be played, shared and deployed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from sauna.config.checks import is_read
from sauna.config.imported_from import names_the_folder
from sauna.config.parsing import whole_number
from sauna.config.plugins import provide
from sauna.config.settings import FIELDS, fields_with
from sauna.config.stored import to_stored
from sauna.config.trust import seal
from sauna.envs.host.answers import close
from sauna.envs.make import make_env
from sauna.envs.wrapping import wrapping_of
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.evaluate.episodes import statistics
from sauna.experiments.evaluate.play import Progress
from sauna.experiments.run_list import last_rows
from sauna.experiments.share.card import card
from sauna.experiments.share.numpy_file import to_numpy
from sauna.experiments.share.onnx_file import to_onnx
from sauna.experiments.share.policy_graph import policy_graph
from sauna.experiments.share.same import check_same, numpy_policy, observations_of, onnx_policy
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.system.safe_write import new_folder, write_durably
from sauna.system.working_folder import kept_folder
from sauna.training.artifact import (
    EXPORT_FORMAT,
    STATE,
    Artifact,
    best_steps,
    find_member,
    load_artifact,
    policy_arrays,
)
from sauna.training.located import locate

ONNX = "policy.onnx"
EPISODES, SEED = 20, 1000  # of the evaluation; not the episodes that `sauna eval` plays by itself


@names_the_folder
@kept_folder()
def export(
    run: str | Path,
    to: str | Path,
    *,
    member: str | int = 0,
    best: bool = False,
    onnx: bool = False,
    numpy: bool = False,
    episodes: int = EPISODES,
    seed: int = SEED,
    trust: bool = False,
    say: Callable[[str], None] = print,
    **parts: Any,
) -> Path:
    """Writes one member's policy as a folder: weights, normaliser, settings, a model card.

    `sauna.load`, `sauna.evaluate` and `init_from` take the folder as they take a run.

    Args:
      run: the run directory, or an exported policy.
      to: the folder, which must not be there or be empty.
      member: name (`sauna/0`) or index.
      best: as it was at its best evaluation during training.
      onnx: also `policy.onnx`, from the raw observation to the most likely action.
      numpy: also `numpy/policy.py` and its numbers, which need numpy and safetensors alone.
      episodes: that the card's return is of, with the most likely action; 0: none.
      seed: of the first episode.
      trust: the code that the run names may run, even if another user named it.
      say: receives a line about progress, and about checkpoints that cannot be trusted.
      **parts: those that were passed by value when the run started (`env`, ...).

    Returns:
      the folder.

    Raises:
      BadInput: no such run or member, a folder that holds something, a policy of a kind that cannot
        be written as asked; nothing was created.
    """
    folder = check_empty(Path.cwd() / to)
    episodes, seed = whole_number("episodes", episodes, 0), whole_number("seed", seed, 0)
    path = locate(run).folder
    artifact = load_artifact(path, say, trust=trust)
    name = find_member(artifact.members, member)
    if rest := provide(path, parts, fields_with("plugin")):
        raise BadInput(f"unknown argument {next(iter(rest))!r}")
    from sauna.experiments.evaluate.policy import TrainedPolicy  # imports JAX: after the checks

    config = artifact.config
    env = make_env(config.env, json.loads(config.env_kwargs), wrapping_of(config))
    try:
        policy = TrainedPolicy(artifact, name, env, best)
        blob = _state(artifact, name, best)
        manifest = _manifest(path, artifact, name, best)
        manifest |= {"sha256": hashlib.sha256(blob).hexdigest(), "bytes": len(blob)}
        manifest["env_spaces"] = [str(env.observation_space), str(env.action_space)]
        with ExitStack() as stack:
            try:
                new = stack.enter_context(new_folder(folder))
            except OSError as error:
                raise BadInput(f"to: cannot make {folder}: {error.strerror}") from error
            write_durably(new / STATE, blob)
            if onnx or numpy:
                _forms(new, artifact, policy, env, best, onnx, numpy)
            if episodes:
                manifest["evaluation"] = _played(policy, env, episodes, seed, say)
            whole = {**manifest, "seal": seal(manifest)}
            write_durably(new / run_directory.EXPORTED, json.dumps(whole, indent=1).encode())
            write_durably(new / "README.md", card(manifest, new).encode())
    finally:
        close(env)
    return folder


def check_empty(folder: Path) -> Path:
    """Refuses a folder that holds something.

    Raises:
      BadInput: it does, or is no folder.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise BadInput(f"to: {folder} is not empty")
    return folder


def _played(
    policy: Any, env: Any, episodes: int, seed: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Plays with the most likely actions, as `sauna eval --deterministic`."""
    from sauna.algorithm.rollout.play import play, success_rate

    progress = Progress(policy.name, episodes, say)
    played = [
        progress.played(play(policy, env, True, seed + i, progress.step, MAX_STEPS))
        for i in range(episodes)
    ]
    progress.say_cut(MAX_STEPS)
    return {"mode": "deterministic", "seed": seed, **statistics(played), **success_rate(played)}


def _manifest(run: Path, artifact: Artifact, name: str, best: bool) -> dict[str, Any]:
    """Says what the policy is and where it comes from; no path or machine of the user's."""
    before = artifact.checkpoint.manifest
    hidden = (*fields_with("machine_local"), "init_from")  # which may be a path of the user's
    usual = {field: FIELDS[field].default for field in hidden}
    if artifact.is_exported:
        steps, training = before["env_steps"], before.get("training", {})
    else:
        steps = _steps(artifact, name, best)
        training = _training(run, artifact)
    return {
        "format": EXPORT_FORMAT,
        **to_stored(artifact.run.replace(**usual)),
        "spaces": list(artifact.spaces),
        "members": [name],
        "iteration": before["iteration"],
        "env_steps": steps,
        "best": best,
        "versions": before.get("versions", {}),
        "training": training,
    }


def _steps(artifact: Artifact, name: str, best: bool) -> int:
    if best:
        return best_steps(artifact, [name])[name]
    return int(artifact.checkpoint.arrays[f"{name}/counters/env_steps"])


def _training(run: Path, artifact: Artifact) -> dict[str, Any]:
    """The run's revision, its beginning and how its members ended: the policy is one of them."""
    stored = run_directory.read_config(run)
    members = len(stored["config"].get("arm", [])) * len(stored["config"].get("seeds", []))
    last = last_rows(run / "metrics.jsonl", members)
    returns = {name: row["return_mean"] for name, row in last.items() if "return_mean" in row}
    found = {"git": stored.get("git"), "returns": dict(sorted(returns.items()))}
    if artifact.config.init_from:  # but not its path, which may be one of the user's
        found["began"] = "clone" if is_read("clone_epochs", artifact.config) else "weights"
    before = [one.get("steps") for one in stored.get("extended", []) if isinstance(one, dict)]
    if earlier := sorted({n for n in before if type(n) is int} - {artifact.config.steps}):
        found["steps_before"] = earlier
    return found


def _state(artifact: Artifact, name: str, best: bool) -> bytes:
    arrays = policy_arrays(artifact, name, best, normalizer="kept")
    return save({key: np.ascontiguousarray(array) for key, array in sorted(arrays.items())})


def _forms(
    folder: Path, artifact: Artifact, policy: Any, env: Any, best: bool, onnx: bool, numpy: bool
) -> None:
    """Writes the policy as ONNX and as numpy; each has to act as the policy does.

    Raises:
      BadInput: the policy is of a kind that cannot be written so.
      SaunaError: it acts otherwise.
    """
    arrays = policy_arrays(artifact, policy.name, best, normalizer="observations")
    graph = policy_graph(artifact.config, arrays, env.observation_space, env.action_space)
    title = f"The policy {policy.name} for {artifact.config.env}, trained by SAUNA."
    seen = observations_of(env)
    if onnx:
        blob = to_onnx(graph, title)
        check_same("onnx", policy, onnx_policy(blob, graph), seen)
        write_durably(folder / ONNX, blob)
    if numpy:
        (folder / "numpy").mkdir()
        write_durably(folder / "numpy" / STATE, save(graph.constants))
        write_durably(folder / "numpy" / "policy.py", to_numpy(graph, title).encode())
        check_same("numpy", policy, numpy_policy(folder / "numpy" / "policy.py", graph), seen)
