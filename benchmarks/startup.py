"""How long the first env step takes to come: `results/startup.json`.

    python benchmarks/startup.py [--rounds 5]      (two minutes, on a quiet machine)

The time runs from the command `sauna train` to the first env step, and to the first row of metrics,
with one seed. *Cold* begins with empty caches, as the first run after an installation does. *Warm*
is a second run of the same settings: what XLA and Numba compiled is read from their caches. `import
sauna` is timed by itself, in new interpreters.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from sauna.experiments.bench.command import start_and_memory
from sauna.system import run_directory

PATH = Path(__file__).resolve().parent / "results" / "startup.json"
CASES: dict[str, dict[str, Any]] = {
    "HalfCheetah-v5": {"env": "HalfCheetah-v5", "preset": "mujoco"},
    "CartPole-v1": {"env": "CartPole-v1", "preset": "auto"},
    "gymnax/Breakout-MinAtar": {"env": "gymnax/Breakout-MinAtar", "preset": "minatar"},
}


MOMENTS = ("seconds_to_first_env_step", "seconds_to_first_row")


def seconds(settings: dict[str, Any]) -> list[float]:
    found = start_and_memory({**settings, "seeds": 1, "processes": 1})
    return [found[moment] for moment in MOMENTS]


def measure(settings: dict[str, Any], rounds: int) -> dict[str, list[list[float]]]:
    """The `MOMENTS` of each start: cold and then warm, with caches that are new in each round."""
    found: dict[str, list[list[float]]] = {"cold": [], "warm": []}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            os.environ |= {"XDG_CACHE_HOME": folder, "NUMBA_CACHE_DIR": f"{folder}/numba"}
            for values in found.values():
                values.append(seconds(settings))
    return found


def import_seconds(rounds: int) -> list[float]:
    code = "import time; t = time.perf_counter(); import sauna; print(time.perf_counter() - t)"
    command = [sys.executable, "-c", code]
    return [float(subprocess.check_output(command, text=True)) for _ in range(rounds)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    result: dict[str, Any] = {
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
        "import_seconds": import_seconds(rounds),
        "moments": MOMENTS,
        "starts": {},
    }
    for name, settings in CASES.items():
        result["starts"][name] = measure(settings, rounds)
        print(name, json.dumps(result["starts"][name]), flush=True)
    PATH.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
