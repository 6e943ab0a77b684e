"""Other trainers to measure against, each in an environment of its own.

Nothing of theirs is a dependency: a peer is installed into a folder of the user's cache the first
time it is asked for, and run as a subprocess.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from sauna.experiments.bench.peer_settings import GYMNAX_PEERS
from sauna.system.errors import BadInput, SaunaError

_WITH_JAX = ["jax[cpu]==0.10.2", "distrax==0.1.9", "gymnax==0.0.9"]
# What each peer needs, beside PyTorch where it is not in JAX. CleanRL and PureJaxRL are scripts, of
# which the user names a copy. Both in JAX read five values of a step, and gymnax 1 returns six.
# RLtools finds Intel's MKL by itself; without it, it looks for another BLAS.
PEERS = {
    "sb3": [
        "stable-baselines3==2.9.2",
        "gymnasium[mujoco,box2d]",
        "ale-py",
        "opencv-python-headless",
    ],
    "cleanrl": ["gymnasium[mujoco]", "tyro", "tensorboard"],
    "rltools": [
        "rltools==2.2.1",
        "gymnasium[mujoco]",
        *(f"{name}; platform_machine == 'x86_64'" for name in ("mkl", "mkl-include")),
    ],
    "rl_games": ["rl_games==1.6.5", "envpool==1.2.5"],
    "rejax": ["rejax==0.1.3", *_WITH_JAX],
    "purejaxrl": ["flax", "optax", *_WITH_JAX],
}
# CPU builds of PyTorch have an index of their own; the default one brings gigabytes of CUDA.
_TORCH = (
    ["torch", "--index-url", "https://download.pytorch.org/whl/cpu"],
    ["torch==2.13.0"],
)


def cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base) / "sauna"


def prepare(peer: str, say: Callable[[str], None]) -> Path:
    """Returns the Python interpreter of a peer's environment, made if it is not there.

    Raises:
      BadInput: there is no such peer.
      SaunaError: it cannot be installed; pip's last line says why.
    """
    if peer not in PEERS:
        raise BadInput(f"against: unknown peer {peer!r} (known: {', '.join(PEERS)})")
    folder = cache_folder() / "peers" / peer
    python = folder / "bin" / "python"
    done, wanted = folder / "complete", " ".join(PEERS[peer])
    failed = None
    if not done.exists():
        torch = () if peer in (*GYMNAX_PEERS, "rltools") else _TORCH
        also = " and PyTorch (CPU)" if torch else ""
        say(f"installing {PEERS[peer][0]}{also} into {folder}, once")
        venv.create(folder, with_pip=True, clear=True)
        for attempt in torch:
            failed = _pip(python, attempt)
            if failed is None:
                break
    if not done.exists() or done.read_text() != wanted:
        failed = failed or _pip(python, PEERS[peer])
        if failed is not None:
            raise SaunaError(f"against: {peer} cannot be installed: {failed}")
        done.write_text(wanted)
    return python


def _pip(python: Path, arguments: list[str]) -> str | None:
    """Installs; what went wrong, or None."""
    command = [str(python), "-m", "pip", "install", "--quiet", "--retries", "1", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = done.stderr.strip().splitlines() or ["pip failed"]
    return None if done.returncode == 0 else lines[-1]


def peer_rate(
    peer: str,
    python: Path,
    script: Path | None,
    settings: Mapping[str, Any],
    processes: int,
    seconds: float,
) -> float:
    """Returns env steps per second, summed over `processes` trainings that run at the same time.

    Args:
      script: CleanRL's `ppo_continuous_action.py` or PureJaxRL's `ppo.py`; None for another peer.
      settings: what `peer_settings` gives.

    Raises:
      SaunaError: one of them failed; its last line says why.
    """
    if peer in GYMNAX_PEERS:
        settings = {**settings, "peer": peer, "script": str(script.resolve()) if script else None}
    if peer == "cleanrl" and script is not None:
        measure = partial(_cleanrl, script)
    else:
        measure = partial(_own, peer)
    with ThreadPoolExecutor(processes) as pool:
        each = ({**settings, "seed": seed, "seconds": seconds} for seed in range(processes))
        return sum(pool.map(lambda one: measure(python, one), each))


def _variables() -> dict[str, str]:
    variables = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    variables.pop("PYTHONPATH", None)
    return variables


def _own(peer: str, python: Path, settings: Mapping[str, Any]) -> float:
    """The rate that `peer_NAME.py` prints as JSON on its last line."""
    script = Path(__file__).with_name(f"peer_{'jax' if peer in GYMNAX_PEERS else peer}.py")
    command = [str(python), str(script), json.dumps({**settings, "folder": os.getcwd()})]
    with tempfile.TemporaryDirectory() as folder:  # MuJoCo leaves a log where it is started
        done = subprocess.run(command, capture_output=True, text=True, env=_variables(), cwd=folder)
    if done.returncode:
        raise _failed(done.stderr, done.returncode)
    return float(json.loads(done.stdout.splitlines()[-1])["rate"])


def _cleanrl(script: Path, python: Path, settings: Mapping[str, Any]) -> float:
    """The script prints a line after each update; the first two are not counted."""
    arguments = ["--env-id", settings["env"], "--seed", str(settings["seed"])]
    command = [str(python), "-u", str(script.resolve()), *arguments]
    seen: list[float] = []
    last = ""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=folder,
            env=_variables(),
        )
        assert process.stdout is not None
        for line in process.stdout:
            last = line
            if line.startswith("SPS:"):
                seen.append(time.perf_counter())
                if len(seen) >= 5 and seen[-1] - seen[2] > settings["seconds"]:
                    break
        process.kill()
        process.wait()
    if len(seen) < 4:
        raise _failed(last, process.returncode)
    return 2048 * (len(seen) - 3) / (seen[-1] - seen[2])


def script_digest(script: Path | None) -> dict[str, str]:
    """Names the revision of a peer's script by its SHA-256; nothing for a peer that is none."""
    return {"script": hashlib.sha256(script.read_bytes()).hexdigest()[:12]} if script else {}


def _failed(errors: str, code: int) -> SaunaError:
    lines = errors.strip().splitlines() or [f"exit code {code}"]
    return SaunaError(f"against: the peer failed: {lines[-1]}")


def versions(python: Path) -> dict[str, str]:
    """Returns the versions of what a peer's speed depends on."""
    code = (
        "import importlib.metadata as m, json; "
        "names = {d.name for d in m.distributions()}; "
        "wanted = ('stable_baselines3', 'torch', 'gymnasium', 'mujoco', 'ale-py', 'numpy', "
        "'rejax', 'jax', 'jaxlib', 'flax', 'optax', 'distrax', 'gymnax', "
        "'rltools', 'mkl', 'rl-games', 'envpool'); "
        "print(json.dumps({n: m.version(n) for n in wanted if n in names}))"
    )
    command = [str(python), "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return {"python": sys.version.split()[0], **json.loads(done.stdout)}
