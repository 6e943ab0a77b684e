"""The command line as a test runs it."""

from __future__ import annotations

import io
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from helpers import SMALL, environment
from sauna import cli
from sauna.config.settings import flag

Done = subprocess.CompletedProcess[str]


def sauna(*arguments: str, cwd: Path | None = None) -> Done:
    """As a user starts it."""
    return subprocess.run(
        [sys.executable, "-m", "sauna", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=environment(),
    )


def sauna_here(*arguments: str, cwd: Path | None = None) -> Done:
    """The same without a process of its own, which takes seconds to start.

    Modules of the folder `cwd` are forgotten afterwards.
    """
    out, err, code = io.StringIO(), io.StringIO(), 0
    folder = str(cwd or Path.cwd())
    path = [folder, *sys.path]
    with chdir(folder), patch.object(sys, "path", path), redirect_stdout(out), redirect_stderr(err):
        try:
            cli.main(list(arguments))
        except SystemExit as end:
            code = int(end.code or 0)
    for name, module in list(sys.modules.items()):
        if cwd and str(getattr(module, "__file__", None)).startswith(f"{cwd}/"):
            del sys.modules[name]
    return Done(list(arguments), code, out.getvalue(), err.getvalue())


def small_flags(**changes: object) -> list[str]:
    return [f"{flag(k)}={v}" for k, v in {**SMALL, **changes}.items()]
