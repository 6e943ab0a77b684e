"""The scripts and the notebook of `examples/` run."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
SMALL = {"compare_arms.py": ["--seeds", "2"]}


def environment() -> dict[str, str]:
    return {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "PYTHONPATH": str(ROOT / "src")}


def test_the_readme_lists_them() -> None:
    text = (EXAMPLES / "README.md").read_text()
    for path in (*SCRIPTS, EXAMPLES / "tour.ipynb"):
        assert f"({path.name})" in text


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_script_says_how_to_run_it(script: Path) -> None:
    docstring = ast.get_docstring(ast.parse(script.read_text()))
    assert docstring and f"python examples/{script.name}" in docstring


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_script_runs(script: Path, tmp_path: Path) -> None:
    arguments = [sys.executable, script, "--steps", "8192", *SMALL.get(script.name, [])]
    done = subprocess.run(
        arguments, cwd=tmp_path, env=environment(), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    if script.name == "resume_and_load.py":
        assert "rows are the same: True" in done.stdout


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbformat = pytest.importorskip("nbformat", reason="needs `pip install -e '.[docs]'`")
    nbclient = pytest.importorskip("nbclient", reason="needs `pip install -e '.[docs]'`")
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    notebook = nbformat.read(EXAMPLES / "tour.ipynb", as_version=4)
    for cell in notebook.cells:
        cell.source = cell.source.replace("60_000", "8_192")
    nbclient.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": tmp_path}}
    ).execute()
    pictures = [
        output
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 2
    tables = [
        output["data"]["text/html"]
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "text/html" in output.get("data", {})
    ]
    assert "<caption>100%" in tables[0]  # the progress, redrawn in place
