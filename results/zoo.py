"""Trains, evaluates and stores what `sauna train ENV` gives on the zoo's environments.

    python results/zoo.py                    what is missing of `TRAINED`, cheapest first
    python results/zoo.py --only Hopper-v5   these alone (also those of `LEFT_OUT`)
    python results/zoo.py --list             what there is, and what is done

Each environment is one unit: one run of three seeds with the preset and the env steps that
`sauna train` picks (fewer of `SHORTER`), then 20 episodes per seed with the most likely action.
Runs stay in `runs/zoo/`; `results/zoo.json` gets the returns, the times and a thinned curve. A unit
that was interrupted goes on where it was. One whose preset has changed since is trained again.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import resource
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.presets import PRESETS
from sauna.config.zoo import ENVS, OWN, Entry, entry_of
from sauna.experiments.report.curve import member_curves
from sauna.experiments.study.units import digest_of
from sauna.system import run_directory

ROOT = Path(__file__).parent.parent
RUNS = ROOT / "runs" / "zoo"
FILE = ROOT / "results" / "zoo.json"
SEEDS, EPISODES, POINTS = 3, 20, 30
VERSIONS = ("jax", "gymnasium", "mujoco", "numpy")

TRAINED = (  # cheapest first
    "CartPole-v1",
    "gymnax/CartPole-v1",
    "Pendulum-v1",
    "gymnax/Pendulum-v1",
    "MountainCarContinuous-v0",
    "gymnax/MountainCarContinuous-v0",
    "MiniGrid-Empty-Random-5x5-v0",
    "MiniGrid-DoorKey-5x5-v0",
    "MiniGrid-Unlock-v0",
    "gymnax/MountainCar-v0",
    "gymnax/Acrobot-v1",
    "MountainCar-v0",
    "Acrobot-v1",
    "InvertedPendulum-v5",
    "InvertedDoublePendulum-v5",
    "Reacher-v5",
    "Swimmer-v5",
    "Hopper-v5",
    "HalfCheetah-v5",
    "Walker2d-v5",
    "LunarLander-v3",
    "LunarLanderContinuous-v3",
    "Pusher-v5",
    "Ant-v5",
    "PointMaze_UMazeDense-v3",
    "FetchReachDense-v4",
    "Humanoid-v5",
    "HumanoidStandup-v5",
    "MiniGrid-KeyCorridorS3R1-v0",
    "MiniGrid-RedBlueDoors-6x6-v0",
    "gymnax/Breakout-MinAtar",
    "gymnax/SpaceInvaders-MinAtar",
    "gymnax/Freeway-MinAtar",
    "gymnax/Asterix-MinAtar",
    "BipedalWalker-v3",
    "BipedalWalkerHardcore-v3",
    "CarRacing-v3",
)
BY_SPACES = {  # environments that the zoo does not know, for the presets that it picks for such
    "FrozenLake-v1": ("discrete", 200_000),
    "zoo_envs:long_swimmer": ("long-horizon", 1_000_000),
    "zoo_envs:Catch": ("pictures", 200_000),
}
EVERY = (*ENVS, *BY_SPACES)
# Env steps, if those of `sauna train` take long.
SHORTER = {
    "BipedalWalkerHardcore-v3": 5_000_000,
    "MiniGrid-RedBlueDoors-6x6-v0": 400_000,
    "playground/CartpoleBalance": 10_000_000,
}
# Why an environment is not among them, by a pattern of its whole name. `--only` trains it, too.
LEFT_OUT = {
    r"ALE/.+": "days on two cores",
    r"sauna/HumanoidFlagrunHarder-v0": "hours on two cores",
    r"playground/.+": "needs an accelerator",
    r"MiniGrid-(?:FourRooms|GoToDoor|PutNear).+": "hours on two cores",
    r"MiniGrid-(?:LockedRoom|MultiRoom|ObstructedMaze).+": "hours; RL Zoo calls it unsolved",
}


def plan_of(env: str) -> str:
    """Says whether an environment waits for its turn, or why it is left out."""
    if env in (*TRAINED, *BY_SPACES):
        return "waits for its turn"
    return next(why for pattern, why in LEFT_OUT.items() if re.fullmatch(pattern, env))


def planned(env: str) -> Entry:
    """What the zoo knows of an environment, with the env steps that it is trained for here."""
    if env in BY_SPACES:
        return Entry(env, *BY_SPACES[env], OWN)
    entry = entry_of(env)
    assert entry is not None
    return entry._replace(steps=SHORTER.get(env, entry.steps))


def stored() -> dict[str, Any]:
    """Reads `results/zoo.json`: `environment -> unit`."""
    return json.loads(FILE.read_text())["units"] if FILE.exists() else {}


def settings_of(entry: Entry) -> dict[str, Any]:
    """What a unit is trained with; a unit with other settings is out of date."""
    return json.loads(json.dumps({"steps": entry.steps, **PRESETS[entry.preset]}))


def is_done(env: str, entry: Entry) -> bool:
    """Whether today's preset of an environment has been trained and evaluated."""
    return stored().get(env, {}).get("settings") == settings_of(entry)


def store(units: dict[str, Any]) -> None:
    """Writes `results/zoo.json`, one unit a line."""
    lines = (f"{json.dumps(env)}: {json.dumps(unit)}" for env, unit in units.items())
    text = '{"format": 1, "units": {\n' + ",\n".join(lines) + "\n}}\n"
    FILE.with_suffix(".tmp").write_text(text)
    os.replace(FILE.with_suffix(".tmp"), FILE)


def sauna(*arguments: str) -> int:
    """Runs a command of the package under test; returns its exit code."""
    places = [str(ROOT / "src"), str(ROOT / "results"), os.environ.get("PYTHONPATH", "")]
    path = os.pathsep.join(places)
    command = [sys.executable, "-m", "sauna", *arguments]
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": path}).returncode


def train(env: str, entry: Entry, run: Path) -> bool:
    """Trains three seeds, or continues them; notes the seconds of each part.

    Returns:
      whether the run is complete.

    Raises:
      SystemExit: it was stopped.
    """
    notes = run.with_name(f"{run.name}_seconds.json")
    parts = json.loads(notes.read_text()) if notes.exists() else []
    before, cpu = time.monotonic(), _cpu_seconds()
    begun = (run / "config.json").exists()
    seeds = ("--seeds", str(SEEDS), "--steps", str(entry.steps))
    how = ("resume", str(run)) if begun else ("train", env, *seeds)
    code = sauna(*how, *(() if begun else ("--out", str(run))))
    parts.append({"wall": time.monotonic() - before, "cpu": _cpu_seconds() - cpu})
    notes.write_text(json.dumps(parts))
    if code in (130, 143) or code < 0:
        sys.exit(code)
    return code == 0


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measure(entry: Entry, run: Path) -> dict[str, Any]:
    """Evaluates a complete run; returns its unit of `results/zoo.json`.

    Raises:
      SystemExit: the evaluation failed.
    """
    evaluation = run / "evaluation_deterministic.json"
    if not evaluation.exists():
        code = sauna("eval", str(run), "--deterministic", "--episodes", str(EPISODES))
        if code:
            sys.exit(code)
    members = json.loads(evaluation.read_text())["members"]
    config = run_directory.read_config(run)
    parts = json.loads(run.with_name(f"{run.name}_seconds.json").read_text())
    (curves,) = member_curves(run_directory.rows(run)).values()
    return {
        "preset": config["config"]["preset"],
        "steps": config["config"]["steps"],
        "settings": settings_of(entry),
        "episodes": EPISODES,
        "returns": {name: round(row["mean"], 4) for name, row in members.items()},
        "stds": {name: round(row["std"], 4) for name, row in members.items()},
        "wall_seconds": round(sum(part["wall"] for part in parts), 1),
        "cpu_seconds": round(sum(part["cpu"] for part in parts), 1),
        "cores": os.cpu_count(),
        "git": config.get("git"),
        "versions": {"python": platform.python_version(), **{n: version(n) for n in VERSIONS}},
        "curves": {name: _thinned(*curve) for name, curve in curves.items()},
    }


def _thinned(steps: np.ndarray, returns: np.ndarray) -> dict[str, list[float]]:
    chosen = np.unique(np.linspace(0, len(steps) - 1, POINTS).astype(int))
    return {
        "env_steps": [int(steps[i]) for i in chosen],
        "return": [round(float(returns[i]), 3) for i in chosen],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", nargs="+", choices=EVERY, metavar="ENV", default=[])
    parser.add_argument("--list", action="store_true")
    arguments = parser.parse_args()
    RUNS.mkdir(parents=True, exist_ok=True)
    for env in arguments.only or (*BY_SPACES, *TRAINED):
        entry = planned(env)
        if arguments.list:
            print(f"{env:33} {entry.preset:24} {entry.steps:>11,} {'done' * is_done(env, entry)}")
            continue
        if is_done(env, entry):
            continue
        run = RUNS / f"{re.sub('[/:]', '-', env)}_{digest_of(settings_of(entry))}"
        if not run_directory.is_complete(run) and not train(env, entry, run):
            print(f"{env}: failed; the next one", flush=True)
            continue
        unit = measure(entry, run)
        store({**stored(), env: unit})
        print(f"{env}: {unit['returns']} after {unit['wall_seconds']:.0f} s", flush=True)


if __name__ == "__main__":
    main()
