"""Fine-tunes Hoppers on another reward, beside some that start anew on it.

    python results/fine_tuning.py       minutes; continues where it stopped

A Hopper that has learned to stand learns to run, and one that runs learns to run backwards, and to
run with less effort. Each trains three seeds with `--init-from`; three others train on the same
reward from fresh weights, for as many env steps. Evaluations are of that reward: 20 episodes per
seed with the most likely action. Speeds are of the same episodes, by a reward that counts the way
alone. What is found goes into `results/fine_tuning.json`.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
from pathlib import Path
from typing import Any, NamedTuple

from zoo import EPISODES, ROOT, SEEDS, sauna

from sauna.experiments.evaluate.episodes import evaluate
from sauna.system import run_directory

ENV, STEPS = "Hopper-v5", 300_000
RUNS = ROOT / "runs" / "fine_tuning"
FILE = ROOT / "results" / "fine_tuning.json"
# What each reward changes in that of the task.
REWARDS: dict[str, dict[str, float]] = {
    "stand": {"forward_reward_weight": 0},
    "run": {},
    "backwards": {"forward_reward_weight": -1},
    "thrifty": {"ctrl_cost_weight": 0.5},
}
WAY = {"forward_reward_weight": 1, "healthy_reward": 0, "ctrl_cost_weight": 0}


class Arm(NamedTuple):
    """A training, and the reward that it is evaluated on."""

    trained_on: str
    evaluated_on: str
    start: str = ""  # the arm whose weights it starts from


RUNNING = "running, from fresh weights"
ARMS = {
    "standing": Arm("stand", "run"),
    "running, from the standing Hopper": Arm("run", "run", "standing"),
    RUNNING: Arm("run", "run"),
    "the same, evaluated on thrifty running": Arm("run", "thrifty"),
    "thrifty running, from the running Hopper": Arm("thrifty", "thrifty", RUNNING),
    "thrifty running, from fresh weights": Arm("thrifty", "thrifty"),
    "the running Hopper, evaluated on running backwards": Arm("run", "backwards"),
    "backwards, from the running Hopper": Arm("backwards", "backwards", RUNNING),
    "backwards, from fresh weights": Arm("backwards", "backwards"),
}


def run_of(arm: Arm) -> Path:
    """Gives the folder of a training; arms that differ in their evaluation alone share it."""
    start = f"_from_{ARMS[arm.start].trained_on}" if arm.start else ""
    return RUNS / f"{arm.trained_on}{start}"


def flags_of(arm: Arm) -> tuple[str, ...]:
    """Gives the flags of a training as a reader would type them."""
    reward = REWARDS[arm.trained_on]
    own = ("--env-kwargs", json.dumps(reward)) if reward else ()
    if arm.start:
        own = (*own, "--init-from", str(run_of(ARMS[arm.start]).relative_to(ROOT)))
    own = (*own, "--out", str(run_of(arm).relative_to(ROOT)))
    return (ENV, "--arm", "ppo", "--seeds", str(SEEDS), "--steps", str(STEPS), *own)


def played(run: Path, change: dict[str, float]) -> list[dict[str, Any]]:
    """Evaluates each seed of a run on the task's own reward with a change."""
    usual = {"forward_reward_weight": 1, "healthy_reward": 1, "ctrl_cost_weight": 1e-3}
    reward = {**usual, **change}  # said in full, as a run's own keywords stay otherwise
    found = evaluate(run, episodes=EPISODES, deterministic=True, env_kwargs=reward)
    return list(found["members"].values())


def measure(arm: Arm) -> dict[str, Any]:
    """Trains an arm, or continues it, and evaluates it.

    Raises:
      SystemExit: the training failed or was stopped.
    """
    run = run_of(arm)
    if not run_directory.is_complete(run):
        begun = (run / "config.json").exists()
        how = ("resume", str(run)) if begun else ("train", *flags_of(arm))
        if code := sauna(*how):
            sys.exit(code)
    own, way = played(run, REWARDS[arm.evaluated_on]), played(run, WAY)
    return {
        "command": f"sauna train {shlex.join(flags_of(arm))}",
        "returns": [round(row["mean"], 2) for row in own],
        "lengths": [round(row["length_mean"], 1) for row in own],
        "speeds": [round(row["mean"] / row["length_mean"], 3) for row in way],
    }


def main() -> None:
    os.chdir(ROOT)  # `--init-from` names a folder of it
    RUNS.mkdir(parents=True, exist_ok=True)
    found = {
        "env": ENV,
        "steps": STEPS,
        "episodes": EPISODES,
        "versions": run_directory.versions(),
        "git": run_directory.git_revision(),
        "arms": {name: measure(arm) for name, arm in ARMS.items()},
    }
    FILE.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
