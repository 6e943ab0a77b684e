"""Whether PPO became slower between two revisions: `results/ppo_before_after.json`.

    python benchmarks/before_after.py                     (some minutes, on a quiet machine)
    python benchmarks/before_after.py --before 95ce552 --after HEAD --rounds 20

Both revisions train the same members in a process of their own. They take turns: a block of
iterations of one, then of the other. What is compared is the CPU time of the process, so that a
busy neighbour counts little. The first block, which compiles, is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PATH = ROOT / "benchmarks" / "results" / "ppo_before_after.json"
BEFORE = "95ce552"  # the last revision without rules of selection
CASES: dict[str, dict[str, Any]] = {
    "HalfCheetah-v5": {"env": "HalfCheetah-v5", "preset": "mujoco"},
    "Pong": {"env": "ALE/Pong-v5", "preset": "atari"},
    "CartPole on the device": {
        "env": "gymnax/CartPole-v1",
        "preset": "minatar",
        "normalize_observations": True,
    },
}
ITERATIONS = {"HalfCheetah-v5": 10, "Pong": 2, "CartPole on the device": 10}  # of one block
ENDLESS = 2_000_000_000 - 1  # env steps


class Turns:
    """A reporter that trains one block of iterations for each line that it reads."""

    def __init__(self, block: int) -> None:
        self.block, self.began = block, time.process_time()

    def phase(self, text: str) -> None:
        pass

    def allowance(self, iteration: int) -> int:
        if iteration % self.block == 0:
            print(time.process_time() - self.began, flush=True)
            if sys.stdin.readline() != "go\n":
                return 0
            self.began = time.process_time()
        return self.block - iteration % self.block

    def iteration(self, iteration: int, rows: list[Any], timing: Any) -> None:
        pass

    def state(self, iteration: int, arrays: Any) -> None:
        pass


def train(name: str) -> None:
    """Trains in this process, whichever revision it imports."""
    settings = {**CASES[name], "arm": "ppo", "seeds": 1, "processes": 1, "steps": ENDLESS}
    settings["checkpoint_every"] = 10**9
    turns: Any = Turns(ITERATIONS[name])
    try:
        from sauna.training.prepare import prepare
        from sauna.training.worker import train_members

        job = prepare(settings).job()
    except ImportError:  # as of 95ce552
        job, train_members = job_of_before(settings)
    train_members(job, turns)


def job_of_before(settings: dict[str, Any]) -> Any:
    from importlib import import_module

    placement, presets = import_module("sauna.placement"), import_module("sauna.presets")
    training = import_module("sauna.training")
    config = placement.placed(presets.resolve(settings))
    found = placement.look_at(config)
    config = import_module("sauna.run").settle(config, found.spaces)
    members = presets.members(config, settings)
    job = training.Job(config, found.spaces, {}, members, [], None, 0, found.differs is None)
    return job, training.train_members


class Trainer:
    """A process that trains `name` with the package in `source`."""

    def __init__(self, source: Path, name: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(source / "src"), "JAX_PLATFORMS": "cpu"}
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--train", name],
            env=environment,
            cwd=source,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.seconds()

    def seconds(self) -> float:
        assert self.process.stdout is not None
        return float(self.process.stdout.readline())

    def block(self) -> float:
        """Trains one block and returns its CPU seconds."""
        assert self.process.stdin is not None
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        return self.seconds()

    def end(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def measure(name: str, before: Path, after: Path, rounds: int) -> dict[str, Any]:
    """CPU seconds of both revisions, block by block, and their ratio after / before."""
    trainers = [Trainer(before, name), Trainer(after, name)]
    try:
        for trainer in trainers:
            trainer.block()  # compiles
        found: list[list[float]] = [[], []]
        for i in range(rounds):
            for which in (0, 1) if i % 2 else (1, 0):
                found[which].append(trainers[which].block())
    finally:
        for trainer in trainers:
            trainer.end()
    ratios = sorted(b / a for a, b in zip(*found, strict=True))
    quarter = len(ratios) // 4
    return {
        "iterations_per_block": ITERATIONS[name],
        "cpu_seconds_before": statistics.median(found[0]),
        "cpu_seconds_after": statistics.median(found[1]),
        "after_over_before": statistics.median(ratios),
        "middle_half": [ratios[quarter], ratios[-1 - quarter]],
        "rounds": len(ratios),
    }


def checkout(revision: str, folder: Path) -> tuple[str, Path]:
    """Puts a revision's files into `folder`; returns its whole name, and the folder."""
    git = ["git", "-C", str(ROOT)]
    name = subprocess.check_output([*git, "rev-parse", revision], text=True).strip()
    folder.mkdir()
    archive = subprocess.Popen([*git, "archive", name, "src"], stdout=subprocess.PIPE)
    subprocess.run(["tar", "-x", "-C", str(folder)], stdin=archive.stdout, check=True)
    return name, folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--before", default=BEFORE)
    parser.add_argument("--after", default="HEAD")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--train", default="", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.train:
        train(arguments.train)
        return
    result: dict[str, Any] = json.loads(PATH.read_text()) if PATH.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        before, old = checkout(arguments.before, Path(folder) / "before")
        after, new = checkout(arguments.after, Path(folder) / "after")
        for name in CASES:
            if arguments.only in name:
                measured = measure(name, old, new, arguments.rounds)
                result[name] = {"before": before, "after": after, **measured}
                print(name, json.dumps(result[name]), flush=True)
    PATH.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
