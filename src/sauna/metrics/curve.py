"""The learning curve of a run as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sauna import rundir

# Okabe and Ito's palette, which the colour-blind can tell apart; an arm always has its colour.
COLOURS = {
    "ppo": "#0072B2",
    "vex-head": "#E69F00",
    "random-drop": "#999999",
    "sauna": "#D55E00",
    "sauna-paper": "#CC79A7",
    "sauna-reference": "#009E73",
}
GRID = 100  # points at which members' curves are compared


def member_curves(
    rows: list[dict[str, Any]],
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """`arm -> member -> (env steps, mean return of the last 100 episodes)`."""
    points: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for row in rows:
        if "return_mean" in row:
            of_arm = points.setdefault(row["arm"], {})
            of_arm.setdefault(row["member"], []).append((row["env_steps"], row["return_mean"]))
    return {
        arm: {
            name: (np.array([x for x, _ in line]), np.array([y for _, y in line]))
            for name, line in of_arm.items()
        }
        for arm, of_arm in points.items()
    }


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """95% interval of the mean over members `[P, X]` (Student's t)."""
    from scipy import stats

    number = values.shape[0]
    half = stats.t.ppf(0.975, number - 1) * values.std(0, ddof=1) / np.sqrt(number)
    return values.mean(0) - half, values.mean(0) + half


def draw_curve(run: Path) -> Path | None:
    """Writes `figures/learning_curve.png`; None where no episode has finished."""
    curves = member_curves(rundir.rows(run))
    if not curves:
        return None
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    config = rundir.read_config(run)["config"]
    figure, axes = plt.subplots(figsize=(7, 4.2), dpi=150)
    for arm, members in curves.items():
        colour = COLOURS.get(arm, "#000000")
        for x, y in members.values():
            axes.plot(x, y, color=colour, alpha=0.3, linewidth=0.8)
        first = max(x[0] for x, _ in members.values())
        last = min(x[-1] for x, _ in members.values())
        grid = np.linspace(first, last, GRID)
        values = np.stack([np.interp(grid, x, y) for x, y in members.values()])
        label = f"{arm}, mean of {len(members)} seed{'s' if len(members) > 1 else ''}"
        if len(members) > 1:
            axes.fill_between(grid, *interval(values), color=colour, alpha=0.2, linewidth=0)
            label += " and 95% interval"
        axes.plot(grid, values.mean(0), color=colour, linewidth=2, label=label)
    axes.set_xlabel("env steps")
    axes.set_ylabel("training return\n(last 100 episodes)")
    axes.set_title(f"{config['env']}, preset {config['preset']}", fontsize=10)
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.ticklabel_format(axis="x", style="sci", scilimits=(0, 4))
    path = run / "figures" / "learning_curve.png"
    path.parent.mkdir(exist_ok=True)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
    return path
