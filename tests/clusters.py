"""A folder for trainings on Ray, whose processes and open ports are known, and what it comes to."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from helpers import environment

MARK = "SAUNA_TEST_CLUSTER"  # in the environment of every process that a test starts
# Read, or made from what is read, off a clock.
CLOCKS = ("learner_cpu_seconds", "cpu_seconds", "equal_compute")

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None,
    reason="Ray is not installed: pip install 'sauna-rl[cluster]'",
)


class Place:
    """A folder for one training on Ray; every process that is started from here can be found."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def start(self, *arguments: str, folder: str, **changed: str) -> subprocess.Popen[str]:
        (self.path / folder).mkdir(exist_ok=True)
        return subprocess.Popen(
            [sys.executable, "-m", "sauna", *arguments],
            cwd=self.path / folder,
            env=os.environ | changed,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def runs(self, started: subprocess.Popen[str]) -> bool:
        """Whether it still runs; what it said is shown if not."""
        assert started.poll() is None, started.communicate()
        return True

    def finish(self, started: subprocess.Popen[str], code: int = 0) -> str:
        out, errors = started.communicate(timeout=900)
        assert started.returncode == code, out + errors
        return out + errors

    def processes(self) -> dict[Path, str]:
        """Every process started from here that still runs, and its command line."""
        found = {}
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                ours = f"{MARK}={self.path}".encode() in (entry / "environ").read_bytes()
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if ours and line and int(entry.name) != os.getpid():
                found[entry] = line
        return found

    def listening(self) -> set[str]:
        """Addresses that these processes listen at, as the kernel writes them."""
        sockets = set()
        for entry in self.processes():
            for descriptor in entry.glob("fd/*"):
                with contextlib.suppress(OSError):
                    sockets.add(os.readlink(descriptor))
        rows = [
            line.split()
            for table in ("tcp", "tcp6")
            for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
        ]
        listens = "0A"
        return {
            row[1].split(":")[0]
            for row in rows
            if row[3] == listens and f"socket:[{row[9]}]" in sockets
        }


@contextmanager
def on_ray(path: Path, patched: pytest.MonkeyPatch) -> Iterator[Place]:
    """Lets what is started from `path` find `small_envs.py`, and Ray a token."""
    short = tempfile.mkdtemp(prefix="ray-")  # the paths of Ray's sockets have to be short
    (path / "token").write_text("5" * 64)
    (path / "nodes").mkdir()
    for name, value in {
        MARK: str(path),
        "PYTHONPATH": environment()["PYTHONPATH"],
        "RAY_TMPDIR": short,
        "TMPDIR": str(path / "nodes"),
        "RAY_worker_niceness": "0",  # Ray's own is 15: beside other work a unit would starve
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN_PATH": str(path / "token"),
    }.items():
        patched.setenv(name, value)
    yield Place(path)
    shutil.rmtree(short, ignore_errors=True)


def until(true: Callable[[], Any], seconds: float = 300) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.2)


def kept(folder: Path) -> dict[str, bytes]:
    """What of a study or a tuning depends neither on a clock nor on the folder's own name."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".png"]
    apart = ("timing.jsonl", "metrics.csv", "manifest.json", ".lock", "stderr.txt", "report.html")
    found = {str(p.relative_to(folder)): p for p in sorted(files) if p.name not in apart}
    own = str(folder).encode()
    return {name: timeless(path).replace(own, b"runs") for name, path in found.items()}


def timeless(path: Path) -> bytes:
    """The bytes of a file, those of a study's JSON without what a clock says."""
    data = path.read_bytes()
    if path.name not in ("results.json", "summary.json"):
        return data
    return json.dumps(_without_clocks(json.loads(data))).encode()


def _without_clocks(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_clocks(v) for k, v in value.items() if k not in CLOCKS}
    return [*map(_without_clocks, value)] if isinstance(value, list) else value


def same(one: Path, other: Path) -> None:
    found, expected = kept(one), kept(other)
    assert found.keys() == expected.keys()
    for name, data in expected.items():
        assert found[name] == data, name
    assert any(name.endswith("summary.json") for name in expected)
