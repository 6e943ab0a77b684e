"""This project's HumanoidFlagrunHarder beside the Bullet port's: what they show, pay and end.

python benchmarks/flagrun_ports.py            the tables of the page from the result file
python benchmarks/flagrun_ports.py --measure  measures first (a quarter of an hour), which needs
                                              `pip install pybullet-envs-gymnasium`
python benchmarks/flagrun_ports.py --frames   draws the pictures of docs/reference/flagrun.md
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sauna.envs.make import make_env
from sauna.experiments.evaluate.video import choose_renderer
from sauna.system import run_directory

ROOT = Path(__file__).parent.parent
RESULT = ROOT / "results" / "flagrun_ports.json"
ENVS = {
    "here": "sauna/HumanoidFlagrunHarder-v0",
    "Bullet": "pybullet_envs_gymnasium:HumanoidFlagrunHarderBulletEnv-v0",
}
PORT = ("pybullet", "pybullet-envs-gymnasium")
POLICIES = ("zero", "random")
EPISODES = 60
TRAIN_STEPS = 20_480
THROWN_FROM_AHEAD = 26  # a seed
GROUPS = {
    "height - 0.8": [0],
    "sine, cosine of the flag": [1, 2],
    "velocity x 0.3": [3, 4, 5],
    "roll, pitch": [6, 7],
    "joint positions": list(range(8, 42, 2)),
    "joint speeds x 0.1": list(range(9, 42, 2)),
    "foot contacts": [42, 43],
}
TERMS = ("alive", "progress", "electricity and stall torque", "joints at their limits")


def play(name: str, policy: str) -> dict[str, Any]:
    """`EPISODES` episodes with the seeds 0, 1, ..., in numbers."""
    env = make_env(ENVS[name], {})
    episodes, observations = [], []
    for seed in range(EPISODES):
        rng = np.random.default_rng(seed)
        act = (
            (lambda: np.zeros(17, np.float32))
            if policy == "zero"
            else (lambda rng=rng: rng.uniform(-1, 1, 17).astype(np.float32))
        )
        episode, seen = play_episode(env, seed, act)
        episodes.append(episode)
        observations += seen
    env.close()
    return {
        "env": name,
        "policy": policy,
        "episodes": EPISODES,
        "env_steps": len(observations),
        "observations": {k: spread(np.array(observations)[:, v]) for k, v in GROUPS.items()},
        "all": totals(episodes),
        "standing": totals([e for e in episodes if e["z"] > 1.3]),
    }


def play_episode(
    env: Any, seed: int, act: Callable[[], np.ndarray]
) -> tuple[dict[str, Any], list[np.ndarray]]:
    observation, _ = env.reset(seed=seed)
    z, seen, rewards, terms, ended = observation[0] + 0.8, [], 0.0, np.zeros(4), False
    truncated = False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(act())
        ended = terminated or truncated
        rewards += reward
        terms += terms_of(env, info)
        seen.append(np.asarray(observation, np.float64))
    episode = {"z": z, "length": len(seen), "return": rewards, "terms": terms}
    return {**episode, "truncated": truncated}, seen


def terms_of(env: Any, info: dict[str, float]) -> np.ndarray:
    """The reward's terms, in the order of `TERMS`; the Bullet port keeps them as a list."""
    if "alive" in info:
        cost = info["electricity"] + info["stall_torque"]
        return np.array([info["alive"], info["progress"], cost, info["joints_at_limit"]])
    return np.array(env.unwrapped.rewards[:4])


def spread(values: np.ndarray) -> dict[str, float]:
    low, high = np.quantile(values, [0.05, 0.95])
    return {
        "low": float(low),
        "high": float(high),
        "min": float(values.min()),
        "max": float(values.max()),
        "clipped": float(np.mean(np.abs(values) >= 5)),
    }


def totals(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    returns = np.array([e["return"] for e in episodes])
    lengths = np.array([e["length"] for e in episodes])
    per_step = sum(e["terms"] for e in episodes) / lengths.sum()
    return {
        "episodes": len(episodes),
        "env_steps": int(lengths.sum()),
        "truncated": sum(bool(e["truncated"]) for e in episodes),
        "length": [int(lengths.min()), float(lengths.mean()), int(lengths.max())],
        "return": [float(returns.mean()), float(returns.std(ddof=1))],
        "terms_per_step": dict(zip(TERMS, per_step.tolist(), strict=True)),
    }


def train(name: str) -> dict[str, Any]:
    """A short training of PPO and SAUNA by the command that users type."""
    flags = ["train", ENVS[name], "--arm", "ppo,sauna", "--steps", str(TRAIN_STEPS)]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sauna", *flags, "--out", f"{folder}/run"]
        subprocess.run(command, check=True)
        lines = Path(folder, "run", "metrics.jsonl").read_text().splitlines()
    last = {row["arm"]: row for row in map(json.loads, lines)}
    keys = ("env_steps", "kept_steps", "return_mean", "explained_variance")
    members = {arm: {key: row[key] for key in keys} for arm, row in last.items()}
    return {"env": name, "command": " ".join(["sauna", *flags]), "members": members}


def measure() -> None:
    result = {
        "command": "python benchmarks/flagrun_ports.py --measure",
        "machine": run_directory.machine(),
        "versions": {**run_directory.versions(), **{name: version(name) for name in PORT}},
        "played": [play(name, policy) for name in ENVS for policy in POLICIES],
        "trained": [train(name) for name in ENVS],
    }
    RESULT.write_text(json.dumps(result, indent=1) + "\n")


def episodes_table(result: dict[str, Any]) -> str:
    lines = [
        "| env | policy | starts | episodes | env steps | length, min / mean / max | "
        f"return, mean +- std | {' | '.join(TERMS)} |",
        "|---" * (7 + len(TERMS)) + "|",
    ]
    for one in result["played"]:
        for starts in ("all", "standing"):
            found = one[starts]
            if starts == "standing" and found["episodes"] == one["episodes"]:
                continue
            low, mean, high = found["length"]
            terms = " | ".join(f"{found['terms_per_step'][term]:.2f}" for term in TERMS)
            lines.append(
                f"| {one['env']} | {one['policy']} | {starts} | {found['episodes']} | "
                f"{found['env_steps']} | {low} / {mean:.0f} / {high} | "
                f"{found['return'][0]:.0f} +- {found['return'][1]:.0f} | {terms} |"
            )
    return "\n".join(lines)


def observations_table(result: dict[str, Any]) -> str:
    columns = [f"{one['env']}, {one['policy']}" for one in result["played"]]
    lines = [f"| observation | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for group in GROUPS:
        cells = []
        for one in result["played"]:
            found = one["observations"][group]
            clipped = f", {found['clipped']:.1%} clipped" if found["clipped"] >= 0.0005 else ""
            cells.append(f"{found['low']:.2f} to {found['high']:.2f}{clipped}")
        lines.append(f"| {group} | {' | '.join(cells)} |")
    return "\n".join(lines)


def training_table(result: dict[str, Any]) -> str:
    lines = ["| command | arm | env steps | kept | training return |", "|---|---|---|---|---|"]
    for one in result["trained"]:
        for arm, row in one["members"].items():
            lines.append(
                f"| `{one['command']}` | {arm} | {row['env_steps']} | {row['kept_steps']} | "
                f"{row['return_mean']:.0f} |"
            )
    return "\n".join(lines)


def insert(path: Path, name: str, text: str) -> None:
    """Puts `text` between the markers `NAME` of a Markdown file."""
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    head, rest = path.read_text().split(begin)
    path.write_text(f"{head}{begin}\n{text}\n{end}{rest.split(end)[1]}")


def frames() -> None:
    """A start, and a cube in flight."""
    import imageio.v3 as imageio

    env = make_env(ENVS["here"], {}, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    imageio.imwrite(ROOT / "docs" / "images" / "flagrun" / "start.png", env.render())
    env.reset(seed=THROWN_FROM_AHEAD)
    env.task = env.task._replace(frame=np.int32(120))
    for _ in range(6):
        env.step(np.zeros(17))
    imageio.imwrite(ROOT / "docs" / "images" / "flagrun" / "cube.png", env.render())
    env.close()


def main() -> None:
    choose_renderer()  # MuJoCo asks when it is imported
    if "--measure" in sys.argv:
        measure()
    if "--frames" in sys.argv:
        frames()
    result, page = json.loads(RESULT.read_text()), ROOT / "docs" / "reference" / "flagrun.md"
    insert(page, "episodes", episodes_table(result))
    insert(page, "observations", observations_table(result))
    insert(page, "training", training_table(result))


if __name__ == "__main__":
    main()
