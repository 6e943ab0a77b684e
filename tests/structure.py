"""The package's structure as it stands: entries at its root, floors, and circles of imports.

    python tests/structure.py [REVISION]     of a git revision instead of the working tree

A floor is the longest chain of imports below an entry. Every import counts, also one inside a
function or for type checkers alone.
"""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
Edges = dict[str, set[str]]


def module_edges(package: Path) -> Edges:
    """Every module of `package` (`a.b`, without the package's own name), and what it imports."""
    paths = {_name(package, path): path for path in package.rglob("*.py")}
    edges: Edges = {}
    for module, path in paths.items():
        named = set(_imported(ast.parse(path.read_text()), package.name))
        edges[module] = {found for name in named if (found := _module(name, paths))} - {module}
    return edges


def entry(module: str) -> str:
    """The root entry that holds a module."""
    return module.split(".")[0]


def between_entries(edges: Edges) -> Edges:
    """The imports between the package's root entries."""
    found: Edges = {}
    for module, imported in edges.items():
        own = found.setdefault(entry(module), set())
        own |= {entry(other) for other in imported} - {entry(module)}
    return found


def circles(edges: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """The strongly connected components of more than one node (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in edges.get(node, ()):
            if other not in index:
                visit(other)
            if other in stack:
                low[node] = min(low[node], low[other])
        if low[node] == index[node]:
            at = stack.index(node)
            component, stack[at:] = stack[at:], []
            if len(component) > 1:
                found.append(sorted(component))

    for node in edges:
        if node not in index:
            visit(node)
    return found


def floors(edges: Mapping[str, Iterable[str]]) -> int:
    """Nodes of the longest chain of imports; a circle counts as one node."""
    group = {node: node for node in edges}
    for circle in circles(edges):
        group |= dict.fromkeys(circle, circle[0])
    below: dict[str, set[str]] = {}
    for node, others in edges.items():
        below.setdefault(group[node], set()).update(group[other] for other in others)
    depth: dict[str, int] = {}

    def height(node: str) -> int:
        if node not in depth:
            depth[node] = 1 + max(map(height, below[node] - {node}), default=0)
        return depth[node]

    return max(map(height, below))


def _name(package: Path, path: Path) -> str:
    parts = path.relative_to(package).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(tree: ast.Module, package: str) -> Iterable[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == package:
            inside = (node.module or "").removeprefix(package).removeprefix(".")
            yield from (f"{inside}.{alias.name}".removeprefix(".") for alias in node.names)
        elif isinstance(node, ast.Import):
            own = (alias.name for alias in node.names if alias.name.split(".")[0] == package)
            yield from (name.removeprefix(package).removeprefix(".") for name in own)


def _module(name: str, known: Mapping[str, Path]) -> str | None:
    """The module that an imported name is, or is in; the package's own root is none."""
    while name and name not in known:
        name = name.rpartition(".")[0]
    return name or None


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        place = ROOT
        if len(sys.argv) > 1:
            place = Path(folder)
            archive = ["git", "-C", str(ROOT), "archive", sys.argv[1], "src/sauna"]
            packed = subprocess.run(archive, check=True, capture_output=True).stdout
            subprocess.run(["tar", "-x", "-C", folder], input=packed, check=True)
        edges = module_edges(place / "src" / "sauna")
    del edges[""]  # the root itself, which names the public API
    entries = between_entries(edges)
    entries.pop("__main__", None)
    print(f"{len(entries)} entries at the root: {', '.join(sorted(entries))}")
    print(f"{floors(entries)} floors of entries, {floors(edges)} of modules")
    for name, found in (("entries", circles(entries)), ("modules", circles(edges))):
        print(f"{len(found)} circles of {name}", *(f"  {' <-> '.join(c)}" for c in found), sep="\n")


if __name__ == "__main__":
    main()
