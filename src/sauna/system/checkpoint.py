"""Checkpoints: one safetensors file and a manifest with its SHA-256, written atomically.

    checkpoints/00000488/{state.safetensors, manifest.json}

The folder's number is the iteration that the state is at the start of. A checkpoint is written
beside its place, flushed to disk, and renamed; older ones are pruned only after that. Reading
trusts nothing: see `safe_read.py`.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from sauna.system.errors import SaunaError
from sauna.system.migrations import with_arms
from sauna.system.safe_read import JSON_BYTES, Untrusted, check_header, parse_object, read_file
from sauna.system.safe_write import own_folder, sync_folder, write_durably

FORMAT = 2
LARGEST = 2**34  # bytes of a state that are read at most
# How a manifest of an older format becomes one of the next, by the older one's number.
MIGRATIONS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {1: with_arms}
# What a manifest holds; the last six are of a run.
TYPES = {
    "format": int,
    "iteration": int,
    "sha256": str,
    "bytes": int,
    "config": dict,
    "arms": dict,
    "spaces": list,
    "members": list,
    "logs": dict,
    "log_digests": dict,
}


Check = Callable[[dict[str, Any]], None]


class BadCheckpoint(SaunaError):
    """A checkpoint that cannot be trusted; the message names it and says why."""


class NewerFormat(SaunaError):
    """A checkpoint of a version that is newer than this one: an older one must not replace it."""


class NotFinite(SaunaError):
    """A state that must not be saved, because something in it is NaN or infinite."""


class Checkpoint(NamedTuple):
    path: Path
    manifest: dict[str, Any]
    arrays: dict[str, np.ndarray]


def save_checkpoint(
    folder: Path, iteration: int, arrays: dict[str, np.ndarray], manifest: dict[str, Any], keep: int
) -> Path:
    """Writes `folder/ITERATION` atomically, then removes all up to it but the newest `keep`.

    One of a higher number is one that could not be used: it neither counts nor goes.

    Raises:
      NotFinite: an array is not finite; nothing was written.
    """
    for name, array in arrays.items():
        # What an environment of the device keeps in its state is its own affair.
        if "/collect/envs/" in name:
            continue
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise NotFinite(f"{name} is not finite: the last finite checkpoint is kept")
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
    own_folder(folder)
    if os.path.lexists(final):
        if _holds(final, manifest):  # saved before the run was stopped here
            return final
        final.rename(_free_name(final))
    for left in folder.glob(".writing-*"):
        left.unlink() if left.is_symlink() or left.is_file() else shutil.rmtree(left)
    temporary = folder / f".writing-{iteration:08d}-{secrets.token_hex(8)}"
    temporary.mkdir()
    sync_folder(folder.parent)
    write_durably(temporary / "state.safetensors", blob)
    write_durably(temporary / "manifest.json", json.dumps(manifest, indent=1).encode())
    sync_folder(temporary)
    temporary.rename(final)
    sync_folder(folder)
    for old in [path for path in numbered(folder) if path.name <= final.name][:-keep]:
        shutil.rmtree(old)
    return final


def _digest(manifest: dict[str, Any]) -> str:
    """Of everything in a manifest but the digest itself."""
    rest = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _holds(path: Path, manifest: dict[str, Any]) -> bool:
    """Whether a checkpoint is good, has these arrays, and counts on these logs."""
    if path.is_symlink():
        return False
    try:
        found = load_checkpoint(path).manifest
    except BadCheckpoint:
        return False
    names = ("sha256", "logs", "log_digests")
    return all(found[name] == manifest.get(name, {}) for name in names)


def _free_name(path: Path) -> Path:
    """Where a checkpoint that cannot be used is kept: `NUMBER.bad`, `NUMBER.bad2`, ..."""
    names = (path.with_name(f"{path.name}.bad{i or ''}") for i in [0, *range(2, 1000)])
    return next(name for name in names if not os.path.lexists(name))


def numbered(folder: Path) -> list[Path]:
    """The finished checkpoints of a run, oldest first.

    Raises:
      BadCheckpoint: their folder is a link, or something else.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise BadCheckpoint(f"{folder} is not a folder (nothing is read through links)")
    found = folder.glob("[0-9]" * 8)
    return sorted(path for path in found if path.is_dir() and not path.is_symlink())


def load_checkpoint(
    path: Path, check: Callable[[dict[str, Any]], None] | None = None
) -> Checkpoint:
    """A checkpoint whose bytes are those that were written.

    `check(manifest)` may refuse it before its tensors are read.

    Raises:
      BadCheckpoint: a file is missing, cut short or changed.
      NewerFormat: only a newer version can read it.
    """
    try:
        manifest = _manifest(path)
        if check is not None:
            check(manifest)
        state = path / "state.safetensors"
        return Checkpoint(path, manifest, load_arrays(state, manifest["bytes"], manifest["sha256"]))
    except Untrusted as error:
        raise BadCheckpoint(f"{path}: {error}") from error


def load_arrays(path: Path, size: int, sha256: str) -> dict[str, np.ndarray]:
    """The arrays of a safetensors file of known size and digest.

    Raises:
      Untrusted: its bytes are not those, or no such file.
    """
    blob = read_file(path, min(size, LARGEST))
    if hashlib.sha256(blob).hexdigest() != sha256:
        raise Untrusted(f"{path.name} is not what was written (SHA-256 differs)")
    check_header(blob)
    try:
        return load(blob)
    except (SafetensorError, KeyError) as error:  # KeyError: a type that numpy lacks
        raise Untrusted(str(error)) from error


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a checkpoint.

    Raises:
      BadCheckpoint: it cannot be trusted.
      NewerFormat: only a newer version can read it.
    """
    try:
        return _manifest(path)
    except Untrusted as error:
        raise BadCheckpoint(f"{path}: {error}") from error


def _manifest(path: Path) -> dict[str, Any]:
    """The manifest, brought to today's format.

    Raises:
      Untrusted: it is not what was written, or of a format that never was.
      NewerFormat: only a newer version can read it.
    """
    stored = parse_object(read_file(path / "manifest.json", JSON_BYTES))
    number = stored.get("format")
    if _digest(stored) != stored.get("manifest_sha256"):
        raise Untrusted("manifest.json is not what was written (SHA-256 differs)")
    if type(number) is int and number > FORMAT:
        raise NewerFormat(f"{path} is of format {number}; this version reads up to {FORMAT}")
    if type(number) is not int or (number != FORMAT and number not in MIGRATIONS):
        raise Untrusted(f"not a checkpoint of format {FORMAT}")
    while number < FORMAT:
        stored, number = {**MIGRATIONS[number](stored), "format": number + 1}, number + 1
    _check_types(stored)
    if path.name != f"{stored['iteration']:08d}":
        raise Untrusted(f"holds iteration {stored['iteration']}")
    return stored


def _check_types(manifest: dict[str, Any]) -> None:
    """Each entry's type; what a run adds may be missing, and is then empty."""
    for name, kind in TYPES.items():
        if kind in (dict, list):
            manifest.setdefault(name, kind())
        if type(manifest.get(name)) is not kind:
            raise Untrusted(f"manifest.json: {name} is missing or of another type")
    for name, size in manifest["logs"].items():
        if Path(name).name != name or type(size) is not int or size < 0:
            raise Untrusted("manifest.json: logs are not names of files and their sizes")
    for name, digest in manifest["log_digests"].items():
        if name not in manifest["logs"] or type(digest) is not str:
            raise Untrusted("manifest.json: log_digests are not SHA-256 of its logs")
    if not all(type(name) is str for name in manifest["members"]):
        raise Untrusted("manifest.json: members are not names")


def load_newest(
    folder: Path,
    warn: Callable[[str], None],
    check: Check | None = None,
) -> Checkpoint | None:
    """The newest checkpoint that can be used; `warn(text)` is called for each newer one.

    `check(manifest)` raises BadCheckpoint for one that cannot be used, or what else it wants.

    Raises:
      BadCheckpoint: there are checkpoints, but none is good.
    """
    found = numbered(folder)
    for path in reversed(found):
        try:
            return load_checkpoint(path, check)
        except BadCheckpoint as error:
            warn(f"warning: {error}; using an older checkpoint")
            last = error
    if found:
        raise last
    return None


def under(prefix: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays whose names start with `prefix`, without it."""
    return {name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)}
