"""Makes everything under `results/` and the tables and figures that are made of it.

    python results/make.py           tables and figures from the result files
    python results/make.py --train   trains first (hours), continuing where it stopped

The runs stay in `runs/`, which is not in the repository; what is committed is each member's final
numbers and a thinned curve.
"""

from __future__ import annotations

import csv
import json
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sauna
from sauna import rundir
from sauna.metrics.curve import interval

ROOT = Path(__file__).parent.parent
TASKS = ["HalfCheetah-v5", "Hopper-v5", "InvertedDoublePendulum-v5", "InvertedPendulum-v5",
         "Reacher-v5", "Swimmer-v5"]  # fmt: skip
NAME = "ppo_mujoco"
POINTS = 60  # of each member's curve that are kept


class Training(NamedTuple):
    """One run behind the numbers: 6 seeds of PPO on a task."""

    task: str
    run: str  # folder under runs/
    truncation: str | None = None  # None: the default

    def settings(self) -> dict[str, Any]:
        common: dict[str, Any] = {"arm": "ppo", "preset": "mujoco", "seeds": 6, "steps": 1_000_000,
                                  "processes": 2, "out": f"runs/{self.run}"}  # fmt: skip
        return common | ({"truncation": self.truncation} if self.truncation else {})

    def command(self) -> str:
        flags = " ".join(f"--{name} {value}" for name, value in self.settings().items())
        return f"sauna train {self.task} {flags}"


TRAININGS = {task: Training(task, f"ppo-{task}") for task in TASKS}
# A second look at one task, for which the treatment of the time limit decides.
TRAININGS["InvertedDoublePendulum-v5, truncation=terminate"] = Training(
    "InvertedDoublePendulum-v5", "idp-terminate", "terminate"
)

# PPO's published means for 10^6 steps, for orientation. Other versions of the tasks and other
# metrics: the paper's Table 1 and baselines on v2 tasks, CleanRL on v4 tasks.
PUBLISHED = {
    "HalfCheetah-v5": ("2277", "1669", "1443"),
    "Hopper-v5": ("2106", "2316", "2383"),
    "InvertedDoublePendulum-v5": ("6100", "7103", "-"),
    "InvertedPendulum-v5": ("532", "809", "963"),
    "Reacher-v5": ("-7.5", "-6.7", "-"),
    "Swimmer-v5": ("99.5", "111", "-"),
}


def train(training: Training) -> None:
    run = Path("runs") / training.run
    if (run / "config.json").exists():
        sauna.resume(run)
    else:
        sauna.train(training.task, **training.settings())


def collect() -> None:
    """Writes the final numbers and the thinned curves of all complete runs."""
    results, curves = {}, []
    for label, training in TRAININGS.items():
        run = Path("runs") / training.run
        if not rundir.is_complete(run):
            raise SystemExit(f"{run} is not complete; train it with --train")
        stored = rundir.read_config(run)
        summary = json.loads((run / "summary.json").read_text())
        results[label] = {
            "command": training.command(),
            "versions": stored["versions"],
            "git": stored["git"],
            "machine": stored["machine"],
            "metric": summary["metric"],
            "members": summary["members"],
        }
        for name in summary["members"]:
            rows = [row for row in rundir.rows(run) if row["member"] == name]
            rows = [row for row in rows if "return_mean" in row]
            for i in np.unique(np.linspace(0, len(rows) - 1, POINTS).astype(int)):
                row = rows[i]
                explained = row.get("explained_variance")
                curves.append([label, name, row["env_steps"], round(row["return_mean"], 3),
                               "" if explained is None else round(explained, 4)])  # fmt: skip
    (ROOT / "results" / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    with (ROOT / "results" / f"{NAME}_curves.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["task", "member", "env_steps", "return_mean", "explained_variance"])
        writer.writerows(curves)


def table() -> str:
    """PPO's final training returns as a Markdown table."""
    tasks = json.loads((ROOT / "results" / f"{NAME}.json").read_text())
    lines = [
        "| task | PPO here, mean +- std | seeds, lowest to highest | paper (v2) | baselines (v2) | CleanRL (v4) |",  # noqa: E501
        "|---|---|---|---|---|---|",
    ]
    for task, stored in tasks.items():
        final = sorted(member["return_mean"] for member in stored["members"].values())
        digits = 1 if abs(final[-1]) < 1000 else 0
        seeds = ", ".join(f"{x:.{digits}f}" for x in final)
        mean = f"{np.mean(final):.{digits}f} +- {np.std(final, ddof=1):.{digits}f}"
        lines.append(f"| {task} | {mean} | {seeds} | {' | '.join(PUBLISHED[task.split(',')[0]])} |")
    return "\n".join(lines)


def insert_table(path: Path) -> None:
    """Puts the table between the markers of a Markdown file."""
    begin, end = f"<!-- {NAME} begin -->", f"<!-- {NAME} end -->"
    text = path.read_text()
    head, rest = text.split(begin)
    path.write_text(f"{head}{begin}\n{table()}\n{end}{rest.split(end)[1]}")


def figure() -> None:
    """`docs/ppo_mujoco.png` from the thinned curves."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
    with (ROOT / "results" / f"{NAME}_curves.csv").open() as file:
        for row in csv.DictReader(file):
            line = curves.setdefault(row["task"], {}).setdefault(row["member"], [])
            line.append((float(row["env_steps"]), float(row["return_mean"])))
    curves = {task: curves[task] for task in TASKS}
    panels, axes = plt.subplots(2, 3, figsize=(10, 5.6), dpi=130)
    for axis, (task, members) in zip(axes.flat, curves.items(), strict=True):
        lines = [np.array(line) for line in members.values()]
        grid = np.linspace(max(x[0, 0] for x in lines), min(x[-1, 0] for x in lines), 100)
        values = np.stack([np.interp(grid, x[:, 0], x[:, 1]) for x in lines])
        for x in lines:
            axis.plot(x[:, 0], x[:, 1], color="#0072B2", alpha=0.3, linewidth=0.8)
        axis.fill_between(grid, *interval(values), color="#0072B2", alpha=0.2, linewidth=0)
        axis.plot(grid, values.mean(0), color="#0072B2", linewidth=2)
        axis.set_title(task, fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
        axis.ticklabel_format(axis="x", style="sci", scilimits=(0, 4))
    panels.supxlabel("env steps", fontsize=10)
    panels.supylabel("training return (last 100 episodes)", fontsize=10)
    panels.suptitle("PPO, preset mujoco: 6 seeds, their mean and its 95% interval", fontsize=11)
    panels.tight_layout()
    panels.savefig(ROOT / "docs" / f"{NAME}.png")


def main() -> None:
    os.chdir(ROOT)
    if "--train" in sys.argv:
        for training in TRAININGS.values():
            train(training)
        collect()
    insert_table(ROOT / "README.md")
    figure()


if __name__ == "__main__":
    main()
