"""What a finished run offers: its newest good checkpoint and what that is of. No JAX here.

An exported policy offers the same: it is one member's part of one checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sauna.config.parsing import whole_number
from sauna.config.presets import RunConfig
from sauna.config.settings import Config
from sauna.config.stored import read_stored
from sauna.config.trust import check_trusted
from sauna.envs.spaces import Spaces, describe, difference, read_spaces
from sauna.envs.wrapping import wrapped_space, wrapping_of
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, nearest
from sauna.system.logs import check_logs
from sauna.system.safe_read import Untrusted

STATE = "policy.safetensors"  # of an exported policy
EXPORT_FORMAT = 1


class Artifact(NamedTuple):
    """A checkpoint of a run and what it is of."""

    run: RunConfig
    spaces: Spaces
    members: list[str]
    checkpoint: checkpoint.Checkpoint

    @property
    def config(self) -> Config:
        """What all members share."""
        return self.run.config

    @property
    def is_exported(self) -> bool:
        """Whether it is one policy alone, and no run."""
        return run_directory.is_exported(self.checkpoint.path)


def load_artifact(
    run: Path,
    warn: Callable[[str], None] = print,
    iteration: int | None = None,
    trust: bool = False,
) -> Artifact:
    """Reads a run's newest good checkpoint, or the one of an iteration; or an exported policy.

    Raises:
      BadInput: no run there, no checkpoint yet, none of that iteration, or one that names code of
        somebody else's, which `trust` allows.
      BadCheckpoint: none of its checkpoints can be trusted.
    """
    stored = run_directory.read_config(run, needed=(), exported=True)
    if run_directory.is_exported(run):
        if iteration is not None:
            raise BadInput(f"checkpoint: {run} is an exported policy, which has one alone")
        return _artifact(_exported(run, stored), stored, trust)
    if iteration is not None:
        iteration = whole_number("checkpoint", iteration, 0)
    kept = [int(path.name) for path in checkpoint.numbered(run / "checkpoints")]
    if iteration is None:
        loaded = _newest(run, warn)
    elif iteration not in kept:
        known = ", ".join(map(str, kept)) or "none"
        raise BadInput(f"checkpoint: {run} keeps none of iteration {iteration} (it has: {known})")
    else:
        loaded = checkpoint.load_checkpoint(run / "checkpoints" / f"{iteration:08d}")
    if loaded is None:
        raise BadInput(f"{run} has no checkpoint yet")
    return _artifact(loaded, stored, trust)


def _artifact(loaded: checkpoint.Checkpoint, stored: Mapping[str, Any], trust: bool) -> Artifact:
    """Reads what a checkpoint is of; `stored` carries the seal.

    Raises:
      BadInput: it names code of somebody else's.
      BadCheckpoint: it cannot be trusted.
    """
    check_trusted(loaded.manifest, str(loaded.path), stored.get("seal"), trust)
    try:
        spaces = read_spaces(loaded.manifest["spaces"])
    except (TypeError, ValueError, LookupError) as error:
        raise checkpoint.BadCheckpoint(f"{loaded.path}: its spaces cannot be read") from error
    members = loaded.manifest["members"]
    if not members or len(set(members)) < len(members):
        raise checkpoint.BadCheckpoint(f"{loaded.path}: its members are not named, each once")
    return Artifact(read_stored(loaded.manifest), spaces, members, loaded)


def _exported(path: Path, stored: dict[str, Any]) -> checkpoint.Checkpoint:
    """An exported policy as a checkpoint of one member.

    Raises:
      BadCheckpoint: a file is missing, cut short or changed.
      NewerFormat: only a newer version can read it.
    """
    kinds = {"format": int, "iteration": int, "env_steps": int, "bytes": int, "sha256": str}
    for name, kind in {**kinds, "members": list, "spaces": list}.items():
        if type(stored.get(name)) is not kind:
            raise checkpoint.BadCheckpoint(f"{path}: {name} is missing or of another type")
    if stored["format"] > EXPORT_FORMAT:
        raise checkpoint.NewerFormat(f"{path} is of a newer version of SAUNA")
    if len(stored["members"]) != 1 or type(stored["members"][0]) is not str:
        raise checkpoint.BadCheckpoint(f"{path}: it is not of one member")
    state = path / STATE
    try:
        arrays = checkpoint.load_arrays(state, stored["bytes"], stored["sha256"])
    except Untrusted as error:
        raise checkpoint.BadCheckpoint(f"{path}: {error}") from error
    named = {f"{stored['members'][0]}/{name}": array for name, array in arrays.items()}
    return checkpoint.Checkpoint(path, stored, named)


def _newest(run: Path, warn: Callable[[str], None]) -> checkpoint.Checkpoint | None:
    """The newest checkpoint that is good and whose rows are all there; else, the newest good one.

    Raises:
      BadCheckpoint: there are checkpoints, but none is good.
    """
    try:
        return checkpoint.load_newest(
            run / "checkpoints", warn, lambda manifest: check_logs(run, manifest)
        )
    except checkpoint.BadCheckpoint:
        loaded = checkpoint.load_newest(run / "checkpoints", lambda text: None)
        warn("warning: no checkpoint has all its rows; the newest one is used")
        return loaded


def best_of(artifact: Artifact, member: str) -> dict[str, Any]:
    """Finds the parameters and the normaliser of a member's best evaluation during training.

    Raises:
      BadInput: it was not evaluated during training.
    """
    found = checkpoint.under(f"{member}/best/", artifact.checkpoint.arrays)
    if not found and artifact.is_exported:
        raise BadInput(
            f"best: {artifact.checkpoint.path} is an exported policy, which is one alone"
        )
    if not found:
        raise BadInput(f"best: {member} was not evaluated during training; see --eval-every")
    return found


def policy_arrays(
    artifact: Artifact, name: str, best: bool, normalizer: str
) -> dict[str, np.ndarray]:
    """A member's parameters, and as much of its running statistics as is kept.

    Args:
      best: as they were at its best evaluation during training.
      normalizer: whose statistics: of observations and rewards (kept), observations, or none
        (fresh).

    Raises:
      BadInput: with `best`, it was not evaluated during training.
    """
    own = checkpoint.under(f"{name}/", artifact.checkpoint.arrays)
    policy = best_of(artifact, name) if best else own
    found = {key: a for key, a in policy.items() if key.startswith("params/")}
    if normalizer != "fresh":
        found |= {key: a for key, a in policy.items() if key.startswith("observation_moments/")}
    if normalizer == "kept":
        found |= _reward_moments(own)
    return found


def _reward_moments(own: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The running moments of rewards in float64, as the host has them."""
    found = {}
    for part in ("mean", "variance", "count"):
        name = f"reward_moments/{part}"
        if name in own:
            found[name] = own[name]
        elif f"collect/{name}" in own:
            lost = own.get(f"collect/{name}_lost", np.zeros(1))
            found[name] = own[f"collect/{name}"].astype(np.float64) + lost
    return found


def best_steps(artifact: Artifact, members: Sequence[str]) -> dict[str, int]:
    """Finds after how many env steps of training each member had its best evaluation.

    Raises:
      BadInput: one was not evaluated during training.
    """
    for member in members:
        best_of(artifact, member)
    arrays = artifact.checkpoint.arrays
    try:
        return {name: int(arrays[f"{name}/evaluation/best_env_steps"]) for name in members}
    except (KeyError, TypeError, ValueError) as error:
        raise checkpoint.BadCheckpoint(f"{artifact.checkpoint.path}: {error}") from error


def find_member(members: list[str], member: str | int) -> str:
    if not isinstance(member, str) or member.isdecimal():
        index = whole_number("member", member, 0)  # perhaps numpy's, such as of argmax
        if index >= len(members):
            raise BadInput(f"member: {index} is not between 0 and {len(members) - 1}")
        return members[index]
    if member not in members:
        raise BadInput(f"member: unknown member {member!r}{nearest(member, members)}")
    return member


def check_spaces(artifact: Artifact, env: Any) -> None:
    """Refuses an environment whose spaces are not the run's.

    Raises:
      BadInput: naming the space that differs.
    """
    space = wrapped_space(env, wrapping_of(artifact.config))
    found = describe(space, env.action_space)
    if differs := difference(artifact.spaces, found):
        raise BadInput(f"env: has other spaces than the run: {differs}")
