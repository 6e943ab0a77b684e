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
    if final.exists():  # the same state, saved before the run was stopped here
        return final
    blob = save(dict(sorted(arrays.items())))
    manifest = {
        "format": FORMAT,
        "iteration": iteration,
        "sha256": hashlib.sha256(blob).hexdigest(),
        "bytes": len(blob),
        **manifest,
    }
    temporary = folder / f".writing-{iteration:08d}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    write_durably(temporary / "state.safetensors", blob)
    write_durably(temporary / "manifest.json", json.dumps(manifest, indent=1).encode())
    sync_folder(temporary)
    temporary.rename(final)
    sync_folder(folder)
    for old in numbered(folder)[:-keep]:
        shutil.rmtree(old)
    return final


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
    if hashlib.sha256(blob).hexdigest() != manifest.get("sha256"):
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
