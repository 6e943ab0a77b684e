"""Other trainers to measure against, each in an environment of its own.

Nothing of theirs is a dependency: a peer is installed into a folder of the user's cache the first
time it is asked for, and run as a subprocess.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from collections.abc import Callable
from pathlib import Path

from sauna.errors import BadInput, SaunaError

PEERS = ("sb3",)
# CPU builds of PyTorch have an index of their own; the default one brings gigabytes of CUDA.
_TORCH = (
    ["torch", "--index-url", "https://download.pytorch.org/whl/cpu"],
    ["torch==2.13.0"],
)
_SB3 = ["stable-baselines3==2.9.2", "gymnasium[mujoco]"]


def cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base) / "sauna"


def prepare(peer: str, say: Callable[[str], None]) -> Path:
    """The Python interpreter of a peer's environment, made if it is not there.

    Raises:
      BadInput: there is no such peer.
      SaunaError: it cannot be installed; pip's last line says why.
    """
    if peer not in PEERS:
        raise BadInput(f"against: unknown peer {peer!r} (known: {', '.join(PEERS)})")
    folder = cache_folder() / "peers" / peer
    python = folder / "bin" / "python"
    if not (folder / "complete").exists():
        say(f"installing Stable-Baselines3 and PyTorch (CPU) into {folder}, once")
        venv.create(folder, with_pip=True, clear=True)
        for attempt in _TORCH:
            failed = _pip(python, attempt)
            if failed is None:
                break
        failed = failed or _pip(python, _SB3)
        if failed is not None:
            raise SaunaError(f"against: {peer} cannot be installed: {failed}")
        (folder / "complete").touch()
    return python


def _pip(python: Path, arguments: list[str]) -> str | None:
    """Installs; what went wrong, or None."""
    command = [str(python), "-m", "pip", "install", "--quiet", "--retries", "1", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = done.stderr.strip().splitlines() or ["pip failed"]
    return None if done.returncode == 0 else lines[-1]


def peer_rate(python: Path, env: str, processes: int, seconds: float) -> float:
    """Env steps per second, summed over `processes` trainings that run at the same time.

    Raises:
      SaunaError: one of them failed; its last line says why.
    """
    script = Path(__file__).with_name("peer_sb3.py")
    variables = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    variables.pop("PYTHONPATH", None)
    started = [
        subprocess.Popen(
            [str(python), str(script), env, str(seed), str(seconds)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=variables,
        )
        for seed in range(processes)
    ]
    rate = 0.0
    for process in started:
        out, err = process.communicate()
        if process.returncode:
            lines = err.strip().splitlines() or [f"exit code {process.returncode}"]
            raise SaunaError(f"against: the peer failed: {lines[-1]}")
        rate += json.loads(out.splitlines()[-1])["rate"]
    return rate


def versions(python: Path) -> dict[str, str]:
    """Of what a peer's speed depends on."""
    names = ("stable-baselines3", "torch", "gymnasium", "mujoco", "numpy")
    code = ("import importlib.metadata as m, json, sys; "
            "print(json.dumps({n: m.version(n) for n in sys.argv[1:]}))")  # fmt: skip
    command = [str(python), "-c", code, *names]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return {"python": sys.version.split()[0], **json.loads(done.stdout)}
