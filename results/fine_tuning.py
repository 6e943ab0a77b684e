"""Fine-tunes Hoppers on another reward, beside some that start anew on it.

    python results/fine_tuning.py       minutes; continues where it stopped

A Hopper that has learned to stand learns to run, and one that runs learns to run backwards. Each
trains three seeds with `--init-from`; three others train on the same reward from fresh weights, for
as many env steps. Evaluations are of that reward: 20 episodes per seed with the most likely action.
What is found goes into `results/fine_tuning.json`.
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
STAND, RUN, BACKWARDS = 0, 1, -1  # weights of the reward for moving forward


class Arm(NamedTuple):
    """A training, and the reward that it is evaluated on."""

    trained_on: int
    evaluated_on: int
    start: str = ""  # the arm whose weights it starts from


ARMS = {
    "standing": Arm(STAND, RUN),
    "running, from the standing Hopper": Arm(RUN, RUN, "standing"),
    "running, from fresh weights": Arm(RUN, RUN),
    "the same, evaluated on running backwards": Arm(RUN, BACKWARDS),
    "backwards, from the running Hopper": Arm(BACKWARDS, BACKWARDS, "running, from fresh weights"),
    "backwards, from fresh weights": Arm(BACKWARDS, BACKWARDS),
}


def run_of(arm: Arm) -> Path:
    """Gives the folder of a training; arms that differ in their evaluation alone share it."""
    start = f"_from_{ARMS[arm.start].trained_on}" if arm.start else ""
    return RUNS / f"reward_{arm.trained_on}{start}"


def flags_of(arm: Arm) -> tuple[str, ...]:
    """Gives the flags of a training as a reader would type them."""
    own = ()
    if arm.trained_on != RUN:
        own = ("--env-kwargs", json.dumps({"forward_reward_weight": arm.trained_on}))
    if arm.start:
        own = (*own, "--init-from", str(run_of(ARMS[arm.start]).relative_to(ROOT)))
    own = (*own, "--out", str(run_of(arm).relative_to(ROOT)))
    return (ENV, "--arm", "ppo", "--seeds", str(SEEDS), "--steps", str(STEPS), *own)


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
    reward = {"forward_reward_weight": arm.evaluated_on}
    members = evaluate(run, episodes=EPISODES, deterministic=True, env_kwargs=reward)["members"]
    return {
        "command": f"sauna train {shlex.join(flags_of(arm))}",
        "returns": [round(row["mean"], 2) for row in members.values()],
        "lengths": [round(row["length_mean"], 1) for row in members.values()],
    }


def main() -> None:
    os.chdir(ROOT)  # `--init-from` names a folder of it
    RUNS.mkdir(parents=True, exist_ok=True)
    found = {
        "env": ENV,
        "steps": STEPS,
        "episodes": EPISODES,
        "versions": run_directory.versions(),
        "arms": {name: measure(arm) for name, arm in ARMS.items()},
    }
    FILE.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
