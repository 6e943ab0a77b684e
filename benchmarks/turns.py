"""Trainings that take turns, block of iterations by block, each in a process of its own.

What they are compared by is the CPU time of the process, so that a busy neighbour counts little.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
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

    def stopped(self) -> set[str]:
        return set()

    def iteration(self, iteration: int, rows: list[Any], timing: Any) -> None:
        pass

    def state(self, iteration: int, arrays: Any) -> None:
        pass


def train(settings: dict[str, Any], block: int) -> None:
    """Trains in this process, by whichever revision of the package it imports."""
    own = {"seeds": 1, "processes": 1, "steps": ENDLESS, "checkpoint_every": 10**9}
    settings, turns = {**own, **settings}, Turns(block)
    train_members: Any
    try:
        from sauna.training.prepare import prepare
        from sauna.training.worker import train_members

        job = prepare(settings).job()
    except ImportError:  # as of 95ce552
        job, train_members = job_of_before(settings)
    train_members(job, turns)


def job_of_before(settings: dict[str, Any]) -> Any:
    """The same job, by the names that the package had before its parts had rooms of their own."""
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
    """A process that trains with the package in `source`, `block` iterations at a time."""

    def __init__(self, settings: Mapping[str, Any], block: int, source: Path = ROOT) -> None:
        environment = {**os.environ, "PYTHONPATH": str(source / "src"), "JAX_PLATFORMS": "cpu"}
        self._process = subprocess.Popen(
            [sys.executable, __file__, json.dumps([dict(settings), block])],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._seconds()

    def _seconds(self) -> float:
        assert self._process.stdout is not None
        return float(self._process.stdout.readline())

    def block(self) -> float:
        """Trains one block and returns its CPU seconds."""
        assert self._process.stdin is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()
        return self._seconds()

    def end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def in_turn(trainers: Mapping[str, Trainer], rounds: int) -> dict[str, list[float]]:
    """CPU seconds of each trainer's blocks, round after round; the first, which compiles, is left
    out. Every second round goes backwards. Ends the trainers."""
    found: dict[str, list[float]] = {name: [] for name in trainers}
    try:
        for trainer in trainers.values():
            trainer.block()
        for i in range(rounds):
            for name in list(trainers)[:: 1 if i % 2 else -1]:
                found[name].append(trainers[name].block())
    finally:
        for trainer in trainers.values():
            trainer.end()
    return found


if __name__ == "__main__":
    train(*json.loads(sys.argv[1]))
