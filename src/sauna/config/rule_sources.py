"""Which built-in rules a run learns with: a digest of the source of each.

A run stores them under `code["sauna rule NAME"]`. So an edit of a rule is found also when it was
committed, and only by the runs that learn with that rule. Comments and docstrings do not count.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from sauna.config.arms import arm_settings

PREFIX = "sauna rule "
FOLDER = Path(__file__).parents[1] / "algorithm" / "selection"
PACKAGE = "sauna.algorithm.selection."
# Fields that name a rule.
FIELDS = (
    "filter",
    "sampler",
    "loss_weight",
    "stop",
    "objective",
    "critic",
    "auxiliary",
    "advantage_sign",
    "control",
)
# Files with another name than their rule. PPO's own ways have none.
FILES = {
    "sauna": "vex_filter",
    "target-kl": "stops",
    "espo": "stops",
    "unclipped": "objectives",
    "spo": "objectives",
    "next-observation": "merl",
    "shuffled-observation": "merl",
}


def rule_sources(settings: Mapping[str, Any]) -> dict[str, str]:
    """`{"sauna rule NAME": SHA-256}` of the built-in rules that settings, or a stored run, name."""
    found = {}
    for field, name in sorted(_named(settings)):
        file = FOLDER / f"{'control' if field == 'control' else file_of(name)}.py"
        if name != "none" and ":" not in name and file.is_file():
            found[PREFIX + name] = _digest(file)
    return found


def file_of(name: str) -> str:
    """Returns the file of a rule in `algorithm/selection/`, without its ending."""
    return FILES.get(name, name.replace("-", "_"))


def changed_rules(before: Mapping[str, Any], now: Mapping[str, str]) -> list[str]:
    """Names the rules whose source differs; a run that stored none of a rule counts as the same."""
    both = (name for name in before if name.startswith(PREFIX) and name in now)
    return sorted(name.removeprefix(PREFIX) for name in both if before[name] != now[name])


def unknown_rules(before: Mapping[str, Any], now: Mapping[str, str]) -> list[str]:
    """Names the rules of today's run whose source the stored one did not note."""
    return sorted(
        name.removeprefix(PREFIX) for name in now if name.startswith(PREFIX) and name not in before
    )


def _named(settings: Mapping[str, Any]) -> set[tuple[str, str]]:
    tables: list[Mapping[str, Any]]
    if "config" in settings:
        tables = [{**settings["config"], **own} for own in settings.get("arms", {}).values()]
    else:
        arms = settings.get("arm") or ()
        arms = arms.split(",") if isinstance(arms, str) else arms
        tables = [{**arm_settings(arm), **settings} for arm in arms]
    return {(field, str(table[field])) for table in tables for field in FIELDS if field in table}


def _digest(rule: Path) -> str:
    """Of a rule's file and of those beside it that it imports."""
    files, waiting = set(), [rule]
    while waiting:
        file = waiting.pop()
        files.add(file)
        waiting += [path for path in _imports(file) if path not in files]
    found = hashlib.sha256()
    for file in sorted(files):
        found.update(f"{file.name}\n{_statements(file, file.stat().st_mtime_ns)}\n".encode())
    return found.hexdigest()


def _imports(file: Path) -> Iterator[Path]:
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE):
            yield file.with_name(f"{str(node.module).removeprefix(PACKAGE)}.py")


@lru_cache(64)
def _statements(file: Path, changed: int) -> str:
    """A source without its comments and docstrings, in the same words for every Python."""
    tree = ast.parse(file.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node, clean=False
        ):
            node.body = node.body[1:] or [ast.Pass()]
    return repr(_plain(tree))


def _plain(node: Any) -> Any:
    """A syntax tree as lists. `ast.unparse` and `ast.dump` differ between versions of Python."""
    if isinstance(node, ast.AST):
        fields = ((name, value) for name, value in ast.iter_fields(node) if value not in (None, []))
        return [type(node).__name__, *([name, _plain(value)] for name, value in fields)]
    return [*map(_plain, node)] if isinstance(node, list) else repr(node)
