"""Checkpoints that somebody wrote to do harm. Every digest is right: an attacker can count, too."""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import os
import pickle
import socket
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from sauna.system.checkpoint import FORMAT, _digest

HARM = "touch /tmp/sauna-was-here"
Case = Callable[[Path], None]  # makes a run directory
NUMBER = "00000004"


class _Harm:
    def __reduce__(self) -> Any:
        return os.system, (HARM,)


def forge(run: Path, blob: bytes | None = None, raw: bytes | None = None, **changes: Any) -> Path:
    """A checkpoint of `blob` whose manifest has `changes` (or is `raw`), digests included."""
    place = run / "checkpoints" / NUMBER
    place.mkdir(parents=True)
    (run / "config.json").write_text(json.dumps({"config": {}, "spaces": []}))
    blob = good_blob() if blob is None else blob
    (place / "state.safetensors").write_bytes(blob)
    manifest = {
        "format": FORMAT,
        "iteration": int(NUMBER),
        "bytes": len(blob),
        "sha256": hashlib.sha256(blob).hexdigest(),
        "config": {"arm": ["ppo"]},
        "arms": {"ppo": {}},
        "members": ["ppo/0"],
        "spaces": ["vector", [3], "continuous", [2], "", ""],
        "logs": {},
        **changes,
    }
    manifest["manifest_sha256"] = _digest(manifest)
    text = json.dumps(manifest).encode() if raw is None else raw
    (place / "manifest.json").write_bytes(text)
    return place


def good_blob() -> bytes:
    return save({"ppo/0/params/x": np.zeros(4, np.float32)})


def tensors(header: Any, data: bytes = bytes(16), size: int | None = None) -> bytes:
    """A safetensors file with this header, of whatever it is."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    length = len(text) if size is None else size
    return length.to_bytes(8, "little") + text + data


def tensor(**changes: Any) -> dict[str, Any]:
    return {"dtype": "F32", "shape": [4], "data_offsets": [0, 16], **changes}


def _zip_bomb() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("state", bytes(300_000_000))
    return out.getvalue()


def _npz() -> bytes:
    out = io.BytesIO()
    np.savez(out, x=np.array([_Harm()], dtype=object))
    return out.getvalue()


def blobs() -> dict[str, bytes]:
    """Bytes in place of the tensors."""
    half = tensor(shape=[2], data_offsets=[0, 8])
    return {
        "pickle": pickle.dumps(_Harm()),
        "pickle, old protocol": pickle.dumps(_Harm(), protocol=0),
        "npz with an object": _npz(),
        "zip bomb": _zip_bomb(),
        "gzip bomb": gzip.compress(bytes(300_000_000), 1),
        "nothing": b"",
        "seven bytes": bytes(7),
        "only zeros": bytes(1000),
        "header of 2**63 bytes": tensors({}, size=2**63),
        "header of 2**64 - 1 bytes": tensors({}, size=2**64 - 1),
        "header longer than the file": tensors({}, size=100),
        "header that is no JSON": tensors(b"{'a': 1}"),
        "header that is a list": tensors([1, 2]),
        "header that is a string": tensors("x"),
        "header that is null": tensors(None),
        "deep lists": tensors(b"[" * 200_000),
        "deep objects": tensors(b'{"a":' * 200_000),
        "header of a million objects": tensors(b"[" + b"{}," * 1_000_000 + b"{}]"),
        "NaN in the header": tensors(b'{"a":{"dtype":"F32","shape":[NaN],"data_offsets":[0,16]}}'),
        "a tensor twice": tensors(
            b'{"a":{"dtype":"F32","shape":[4],"data_offsets":[0,16]},'
            b'"a":{"dtype":"F32","shape":[4],"data_offsets":[0,16]}}'
        ),
        "a shape twice": tensors(
            b'{"a":{"dtype":"F32","shape":[4],"shape":[4],"data_offsets":[0,16]}}'
        ),
        "negative offset": tensors({"a": tensor(data_offsets=[-16, 0])}),
        "offsets backwards": tensors({"a": tensor(data_offsets=[16, 0])}),
        "overlapping tensors": tensors({"a": tensor(), "b": tensor(data_offsets=[8, 24])}),
        "the same bytes twice": tensors({"a": tensor(), "b": tensor()}),
        "a gap between tensors": tensors(
            {"a": half, "b": tensor(shape=[1], data_offsets=[12, 16])}
        ),
        "bytes of no tensor": tensors({"a": half}),
        "offsets behind the end": tensors({"a": tensor(data_offsets=[0, 2**40])}),
        "huge shape": tensors({"a": tensor(shape=[2**62])}),
        "shape whose size overflows": tensors({"a": tensor(shape=[2**32, 2**32])}),
        "shape times zero": tensors({"a": tensor(shape=[2**62, 0])}),
        "a million axes": tensors({"a": tensor(shape=[1] * 1_000_000)}),
        "negative shape": tensors({"a": tensor(shape=[-4])}),
        "two negative axes": tensors({"a": tensor(shape=[-2, -2])}),
        "fractional shape": tensors({"a": tensor(shape=[4.0])}),
        "shape of a bool": tensors({"a": tensor(shape=[True, 4])}),
        "shape of text": tensors({"a": tensor(shape="4")}),
        "unknown type": tensors({"a": tensor(dtype="F31")}),
        "a type that numpy lacks": tensors({"a": tensor(dtype="F8_E4M3", shape=[16])}),
        "object type": tensors({"a": tensor(dtype="O")}),
        "type that is a list": tensors({"a": tensor(dtype=["F32"])}),
        "three offsets": tensors({"a": tensor(data_offsets=[0, 8, 16])}),
        "offsets of text": tensors({"a": tensor(data_offsets=["0", "16"])}),
        "no type": tensors({"a": {"shape": [4], "data_offsets": [0, 16]}}),
        "an unknown entry": tensors({"a": tensor(load="os.system")}),
        "a tensor that is null": tensors({"a": None}),
        "metadata that is no text": tensors({"__metadata__": {"a": [1]}, "a": tensor()}),
        "header in another encoding": tensors('{"a": "ä"}'.encode("latin-1")),
        "header with a NUL": tensors(b'{"a\x00": 1}'),
    }


def manifests() -> dict[str, dict[str, Any]]:
    """Changes of the manifest, or the whole of it as `raw`."""
    return {
        "pickle as manifest": {"raw": pickle.dumps(_Harm())},
        "YAML that runs": {"raw": b"!!python/object/apply:os.system [touch /tmp/sauna-was-here]"},
        "Python as manifest": {"raw": b"__import__('os').system('touch /tmp/sauna-was-here')"},
        "deep manifest": {"raw": b"[" * 200_000},
        "a key twice": {"raw": b'{"format": 1, "format": 1}'},
        "infinity in it": {"raw": b'{"format": 1, "iteration": Infinity}'},
        "a number of 10000 digits": {"raw": b'{"format": 1' + b"0" * 10_000 + b"}"},
        "manifest of 8 MB": {"raw": b'{"format": 1, "x": "' + b"x" * 8_000_000 + b'"}'},
        "manifest in UTF-16": {"raw": '{"format": 1}'.encode("utf-16")},
        "format of text": {"format": "1"},
        "format that is true": {"format": True},
        "format of the far future": {"format": 10**9},
        "iteration is a path": {"iteration": "../../../etc/passwd"},
        "iteration below 0": {"iteration": -4},
        "fractional iteration": {"iteration": 4.0},
        "bytes below 0": {"bytes": -1},
        "bytes of text": {"bytes": "16"},
        "fewer bytes than there are": {"bytes": 10},
        "digest that is a number": {"sha256": 4},
        "config that is a list": {"config": [1]},
        "members that are an object": {"members": {"a": 1}},
        "a log outside": {"logs": {"../../etc/passwd": 0}},
        "a log below 0": {"logs": {"metrics.jsonl": -5}},
        "spaces that are none": {"spaces": [1, 2, 3]},
        "an unknown setting": {"config": {"__class__": "x"}},
        "a setting that is a list": {"config": {"env": ["x"]}},
        "environment os:system": {"config": {"env": "os:system"}},
        "environment builtins:exec": {"config": {"env": "builtins:exec"}},
        "environment pickle:loads": {"config": {"env": "pickle:loads"}},
        "environment in a package of Python": {"config": {"env": "multiprocessing.util:spawnv"}},
    }


def _replace(run: Path, name: str, make: Callable[[Path], object]) -> None:
    path = forge(run) / name
    path.unlink()
    make(path)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        here = os.getcwd()
        os.chdir(path.parent)  # names of sockets are short
        server.bind(path.name)
        os.chdir(here)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**40)


def _linked_folder(run: Path) -> None:
    place = forge(run)
    place.rename(run.with_suffix(".elsewhere"))
    place.symlink_to(run.with_suffix(".elsewhere"))


def _huge_as_promised(run: Path) -> None:
    place = forge(run, bytes=2**40)
    _sparse(place / "state.safetensors")


def _config(run: Path, make: Callable[[Path], object]) -> None:
    forge(run)
    (run / "config.json").unlink()
    make(run / "config.json")


def cases() -> dict[str, Case]:
    state, manifest = "state.safetensors", "manifest.json"
    special: dict[str, Case] = {
        "state linked to /etc/passwd": lambda r: _replace(r, state, _link("/etc/passwd")),
        "state linked to /dev/zero": lambda r: _replace(r, state, _link("/dev/zero")),
        "state linked outside": lambda r: _replace(r, state, _link("../../../good")),
        "manifest linked to /dev/zero": lambda r: _replace(r, manifest, _link("/dev/zero")),
        "state is a FIFO": lambda r: _replace(r, state, os.mkfifo),
        "manifest is a FIFO": lambda r: _replace(r, manifest, os.mkfifo),
        "state is a folder": lambda r: _replace(r, state, Path.mkdir),
        "state is a socket": lambda r: _replace(r, state, _socket),
        "state of 1 TB without blocks": lambda r: _replace(r, state, _sparse),
        "manifest of 1 TB without blocks": lambda r: _replace(r, manifest, _sparse),
        "1 TB, as the manifest promises": _huge_as_promised,
        "checkpoint linked outside": _linked_folder,
        "config.json is a FIFO": lambda r: _config(r, os.mkfifo),
        "config.json linked to /dev/zero": lambda r: _config(r, _link("/dev/zero")),
        "config.json is deep": lambda r: _config(r, lambda p: p.write_bytes(b"[" * 200_000)),
    }
    found: dict[str, Case] = dict(special)
    for name, blob in blobs().items():
        found[name] = lambda run, blob=blob: forge(run, blob) and None
    for name, changes in manifests().items():
        found[name] = lambda run, changes=changes: forge(run, **changes) and None
    return found


def _link(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)
