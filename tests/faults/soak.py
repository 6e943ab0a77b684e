"""A long run of a population, watched from outside: do memory and open files stay flat?

    python tests/faults/soak.py                      two hours; results/soak.json
    python tests/faults/soak.py --minutes 3 --trial  a short trial; nothing is stored

The run is an ordinary `sauna train` in its own folder; where the folder holds one already, it is
resumed. What is measured is the whole family of processes: resident memory, open file descriptors,
threads. Slopes are fitted to the means of twenty blocks of time, after the first tenth.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]
RESULTS = ROOT / "results" / "soak.json"
EVERY = 5.0  # seconds between two samples
BLOCKS = 20
WARM_UP = 0.1  # share of the samples that the slopes leave out
POINTS = 120  # samples that are stored
MEASURED = {"memory": "MiB", "files": "open files", "threads": "threads"}


def family(pid: int) -> list[int]:
    from faults.chain import children

    return [pid, *children(pid)]


def sample(pid: int) -> dict[str, float]:
    """Sums over the run's processes; one that ends meanwhile counts for nothing."""
    total = dict.fromkeys(MEASURED, 0.0)
    for member in family(pid):
        place = Path(f"/proc/{member}")
        try:
            status = (place / "status").read_text()
            total["memory"] += _field(status, "VmRSS") / 1024
            total["threads"] += _field(status, "Threads")
            total["files"] += len(os.listdir(place / "fd"))
        except (FileNotFoundError, ProcessLookupError):
            continue
    return total


def _field(status: str, name: str) -> float:
    found = [line.split()[1] for line in status.splitlines() if line.startswith(f"{name}:")]
    return float(found[0]) if found else 0.0


def slope(hours: np.ndarray, values: np.ndarray) -> dict[str, float]:
    """Change per hour with its 95% interval, from the means of blocks of neighbouring samples.

    Samples close in time are alike; means of blocks are nearly independent.
    """
    import scipy.stats

    x, y = (np.array([part.mean() for part in np.array_split(v, BLOCKS)]) for v in (hours, values))
    change, half = 0.0, 0.0
    if np.ptp(y) > 0:  # what never changes has no correlation, and a slope of 0
        fit = scipy.stats.linregress(x, y)
        change = float(fit.slope)
        half = float(scipy.stats.t.isf(0.025, BLOCKS - 2)) * float(fit.stderr)
    return {
        "mean": float(values.mean()),
        "largest": float(values.max()),
        "per_hour": change,
        "low": change - half,
        "high": change + half,
    }


def watch(command: list[str], minutes: float) -> tuple[list[dict[str, float]], int]:
    """Samples of the run while it runs, and how it ended after SIGTERM."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    samples: list[dict[str, float]] = []
    start, shown = time.monotonic(), 0.0
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process:
        while (spent := time.monotonic() - start) < 60 * minutes and process.poll() is None:
            time.sleep(EVERY)
            samples.append({"hours": spent / 3600, **sample(process.pid)})
            if spent - shown > 60:
                shown = spent
                print({name: round(value, 3) for name, value in samples[-1].items()}, flush=True)
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    return samples, process.returncode


def report(samples: list[dict[str, float]]) -> dict[str, Any]:
    kept = samples[math.ceil(WARM_UP * len(samples)) :]
    hours = np.array([row["hours"] for row in kept])
    return {name: slope(hours, np.array([row[name] for row in kept])) for name in MEASURED}


def thinned(samples: list[dict[str, float]]) -> list[dict[str, float]]:
    chosen = np.unique(np.linspace(0, len(samples) - 1, POINTS).astype(int)).tolist()
    return [{name: round(value, 4) for name, value in samples[i].items()} for i in chosen]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--arm", default="sauna")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--folder", help="of the run (default: a new one)")
    parser.add_argument("--trial", action="store_true", help="store nothing")
    given = parser.parse_args()
    run = Path(given.folder or tempfile.mkdtemp()) / "run"
    settings = [given.env, f"--arm={given.arm}", f"--seeds={given.seeds}", "--steps=1e9"]
    command = [sys.executable, "-m", "sauna", "train", *settings, "--out", str(run)]
    if (run / "config.json").exists():
        command = [sys.executable, "-m", "sauna", "resume", str(run)]
    samples, code = watch(command, given.minutes)
    from sauna.system import run_directory

    rows = run_directory.rows(run)
    found = {
        "command": "sauna train " + " ".join(settings),
        "hours": samples[-1]["hours"],
        "exit_code": code,
        "env_steps": sum({row["member"]: row["env_steps"] for row in rows}.values()),
        "slopes": report(samples),
        "samples": thinned(samples),
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
    }
    print(
        json.dumps(
            {key: found[key] for key in ("hours", "exit_code", "env_steps", "slopes")}, indent=1
        )
    )
    if not given.trial:
        RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    return 0 if code == 128 + signal.SIGTERM else 1


if __name__ == "__main__":
    sys.exit(main())
