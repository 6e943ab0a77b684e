"""Fine-tunes a Hopper that stands so that it runs, beside one that starts anew.

    python results/fine_tuning.py       minutes; continues where it stopped

Three seeds train on Hopper-v5 without a reward for moving. Each then trains on the usual reward
with `--init-from`, and three others train on it from fresh weights for as many env steps. All are
evaluated on the usual reward: 20 episodes per seed with the most likely action. What is found goes
into `results/fine_tuning.json`.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from zoo import EPISODES, ROOT, SEEDS, sauna

from sauna.experiments.evaluate.episodes import evaluate
from sauna.system import run_directory

ENV, STEPS = "Hopper-v5", 300_000
STANDING = '{"forward_reward_weight": 0}'
RUNS = ROOT / "runs" / "fine_tuning"
FILE = ROOT / "results" / "fine_tuning.json"
ARMS: dict[str, tuple[str, ...]] = {
    "standing": ("--env-kwargs", STANDING),
    "fine-tuned": ("--init-from", str(RUNS / "standing")),
    "from fresh weights": (),
}


def flags_of(arm: str) -> tuple[str, ...]:
    """Gives the flags of a training as a reader would type them."""
    own = tuple(part.replace(f"{ROOT}/", "") for part in ARMS[arm])
    return (ENV, "--arm", "ppo", "--seeds", str(SEEDS), "--steps", str(STEPS), *own)


def measure(arm: str) -> dict[str, Any]:
    """Trains an arm, or continues it, and evaluates it on the usual reward.

    Raises:
      SystemExit: the training failed or was stopped.
    """
    run = RUNS / arm.replace(" ", "_")
    if not run_directory.is_complete(run):
        begun = (run / "config.json").exists()
        how = ("resume", str(run)) if begun else ("train", *flags_of(arm), "--out", str(run))
        if code := sauna(*how):
            sys.exit(code)
    usual = {"forward_reward_weight": 1}
    members = evaluate(run, episodes=EPISODES, deterministic=True, env_kwargs=usual)["members"]
    return {
        "command": f"sauna train {' '.join(flags_of(arm))}",
        "returns": [round(row["mean"], 2) for row in members.values()],
        "lengths": [round(row["length_mean"], 1) for row in members.values()],
    }


def main() -> None:
    RUNS.mkdir(parents=True, exist_ok=True)
    found = {
        "env": ENV,
        "steps": STEPS,
        "episodes": EPISODES,
        "versions": run_directory.versions(),
        "arms": {arm: measure(arm) for arm in ARMS},
    }
    FILE.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
