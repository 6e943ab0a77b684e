"""The arrows between packages, and what a load can never reach."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "sauna"

# What each part may import, besides itself, `config`, `errors` and libraries.
ALLOWED = {
    "core": {"spaces", "selection"},
    "selection": {"core.types"},
    "envs": {"compiled", "spaces", "wire"},
    "collect": {"compiled", "core", "envs.contract", "envs.jax_env", "selection", "spaces"},
    "inspection": {
        "artifact",
        "collect.collected",
        "core",
        "envs",
        "evaluation",
        "member_state",
        "presets",
        "rundir",
        "selection",
        "study.page",
        "study.tables",
        "trained",
        "training",
    },
    "metrics": {"presets", "rundir", "collect", "core", "member_state", "style"},
    "measure": {
        "artifact",
        "checkpoint",
        "collect",
        "core",
        "envs.backend",
        "envs.gymnasium",
        "evaluation",
        "member_state",
        "presets",
        "rundir",
        "spaces",
        "trained",
        "training",
        "worker",
    },
    "study": {
        "checkpoint",
        "placement",
        "presets",
        "rundir",
        "run",
        "signals",
        "spaces",
        "style",
        "envs.probe",
        "metrics.display",
    },
    "bench": {
        "checkpoint",
        "collect",
        "core",
        "device_program",
        "device_training",
        "envs",
        "member_state",
        "placement",
        "metrics.rows",
        "presets",
        "run",
        "rundir",
        "style",
        "training",
        "worker",
    },
}


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sauna"):
            inside = (node.module or "").removeprefix("sauna").removeprefix(".")
            found |= {inside} if inside else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names if not a.name.startswith("sauna")}
    return found


@pytest.mark.parametrize("part", ALLOWED)
def test_arrows(part: str) -> None:
    own = {p.stem for p in SOURCE.glob("*.py")} | {p.name for p in SOURCE.iterdir() if p.is_dir()}
    for path in (SOURCE / part).glob("*.py"):
        for name in imports(path):
            first = name.split(".")[0]
            if first not in own or first in (part, "config", "errors", "names"):
                continue
            assert any(name == a or name.startswith(a + ".") for a in ALLOWED[part]), (path, name)


@pytest.mark.parametrize("part", ["core", "selection"])
def test_the_core_knows_no_clock_no_files_and_no_environments(part: str) -> None:
    for path in (SOURCE / part).glob("*.py"):
        names = imports(path)
        assert not names & {"time", "os", "pathlib", "gymnasium", "mujoco", "random", "io"}, path


def test_no_pickle_and_no_evaluated_code_anywhere() -> None:
    for path in SOURCE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        assert not imports(path) & {"pickle", "cloudpickle", "dill", "shelve", "marshal", "yaml"}
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec", "compile"), path
            if isinstance(node, ast.keyword):
                assert node.arg != "allow_pickle", path


def test_files_stay_readable() -> None:
    for path in SOURCE.rglob("*.py"):
        assert len(path.read_text().splitlines()) <= 420, path
