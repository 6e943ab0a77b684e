"""Seconds of training beside Stable-Baselines3's, with the same numbers, one after the other.

    nice -n 10 python results/zoo_seconds.py

Five tasks, three seeds, 10^5 env steps each, two processes. Both sides take the same preset. What
is found goes into `results/zoo_seconds.json`; a task that is there is not run again.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from zoo import ROOT, SEEDS, sauna

from sauna.config.presets import resolve
from sauna.config.settings import to_json
from sauna.experiments.bench.peers import prepare, versions
from sauna.system import run_directory

FILE = ROOT / "results" / "zoo_seconds.json"
TASKS = ("CartPole-v1", "Pendulum-v1", "Acrobot-v1", "InvertedPendulum-v5", "Hopper-v5")
STEPS, PROCESSES = 100_000, 2


def ours(env: str, folder: Path) -> dict[str, float]:
    """Trains three seeds; seconds from the command to its end, and the mean training return.

    Raises:
      SystemExit: it failed.
    """
    run, before = folder / "run", time.monotonic()
    flags = ("--seeds", str(SEEDS), "--steps", str(STEPS), "--processes", str(PROCESSES))
    code = sauna("train", env, *flags, "--out", str(run))
    seconds = time.monotonic() - before
    if code:
        raise SystemExit(code)
    members = run_directory.read_config_file(run / "summary.json")["members"].values()
    return {
        "seconds": seconds,
        "return": sum(row["return_mean"] for row in members) / len(members),
    }


def theirs(env: str, python: Path, folder: Path) -> dict[str, float]:
    """The same with Stable-Baselines3, two processes at a time."""
    settings = to_json(resolve({"env": env, "preset": "auto", "steps": STEPS}))
    script = str(Path(__file__).with_name("zoo_peer.py"))

    def train(seed: int) -> float:
        command = [str(python), script, json.dumps({**settings, "seed": seed})]
        variables = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": ""}
        done = subprocess.run(
            command, cwd=folder, env=variables, capture_output=True, text=True, check=True
        )
        return float(json.loads(done.stdout.splitlines()[-1])["return"])

    before = time.monotonic()
    with ThreadPoolExecutor(PROCESSES) as pool:
        returns = list(pool.map(train, range(SEEDS)))
    return {"seconds": time.monotonic() - before, "return": sum(returns) / len(returns)}


def main() -> None:
    found: dict[str, Any] = json.loads(FILE.read_text()) if FILE.exists() else {"tasks": {}}
    python = prepare("sb3", print)
    found |= {"steps": STEPS, "seeds": SEEDS, "versions": versions(python)}
    for env in TASKS:
        if env in found["tasks"]:
            continue
        with tempfile.TemporaryDirectory() as folder:
            pair = {"ours": ours(env, Path(folder)), "sb3": theirs(env, python, Path(folder))}
        found["tasks"][env] = {
            side: {name: round(value, 2) for name, value in numbers.items()}
            for side, numbers in pair.items()
        }
        FILE.write_text(json.dumps(found, indent=1) + "\n")
        print(env, found["tasks"][env], flush=True)


if __name__ == "__main__":
    main()
