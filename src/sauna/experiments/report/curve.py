"""The learning curve of a run as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sauna.experiments.report import style
from sauna.system import run_directory

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
    curves = member_curves(run_directory.rows(run))
    if not curves:
        return None
    from matplotlib.figure import Figure

    config = run_directory.read_config(run)["config"]
    looks = style.looks({arm: arm for arm in curves})
    with style.applied():
        figure = Figure(figsize=(7, 4.2), layout="tight")
        axes = figure.subplots()
        for arm, members in curves.items():
            _draw_arm(axes, arm, members, looks[arm])
        axes.set_ylabel("training return\n(last 100 episodes)")
        axes.set_title(f"{config['env']}, preset {config['preset']}")
        axes.legend()
        style.count_steps(axes)
        return style.save(figure, run / "figures" / "learning_curve.png")


def _draw_arm(
    axes: Any, arm: str, members: dict[str, tuple[np.ndarray, np.ndarray]], look: style.Look
) -> None:
    for x, y in members.values():
        axes.plot(x, y, color=look.colour, alpha=0.3, linewidth=0.8)
    first = max(x[0] for x, _ in members.values())
    last = min(x[-1] for x, _ in members.values())
    grid = np.linspace(first, last, GRID)
    values = np.stack([np.interp(grid, x, y) for x, y in members.values()])
    label = f"{arm}, mean of {len(members)} seed{'s' if len(members) > 1 else ''}"
    low = high = np.full(GRID, np.nan)
    if len(members) > 1:
        low, high = interval(values)
        label += " and 95% interval"
    style.draw_line(axes, look, grid, values.mean(0), low, high, label=label)
