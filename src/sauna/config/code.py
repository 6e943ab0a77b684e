"""Digests of the code that a run names, so that results of other code are not taken for its own.

A name `module:name` stands for its module's source and for the sources that this imports, as far
as they are the user's own. Of an installed package it stands for the version, too. The sources of
this package that train count as well: see `own_sources.py`.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from sauna.config.own_sources import KEY, edited_sources, own_sources
from sauna.config.rule_sources import PREFIX, changed_rules, rule_sources
from sauna.config.trust import named_code
from sauna.system.tracebacks import is_users

# Packages behind the environments that are named without a module.
PACKAGES = {
    "ALE": "ale-py",
    "gymnax": "gymnax",
    "playground": "playground",
    "brax": "brax",
    "mjx": "mujoco-mjx",
}


def code_of(settings: Mapping[str, Any]) -> dict[str, str]:
    """`{module: SHA-256, package: version}` of the code that settings, or a stored config, name.

    Its modules have been imported already; nothing is imported here. `sauna` holds the sources of
    this package, `sauna rule NAME` the source of a built-in rule that the run learns with.
    """
    found = {KEY: own_sources(), **rule_sources(settings)}
    env = str(settings.get("config", settings).get("env"))
    for module in _named_modules(settings, env):
        _add_module(module, found)
    package = PACKAGES.get(env.partition("/")[0])
    if package is not None:
        _add_version(package, found)
    return dict(sorted(found.items()))


def changed_code(before: Mapping[str, Any], now: Mapping[str, str]) -> str:
    """What of the code is not what it was, as a text; empty where nothing differs.

    A newer version of this package is no change, unless a rule of the run differs:
    `own_sources.newer_sources` names it.
    """
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    names = [name for name in names if name != KEY and not name.startswith(PREFIX)]
    parts = [text for text in [edited_sources(before, now)] if text]
    parts += [f"the source of the rule {name} differs" for name in changed_rules(before, now)]
    for name in sorted(names):
        old, new = before.get(name), now.get(name)
        if " " in name:  # a package
            parts.append(f"{name} {old or 'none'} -> {new or 'none'}")
        else:
            how = "changed" if old and new else "is new" if new else "is gone"
            parts.append(f"module {name} {how}")
    return ", ".join(parts)


def _named_modules(settings: Mapping[str, Any], env: str) -> list[str]:
    named = (name for field, name in named_code(settings) if field != "track")  # computes nothing
    found = [name.partition(":")[0] for name in named]
    gymnasium: Any = sys.modules.get("gymnasium")
    spec = None
    if gymnasium and env.split("/")[0] not in PACKAGES:  # those count by their package's version
        spec = gymnasium.registry.get(env.rpartition(":")[2])
    if spec is not None and isinstance(spec.entry_point, str):
        found.append(spec.entry_point.partition(":")[0])
    elif spec is not None:  # a class or a function
        found.append(str(getattr(spec.entry_point, "__module__", "")))
    return [name for name in found if name.partition(".")[0] not in ("gymnasium", "sauna", "")]


def _add_module(name: str, found: dict[str, str]) -> None:
    """The module, and what of the user's own it imports, directly or not."""
    file = _file(name)
    if file is None or name in found:
        return
    found[name] = _digest(file, file.stat().st_mtime_ns)
    if not is_users(str(file)):
        _add_version(_distribution(name), found)
        return
    for imported in _imported(file, name):
        other = _file(imported)
        if other is not None and is_users(str(other)):
            _add_module(imported, found)


def _file(name: str) -> Path | None:
    """The source of a module that is imported, or that could be without importing another."""
    module = sys.modules.get(name)
    origin = getattr(module, "__file__", None)
    if module is None and "." not in name:
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, ValueError):
            spec = None
        origin = spec.origin if spec is not None else None
    path = Path(origin) if origin else None
    return path if path is not None and path.suffix == ".py" and path.is_file() else None


@lru_cache(1024)
def _digest(file: Path, changed: int) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _imported(file: Path, name: str) -> Iterator[str]:
    """The names that a source imports; of `from a import b` both `a` and `a.b`."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):
        return
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level]
            base = ".".join([*(parents if node.level else []), *filter(None, [node.module])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _distribution(module: str) -> str:
    top = module.partition(".")[0]
    return importlib.metadata.packages_distributions().get(top, [top])[0]


def _add_version(package: str, found: dict[str, str]) -> None:
    try:
        found[f"package {package}"] = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        pass
