"""Checkpoints: one safetensors file and a manifest with its SHA-256, written atomically.

    checkpoints/00000488/{state.safetensors, manifest.json}

The folder's number is the iteration that the state is at the start of. A checkpoint is written
beside its place, flushed to disk, and renamed; older ones are pruned only after that.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors.numpy import load, save

from sauna.errors import SaunaError

FORMAT = 1


class BadCheckpoint(SaunaError):
    """A checkpoint that cannot be trusted; the message names it and says why."""


class Checkpoint(NamedTuple):
    path: Path
    manifest: dict[str, Any]
    arrays: dict[str, np.ndarray]


def save_checkpoint(
    folder: Path, iteration: int, arrays: dict[str, np.ndarray], manifest: dict[str, Any], keep: int
) -> Path:
    """Writes `folder/ITERATION` atomically, then removes all but the newest `keep`."""
    final = folder / f"{iteration:08d}"
    blob = save(dict(sorted(arrays.items())))
    manifest = {
        "format": FORMAT,
        "iteration": iteration,
        "sha256": hashlib.sha256(blob).hexdigest(),
        "bytes": len(blob),
        **manifest,
    }
    manifest["manifest_sha256"] = _digest(manifest)
    if final.exists():
        if _holds(final, manifest["sha256"]):  # saved before the run was stopped here
            return final
        final.rename(_free_name(final))
    for left in folder.glob(".writing-*"):
        shutil.rmtree(left)
    temporary = folder / f".writing-{iteration:08d}"
    temporary.mkdir(parents=True)
    sync_folder(folder.parent)
    write_durably(temporary / "state.safetensors", blob)
    write_durably(temporary / "manifest.json", json.dumps(manifest, indent=1).encode())
    sync_folder(temporary)
    temporary.rename(final)
    sync_folder(folder)
    for old in numbered(folder)[:-keep]:
        shutil.rmtree(old)
    return final


def _digest(manifest: dict[str, Any]) -> str:
    """Of everything in a manifest but the digest itself."""
    rest = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _holds(path: Path, sha256: str) -> bool:
    """Whether a checkpoint is good and has these arrays."""
    try:
        return bool(load_checkpoint(path).manifest["sha256"] == sha256)
    except BadCheckpoint:
        return False


def _free_name(path: Path) -> Path:
    """Where a bad checkpoint is kept: `NUMBER.bad`, `NUMBER.bad2`, ..."""
    names = (path.with_name(f"{path.name}.bad{i or ''}") for i in [0, *range(2, 1000)])
    return next(name for name in names if not name.exists())


def write_durably(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def numbered(folder: Path) -> list[Path]:
    """The finished checkpoints of a run, oldest first."""
    return sorted(path for path in folder.glob("[0-9]" * 8) if path.is_dir())


def load_checkpoint(path: Path) -> Checkpoint:
    """A checkpoint whose bytes are those that were written.

    Raises:
      BadCheckpoint: a file is missing, cut short or changed, or of another format.
    """
    try:
        manifest = json.loads((path / "manifest.json").read_bytes())
        blob = (path / "state.safetensors").read_bytes()
    except (OSError, ValueError) as error:
        raise BadCheckpoint(f"{path}: cannot be read: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise BadCheckpoint(f"{path}: not a checkpoint of format {FORMAT}")
    if _digest(manifest) != manifest.get("manifest_sha256"):
        raise BadCheckpoint(f"{path}: manifest.json is not what was written (SHA-256 differs)")
    if path.name != f"{manifest['iteration']:08d}":
        raise BadCheckpoint(f"{path}: holds iteration {manifest['iteration']}")
    if hashlib.sha256(blob).hexdigest() != manifest["sha256"]:
        raise BadCheckpoint(f"{path}: state.safetensors is not what was written (SHA-256 differs)")
    return Checkpoint(path, manifest, load(blob))


def load_newest(folder: Path, warn: Any) -> Checkpoint | None:
    """The newest checkpoint that can be trusted; `warn(text)` is called for each bad newer one.

    Raises:
      BadCheckpoint: there are checkpoints, but none is good.
    """
    found = numbered(folder)
    for path in reversed(found):
        try:
            return load_checkpoint(path)
        except BadCheckpoint as error:
            warn(f"warning: {error}; using an older checkpoint")
            last = error
    if found:
        raise last
    return None
