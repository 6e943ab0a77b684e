"""Which sources of this package train: their digest, and whether somebody edited them.

A run stores both under `code["sauna"]`, as `REVISION DIGEST`. The revision is the version of the
package, or the git revision of a checkout, which ends in `+changes` while its sources are edited.
So a new version differs from an edit: the first is named, the second is refused. A rule that
differs is refused in both cases: see `rule_sources.py`.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from sauna.system import git

KEY = "sauna"
PACKAGE = Path(__file__).parents[1]
# What decides a run's numbers: folders of code, and the defaults that no name of a run holds.
COMPUTING = ("algorithm", "envs", "training/loop")
DEFAULTS = ("config/options.py", "config/run_options.py", "config/arms.py")


@cache
def own_sources() -> str:
    """`REVISION DIGEST` of the sources that this process has imported, or would import."""
    return sources_of(PACKAGE)


def sources_of(package: Path) -> str:
    """`REVISION DIGEST` of a package's folder."""
    return f"{_revision(package)} {_digest(package)}"


def edited_sources(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Says how sources differ if an edit made them differ; empty if not.

    A run that was stored without them counts as unchanged.
    """
    old, new = _parts(before), _parts(now)
    if old is None or new is None or old[1] == new[1]:
        return ""
    if old[0] != new[0] and not (old[0] + new[0]).count(git.EDITED):
        return ""
    return f"sauna's own sources differ, {old[0]} -> {new[0]}"


def newer_sources(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Says how sources differ if they are of two versions, none of them edited; empty if not."""
    old, new = _parts(before), _parts(now)
    if old is None or new is None or old[1] == new[1] or edited_sources(before, now):
        return ""
    return f"sauna {old[0]}, today's is {new[0]}"


def _parts(code: Mapping[str, str]) -> tuple[str, str] | None:
    revision, _, digest = code.get(KEY, "").partition(" ")
    return (revision, digest) if digest else None


def _digest(package: Path) -> str:
    found = hashlib.sha256()
    files = [path for name in COMPUTING for path in (package / name).rglob("*.py")]
    files += [package / name for name in DEFAULTS]
    for path in sorted(files, key=lambda path: path.relative_to(package).as_posix()):
        content = path.read_bytes()
        found.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode())
        found.update(content)
    return found.hexdigest()


def _revision(package: Path) -> str:
    """The git revision if git tracks the package's files, else the installed version."""
    try:
        git.ask(package, "ls-files", "--error-unmatch", "--", "__init__.py")
        revision = git.ask(package, "rev-parse", "--short=12", "HEAD")
        edited = git.ask(package, "status", "--porcelain", "--", *COMPUTING, *DEFAULTS)
    except git.FAILURES:
        return _version()
    return revision + (git.EDITED if edited else "")


def _version() -> str:
    try:
        return importlib.metadata.version("sauna-rl")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
