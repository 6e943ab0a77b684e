"""Clones a trained policy from its recorded episodes, and trains on from there.

    python results/clone.py

For each task: one policy is trained; episodes of it, with sampled actions, are recorded as Parquet;
three members start as clones of them. Each is evaluated as it started, and after further env steps;
beside it stand members that trained as long from scratch. Runs stay in `runs/clone/`, and a part
that is there is not made again; `results/clone.json` gets the returns. Minutes of one core.
"""

from __future__ import annotations

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import sauna
from sauna.config.stored import read_stored
from sauna.envs.spaces import read_spaces
from sauna.system import checkpoint, run_directory
from sauna.training.artifact import Artifact

ROOT = Path(__file__).parent.parent
RUNS, FILE = ROOT / "runs" / "clone", ROOT / "results" / "clone.json"
SEEDS, EPISODES = 3, 10
# Task: env steps of the expert, episodes recorded, env steps from there and from scratch.
TASKS = {"CartPole-v1": (60_000, 20, 20_000), "Hopper-v5": (500_000, 50, 100_000)}


def main() -> None:
    found = {}
    for env, (steps, episodes, more) in TASKS.items():
        found[env] = one_task(env, steps, episodes, more)
        print(json.dumps(found[env], indent=1))
    versions = {name: version(name) for name in ("jax", "gymnasium", "mujoco", "numpy", "pyarrow")}
    result = {"tasks": found, "python": platform.python_version(), "versions": versions}
    FILE.write_text(json.dumps(result, indent=1) + "\n")


def one_task(env: str, steps: int, episodes: int, more: int) -> dict[str, Any]:
    place = RUNS / env
    expert = trained(place / "expert", env, seeds=1, steps=steps)
    data = place / "episodes.parquet"
    if not data.exists():
        recorded = sauna.record(expert, data, episodes=episodes, seed=1000)
        (place / "recorded.json").write_text(json.dumps(recorded))
    recorded = json.loads((place / "recorded.json").read_text())
    how = {"seeds": SEEDS, "steps": more}
    clone = trained(place / "clone", env, init_from=f"data:{data}", init_normalizer="kept", **how)
    scratch = trained(place / "scratch", env, **how)
    initial = run_directory.read_config(clone)["initial"]
    return {
        "recorded": {
            "episodes": recorded["episodes"],
            "env_steps": recorded["env_steps"],
            "mean_return": recorded["mean"],
        },
        "fit": initial["members"],
        "env_steps_afterwards": more,
        "returns": {
            "expert": both(lambda mode: evaluated(expert, mode)),
            "clone": both(lambda mode: as_started(clone, mode)),
            "clone_trained": both(lambda mode: evaluated(clone, mode)),
            "from_scratch": both(lambda mode: evaluated(scratch, mode)),
        },
    }


def trained(path: Path, env: str, **settings: Any) -> Path:
    """A run that is complete; it is made, or goes on, if it is not."""
    how = {"quiet": True, "processes": 1}
    if (path / "config.json").exists():
        if not (path / "summary.json").exists():
            sauna.resume(path, **how)
    else:
        sauna.train(env, out=path, arm="ppo", **how, **settings)
    return path


def both(returns: Any) -> dict[str, list[float]]:
    """Mean returns of each member, with sampled and with the most likely actions."""
    return {mode: [round(float(x), 1) for x in returns(mode)] for mode in ("sampled", "likeliest")}


def evaluated(run: Path, mode: str) -> list[float]:
    result = sauna.evaluate(run, episodes=EPISODES, deterministic=mode == "likeliest", seed=5000)
    return [row["mean"] for row in result["members"].values()]


def as_started(run: Path, mode: str) -> list[float]:
    """The members before their first gradient step of PPO."""
    from sauna.algorithm.rollout.play import play
    from sauna.envs.make import make_env
    from sauna.experiments.evaluate.policy import TrainedPolicy

    loaded = checkpoint.load_checkpoint(run / "init" / f"{0:08d}")
    manifest = loaded.manifest
    spaces, names = read_spaces(manifest["spaces"]), manifest["members"]
    artifact = Artifact(read_stored(manifest), spaces, names, loaded)
    env, means = make_env(artifact.config.env, {}), []
    for name in names:
        policy = TrainedPolicy(artifact, name, env)
        seeds = range(5000, 5000 + EPISODES)
        means.append(np.mean([play(policy, env, mode == "likeliest", s).return_ for s in seeds]))
    return means


if __name__ == "__main__":
    main()
