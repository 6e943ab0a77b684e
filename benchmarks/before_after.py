"""Whether PPO became slower between two revisions: `results/ppo_before_after.json`.

    python benchmarks/before_after.py                     (some minutes, on a quiet machine)
    python benchmarks/before_after.py --before 95ce552 --after HEAD --rounds 20

Both revisions train the same member and take turns, ten iterations each; see `turns.py`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from turns import ROOT, Trainer, in_turn

PATH = ROOT / "benchmarks" / "results" / "ppo_before_after.json"
BEFORE = "95ce552"  # the last revision without rules of selection
# Settings, and iterations of one block.
CASES: dict[str, tuple[dict[str, Any], int]] = {
    "HalfCheetah-v5": ({"env": "HalfCheetah-v5", "preset": "mujoco"}, 10),
    "Pong": ({"env": "ALE/Pong-v5", "preset": "atari"}, 2),
    "CartPole on the device": ({"env": "gymnax/CartPole-v1", "preset": "minatar"}, 10),
}


def measure(name: str, before: Path, after: Path, rounds: int) -> dict[str, Any]:
    """CPU seconds of both revisions, block by block, and their ratio after / before."""
    settings, block = CASES[name]
    own = {**settings, "arm": "ppo"}
    trainers = {
        label: Trainer(own, block, source)
        for label, source in (("before", before), ("after", after))
    }
    found = in_turn(trainers, rounds)
    ratios = sorted(b / a for a, b in zip(found["before"], found["after"], strict=True))
    quarter = len(ratios) // 4
    return {
        "iterations_per_block": block,
        "rounds": rounds,
        "cpu_seconds_before": statistics.median(found["before"]),
        "cpu_seconds_after": statistics.median(found["after"]),
        "after_over_before": statistics.median(ratios),
        "least_after_over_least_before": min(found["after"]) / min(found["before"]),
        "middle_half": [ratios[quarter], ratios[-1 - quarter]],
    }


def checkout(revision: str, folder: Path) -> str:
    """Puts a revision's package into `folder`; returns the revision's whole name."""
    git = ["git", "-C", str(ROOT)]
    name = subprocess.check_output([*git, "rev-parse", revision], text=True).strip()
    folder.mkdir()
    archive = subprocess.Popen([*git, "archive", name, "src"], stdout=subprocess.PIPE)
    subprocess.run(["tar", "-x", "-C", str(folder)], stdin=archive.stdout, check=True)
    return name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--before", default=BEFORE)
    parser.add_argument("--after", default="HEAD")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    arguments = parser.parse_args()
    result: dict[str, Any] = json.loads(PATH.read_text()) if PATH.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        old, new = Path(folder) / "before", Path(folder) / "after"
        revisions = {
            "before": checkout(arguments.before, old),
            "after": checkout(arguments.after, new),
        }
        for name in CASES:
            if arguments.only in name:
                result[name] = {**revisions, **measure(name, old, new, arguments.rounds)}
                print(name, json.dumps(result[name]), flush=True)
    PATH.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
