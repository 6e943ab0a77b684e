"""Searches by `sauna tune` from a poor start, and populations beside random searches.

    python results/tune.py              trains what is missing under runs/, then writes the numbers
    python results/tune.py --collect    adds what runs/ holds to `results/tune.json`

On a shared core the whole takes about two hours.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sauna.experiments.tune.fresh import verdict

ROOT = Path(__file__).parent.parent
START = "--preset mujoco --learning-rate 1e-5"  # 300 times less than the preset's
TRIALS, MEMBERS, LOCKSTEP = 40, 8, 8
TOGETHER = f"--lockstep {LOCKSTEP}"
GSDE = "--distribution gsde --sde-sample-freq 4 --envs 4 --steps 1e5 --finalists 8"
SEARCHES = {
    "Pendulum-v1": f"Pendulum-v1 {START} --envs 4 --steps 1e5 {TOGETHER}",
    "Pendulum-v1, 2 seeds a trial": (
        f"Pendulum-v1 {START} --envs 4 --steps 1e5 --seeds 2 {TOGETHER}"
    ),
    # The preset's exploration, too, and twice as many finalists. Then more shapes of the program.
    "Pendulum-v1, gSDE": f"Pendulum-v1 {START} {GSDE} {TOGETHER}",
    "Pendulum-v1, 2 seeds a trial, gSDE, lockstep 2": (
        f"Pendulum-v1 {START} {GSDE} --seeds 2 --lockstep 2"
    ),
    "Pendulum-v1, gSDE, lockstep 4, six settings": (
        f"Pendulum-v1 {START} {GSDE} --lockstep 4 --space runs/narrow.toml"
    ),
    # Five seeds had left it open how the last of these stands beside the preset.
    "Pendulum-v1, gSDE, lockstep 2": f"Pendulum-v1 {START} {GSDE} --lockstep 2 --fresh-seeds 20",
    "LunarLander-v3": (
        f"LunarLander-v3 {START} --envs 16 --rollout-steps 256 --steps 1e5 {TOGETHER}"
    ),
}
SPACE = """
learning_rate = {low = 1e-5, high = 1e-2, log = true}
clip_range = [0.1, 0.2, 0.3, 0.4]
gamma = [0.9, 0.95, 0.98, 0.99, 0.995, 0.999]
gae_lambda = [0.8, 0.9, 0.95, 0.98, 1.0]
entropy_coef = {low = 1e-8, high = 0.1, log = true}
value_coef = {low = 0.1, high = 2.0}
max_grad_norm = [0.3, 0.5, 1.0, 2.0, 5.0]
"""
NARROW = """
learning_rate = {low = 1e-5, high = 1e-2, log = true}
gamma = [0.9, 0.95, 0.98, 0.99, 0.995]
gae_lambda = [0.8, 0.9, 0.95, 0.98]
rollout_steps = [128, 256, 512, 1024]
batch_size = [32, 64, 128, 256]
epochs = [5, 10, 20]
"""
SEEDS = range(3)
EQUAL = (
    f"Pendulum-v1 {START} --envs 4 --rollout-steps 128 --minibatches 4 --epochs 5 --steps 4e4 "
    f"--trials {MEMBERS} --finalists 1 --fresh-seeds 0 --space runs/traced.toml"
)
KINDS = {
    "population": "--population-based --exchange-every 4096",
    "random": "--search random --pruner none --lockstep 8",
}
OF_ROWS = ("label", "seeds", "failed", "final_mean", "final_std", "env_steps")
KEPT = ("number", "state", "return", "env_steps", "searched", "error")


def commands() -> dict[str, str]:
    """Lists every command, by the name of its results."""
    found = {name: f"sauna tune {own} --trials {TRIALS}" for name, own in SEARCHES.items()}
    for seed in SEEDS:
        for kind, more in KINDS.items():
            found[f"{kind} {seed}"] = f"sauna tune {EQUAL} {more} --seed {seed}"
    return found


def collect(stored: Mapping[str, Any], runs: Path) -> dict[str, Any]:
    """Adds what the tunings in a folder have found to what is stored.

    A stored part stays, with its command, unless the folder has one that was finished later. A
    tuning that has not ended is left out.
    """
    searches = dict(stored.get("searches", {}))
    equal = {kind: dict(stored.get("equal_steps", {}).get(kind, {})) for kind in KINDS}
    held = {*searches, *(f"{kind} {seed}" for kind, parts in equal.items() for seed in parts)}
    typed = commands() | {name: stored["commands"][name] for name in held}
    for path in sorted(runs.glob("tune_*/results.json"), key=finished):
        found, when = json.loads(path.read_text()), finished(path)
        plan = found["tune"]
        if "rollout_steps" in plan["values"]:
            name = command = name_of(found)
            parts, part = searches, search(found, path.parent)
            has_ended = len(part["trials"]) >= TRIALS and part["verdict"]["believed"] is not None
        else:
            kind, name = "population" if plan["exchange_every"] else "random", str(plan["seeds"][0])
            command = f"{kind} {name}"
            parts, part = equal[kind], of_equal(found)
            has_ended = len(part["returns"]) >= MEMBERS and None not in part["returns"]
        if has_ended and when > parts.get(name, {}).get("finished", ""):
            parts[name] = {**part, "finished": when}
            typed[command] = found["command"]
    return {"commands": typed, "searches": searches, "equal_steps": equal}


def name_of(found: Mapping[str, Any]) -> str:
    """The name in `SEARCHES` of a tuning: the environment, and what sets it apart."""
    plan = found["tune"]
    seeds, lockstep = len(plan["seeds"]), plan["lockstep"]
    apart = {
        f"{seeds} seeds a trial": seeds > 1,
        "gSDE": "gsde" in found["command"],
        f"lockstep {lockstep}": lockstep != LOCKSTEP,
        "six settings": "narrow.toml" in found["command"],
    }
    return ", ".join([found["env"], *(words for words, holds in apart.items() if holds)])


def of_equal(found: Mapping[str, Any]) -> dict[str, Any]:
    """Keeps of a population, or of a search with as many env steps, what the page shows."""
    return {
        "returns": [trial["return"] for trial in found["trials"]],
        "env_steps": found["env_steps"]["trials"],
        "exchanges": len(found["exchanges"]),
    }


def finished(results: Path) -> str:
    """When a tuning wrote its results last, in UTC."""
    return datetime.fromtimestamp(results.stat().st_mtime, UTC).isoformat(timespec="seconds")


def search(found: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Keeps of a search what the page shows, and the table of trials.

    Before there were finalists, the trial of the highest score was tried on the fresh seeds.
    """
    earlier = [
        row
        for path in folder.glob("fresh_*/summary.json")
        if path.parent.name not in found["fresh"].get("report", "")
        for row in json.loads(path.read_text())["table"]
        if row["label"] == "tuned"
    ]
    kept = ("metric", "steps", "env_steps", "importance", "fresh_seeds", "versions")
    tables = {
        name: [{key: row[key] for key in OF_ROWS} for row in found[name].get("table", [])]
        for name in ("finalists", "fresh")
    }
    highest = [{key: row[key] for key in OF_ROWS} for row in earlier]
    return {
        **{name: found[name] for name in kept},
        "verdict": verdict(found["fresh"]),  # as it is judged today
        "best": found["best"] and found["best"]["number"],
        "settings": found["best"] and found["best"]["settings"],
        **tables,
        "highest_score_on_fresh_seeds": highest,
        "verdicts": [said["text"] for said in found["fresh"].get("verdicts", [])],
        "trials": [{key: t[key] for key in KEPT if key in t} for t in found["trials"]],
    }


def main() -> None:
    if "--collect" not in sys.argv:
        Path("runs").mkdir(exist_ok=True)
        Path("runs/traced.toml").write_text(SPACE)
        Path("runs/narrow.toml").write_text(NARROW)
        for command in commands().values():
            subprocess.run([sys.executable, "-m", *shlex.split(command)], check=True)
    path = ROOT / "results" / "tune.json"
    found = collect(json.loads(path.read_text()) if path.exists() else {}, Path("runs"))
    path.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
