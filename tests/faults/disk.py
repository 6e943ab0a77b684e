"""A disk that can be watched, can fail, and can lose what was not flushed.

`watched` sees every operation of this process that changes files under a folder, before it
happens. `Disk` replays such operations and knows what a power cut may leave: an entry of a folder
is safe once the folder was flushed, bytes once their file was. Between two flushes anything may
have reached the disk, in any order.
"""

from __future__ import annotations

import io
import itertools
import os
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch


class Op(NamedTuple):
    """One operation; paths are relative to the watched folder."""

    kind: str  # create, truncate, write, fsync, mkdir, rename, unlink, rmdir
    path: str
    data: Any = None  # written bytes, the new name, or the new length


class Crash(BaseException):
    """The process was killed here; nothing that it does afterwards reaches the disk."""


Hook = Callable[[Op], None]


@contextmanager
def watched(folder: Path, hook: Hook) -> Iterator[None]:
    """Calls `hook(op)` before each operation under `folder`; it may raise instead of it."""
    root = os.path.realpath(folder)

    def relative(path: Any, dir_fd: int | None = None) -> str | None:
        if isinstance(path, int) or dir_fd is not None:
            base = os.readlink(f"/proc/self/fd/{path if dir_fd is None else dir_fd}")
            path = base if dir_fd is None else os.path.join(base, os.fspath(path))
        place = os.path.abspath(os.fspath(path))
        return os.path.relpath(place, root) if place.startswith(root) else None

    def around(kind: str, plain: Callable[..., Any]) -> Callable[..., Any]:
        def operate(path: Any, *more: Any, **named: Any) -> Any:
            name = relative(path, named.get("dir_fd"))
            if name is not None and _happens(kind, os.path.join(root, name)):
                data = more[0] if kind == "truncate" else None
                hook(Op(kind, name, relative(more[0]) if kind == "rename" else data))
            return plain(path, *more, **named)

        return operate

    def opened(path: Any, mode: str = "r", *more: Any, **named: Any) -> Any:
        name = None if isinstance(path, int) else relative(path)
        if name is None or not set(mode) & set("wax+"):
            return plain_open(path, mode, *more, **named)
        if "w" in mode or not os.path.exists(path):
            hook(Op("create", name))
        return _File(plain_open(path, mode, *more, **named), name, hook)

    plain_open = io.open
    kinds = {
        "mkdir": "mkdir",
        "rename": "rename",
        "replace": "rename",
        "unlink": "unlink",
        "remove": "unlink",
        "rmdir": "rmdir",
        "truncate": "truncate",
        "fsync": "fsync",
    }
    changed = {name: around(kind, getattr(os, name)) for name, kind in kinds.items()}
    with patch.multiple(os, **changed), patch("io.open", opened):
        yield


def _happens(kind: str, path: str) -> bool:
    """Whether the operation is going to change something instead of failing."""
    if kind == "mkdir":
        return os.path.isdir(os.path.dirname(path)) and not os.path.lexists(path)
    return os.path.lexists(path)


class _File:
    """A file opened for writing; each write is reported, and then reaches the file at once."""

    def __init__(self, file: Any, name: str, hook: Hook) -> None:
        self._file, self._name, self._hook = file, name, hook

    def write(self, data: Any) -> int:
        raw = data.encode() if isinstance(data, str) else bytes(data)
        try:
            self._hook(Op("write", self._name, raw))
        except OSError:
            self._put(data[: len(data) // 2])  # a full disk takes what still fits
            raise
        self._put(data)
        return len(data)

    def _put(self, data: Any) -> None:
        self._file.write(data)
        self._file.flush()

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def truncate(self, size: int) -> None:
        self._hook(Op("truncate", self._name, size))
        self._file.truncate(size)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.close()


Tree = dict[str, bytes | None]  # path -> bytes of a file, or None: a folder


def tree_of(folder: Path) -> Tree:
    return {
        str(path.relative_to(folder)): None if path.is_dir() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
    }


def make_tree(tree: Tree, folder: Path) -> None:
    folder.mkdir(parents=True)
    for name, data in sorted(tree.items()):
        if data is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(data)


class _Node:
    """A file (`entries` None) or a folder, as it is now and as it was flushed last."""

    def __init__(self, entries: dict[str, _Node] | None, data: bytes = b"") -> None:
        self.entries, self.data = entries, data
        self.safe_entries, self.safe_data = dict(entries or {}), data
        self.pending: list[dict[str, _Node | None]] = []  # changes of entries, in order

    def change(self, **entries: _Node | None) -> None:
        assert self.entries is not None
        self.pending.append(entries)
        _apply(self.entries, entries)

    def flush(self) -> None:
        self.safe_entries, self.safe_data = dict(self.entries or {}), self.data
        self.pending = []


def _apply(entries: dict[str, _Node], change: dict[str, _Node | None]) -> None:
    for name, node in change.items():
        if node is None:
            entries.pop(name, None)
        else:
            entries[name] = node


class Disk:
    """Replays operations on what is safe at first."""

    def __init__(self, tree: Tree) -> None:
        self._root = _Node({})
        for name, data in sorted(tree.items()):
            parent, last = self._place(name)
            parent.change(**{last: _Node({} if data is None else None, data or b"")})
        for node in self._nodes():
            node.flush()

    def _place(self, path: str) -> tuple[_Node, str]:
        *parents, last = path.split("/")
        node = self._root
        for name in parents:
            assert node.entries is not None
            node = node.entries[name]
        return node, last

    def _nodes(self) -> list[_Node]:
        """Everything that is, or may still be, somewhere on the disk."""
        found: dict[int, _Node] = {}
        waiting = [self._root]
        while waiting:
            node = waiting.pop()
            if id(node) in found:
                continue
            found[id(node)] = node
            lost = [n for change in node.pending for n in change.values() if n is not None]
            waiting += [*(node.entries or {}).values(), *node.safe_entries.values(), *lost]
        return list(found.values())

    def apply(self, op: Op) -> None:
        if op.kind == "fsync":
            self._find(op.path).flush()
            return
        parent, name = self._place(op.path)
        if op.kind in ("create", "mkdir"):
            if op.kind == "create" and name in (parent.entries or {}):
                self._find(op.path).data = b""
            else:
                parent.change(**{name: _Node({} if op.kind == "mkdir" else None)})
        elif op.kind == "write":
            self._find(op.path).data += op.data
        elif op.kind == "truncate":
            self._find(op.path).data = self._find(op.path).data[: op.data]
        elif op.kind == "rename":
            to, new_name = self._place(op.data)
            assert to is parent, "only renames inside one folder are atomic on every file system"
            parent.change(**{name: None, new_name: self._find(op.path)})
        else:
            parent.change(**{name: None})

    def _find(self, path: str) -> _Node:
        if path == ".":
            return self._root
        parent, name = self._place(path)
        assert parent.entries is not None
        return parent.entries[name]

    def now(self) -> Tree:
        return _tree(self._root, lambda node: node.entries or {}, lambda node: node.data)

    def after_power_cut(self, rng: random.Random, most: int) -> list[Tree]:
        """What may be left: all combinations of lost changes, or `most` random ones of them."""
        nodes = self._nodes()
        folders = [node for node in nodes if node.pending]
        files = [n for n in nodes if n.entries is None and n.data != n.safe_data]
        entry_choices = [_survivors(node) for node in folders]
        data_choices = [_remains(node) for node in files]
        every = entry_choices + data_choices
        number = 1
        for choices in every:
            number *= len(choices)
        picks: Any = itertools.product(*every)
        if number > most:
            picks = ([rng.choice(choices) for choices in every] for _ in range(most))
        found = []
        for pick in picks:
            entries = dict(zip(map(id, folders), pick, strict=False))
            data = dict(zip(map(id, files), pick[len(folders) :], strict=True))
            found.append(
                _tree(
                    self._root,
                    lambda node, kept=entries: kept.get(id(node), node.safe_entries),
                    lambda node, kept=data: kept.get(id(node), node.data),
                )
            )
        return found


def _survivors(node: _Node) -> list[dict[str, _Node]]:
    """A folder's entries after any subset of its changes has reached the disk."""
    found = []
    for kept in itertools.product([False, True], repeat=len(node.pending)):
        entries = dict(node.safe_entries)
        for change, is_kept in zip(node.pending, kept, strict=True):
            if is_kept:
                _apply(entries, change)
        found.append(entries)
    return found


def _remains(node: _Node) -> list[bytes]:
    """What may be in a file that was not flushed: what was, what is, or a part of it.

    Of bytes that were added behind flushed ones only the added ones are at risk.
    """
    safe = node.safe_data if node.data.startswith(node.safe_data) else b""
    new = node.data[len(safe) :]
    cuts = sorted({len(new) * part // 8 for part in (1, 2, 4, 6)} | {len(new) - 1})
    parts = [new[:cut] for cut in cuts] + [new[:cut] + bytes(len(new) - cut) for cut in cuts]
    return [node.safe_data, node.data, safe + bytes(len(new)), *(safe + part for part in parts)]


def _tree(root: _Node, entries: Callable[..., Any], data: Callable[..., bytes]) -> Tree:
    found: Tree = {}

    def walk(node: _Node, prefix: str) -> None:
        for name, child in entries(node).items():
            found[prefix + name] = None if child.entries is not None else data(child)
            if child.entries is not None:
                walk(child, f"{prefix}{name}/")

    walk(root, "")
    return found
