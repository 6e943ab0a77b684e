"""Processes of this project's own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from helpers import environment

CODE = """
from sauna.system.processes import start_worker
print(start_worker("of_the_folder", {"GIVEN": "x"}).process.wait())
"""
WORKER = "import os, sys; sys.exit(7 if os.environ['GIVEN'] == 'x' and len(sys.argv) == 3 else 8)\n"


def test_a_worker_finds_the_modules_of_the_folder_in_which_its_parent_was_started(
    tmp_path: Path,
) -> None:
    (tmp_path / "of_the_folder.py").write_text(WORKER)
    for where, code in ((tmp_path, "7"), (tmp_path.parent, "1")):
        command = [sys.executable, "-c", CODE]
        done = subprocess.run(command, cwd=where, env=environment(), capture_output=True, text=True)
        assert done.stdout.strip() == code, done.stderr
