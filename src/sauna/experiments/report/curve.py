"""The learning curves of one run, or of several runs, as a figure."""

from __future__ import annotations

import io
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sauna.experiments.report import style
from sauna.experiments.report.sources import Source, read_sources
from sauna.system import run_directory
from sauna.system.errors import BadInput, one_line

TRAINING_RETURN = "training return\n(last 100 episodes)"
EVALUATED = "return: training (last 100 episodes),\nevaluations (dotted)"
DOTTED = (1.0, 1.5)  # points on and off
GRID = 100  # points at which members' curves are compared


def member_curves(
    rows: list[dict[str, Any]], key: str = "return_mean"
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Returns `arm -> member -> (env steps, value of key)`; usually the training return."""
    points: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for row in rows:
        if key in row:
            of_arm = points.setdefault(row["arm"], {})
            of_arm.setdefault(row["member"], []).append((row["env_steps"], row[key]))
    return {
        arm: {
            name: (np.array([x for x, _ in line]), np.array([y for _, y in line]))
            for name, line in of_arm.items()
        }
        for arm, of_arm in points.items()
    }


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes the 95% interval of the mean over members `[P, X]` (Student's t)."""
    from scipy import stats

    number = values.shape[0]
    half = stats.t.ppf(0.975, number - 1) * values.std(0, ddof=1) / np.sqrt(number)
    return values.mean(0) - half, values.mean(0) + half


def draw_curve(run: Path) -> Path | None:
    """Draws `figures/learning_curve.png` of a run that was trained; None if that is not possible.

    What keeps it from being drawn costs nothing else: the training has ended well.
    """
    try:
        figure = curve_figure(run)
        return figure and _saved(figure, run / "figures" / "learning_curve.png")
    except Exception as error:  # of a disk that is full, or of Matplotlib
        print(f"warning: no learning curve was drawn: {one_line(error)}", file=sys.stderr)
        return None


def curve_figure(run: Path) -> Any:
    """The learning curves of a run as a matplotlib figure; None if no episode has finished.

    A notebook shows it, as the figure says what it looks like (`_repr_png_`).
    """
    rows = run_directory.rows(run)
    curves, evaluations = member_curves(rows), member_curves(rows, "eval_return_mean")
    if not curves:
        return None
    config = run_directory.read_config(run, needed=("config",))["config"]
    title = f"{config['env']}, preset {config['preset']}"
    y_label = EVALUATED if evaluations else TRAINING_RETURN
    figure = _figure(curves, {arm: arm for arm in curves}, title, y_label, evaluations)
    figure._repr_png_ = partial(_png, figure)
    return figure


def _png(figure: Any) -> bytes:
    with style.applied(), io.BytesIO() as file:
        figure.savefig(file, format="png")
        return file.getvalue()


def plot(paths: Sequence[Path], out: str = "", tag: str = "") -> Path:
    """Draws the learning curves of runs that exist; see `read_sources`.

    Args:
      out: the figure, .png or .svg; empty: `learning_curves.png`, of one run its own figure.

    Raises:
      BadInput: a path cannot be read, or `out` is no figure.
    """
    path = Path(out or "learning_curves.png")
    if not out and len(paths) == 1 and (paths[0] / "config.json").is_file():
        path = paths[0] / "figures" / "learning_curve.png"
        if drawn := draw_curve(paths[0]):
            return drawn
    if path.suffix not in (".png", ".svg"):
        raise BadInput(f"out: {path} must end in .png or .svg")
    return draw_sources(read_sources(paths, tag), path)


def draw_sources(sources: list[Source], path: Path) -> Path:
    """Draws the curves of runs that exist in one figure, `path` (.png or .svg)."""
    curves = {s.label: {str(seed): c[:2] for seed, c in s.seeds.items()} for s in sources}
    tasks = list(dict.fromkeys(source.task for source in sources if source.task))
    known = all(source.arm for source in sources)
    arms = {source.label: source.arm or source.label for source in sources}
    y_label = TRAINING_RETURN if known else "return"
    return _saved(_figure(curves, arms, ", ".join(tasks), y_label), path)


def _saved(figure: Any, path: Path) -> Path:
    with style.applied():
        return style.save(figure, path)


def _figure(
    curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    arms: Mapping[str, str],
    title: str,
    y_label: str,
    evaluations: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]] = MappingProxyType({}),
) -> Any:
    from matplotlib.figure import Figure

    looks = style.looks(arms)
    with style.applied():
        figure = Figure(figsize=(7, 4.2), layout="tight")
        axes = figure.subplots()
        for label, members in curves.items():
            _draw_arm(axes, label, members, looks[label])
        for label, members in evaluations.items():
            look = looks[label]._replace(dash=DOTTED)
            _draw_arm(axes, f"{label}, evaluations", members, look)
        lines = [*curves.values(), *evaluations.values()]
        style.fit_axes(axes, [y for members in lines for _, y in members.values()])
        axes.set_ylabel(y_label)
        axes.set_title(title)
        axes.legend()
        style.count_steps(axes)
    return figure


def _draw_arm(
    axes: Any, arm: str, members: Mapping[str, tuple[np.ndarray, np.ndarray]], look: style.Look
) -> None:
    """Draws every seed and, over the env steps that all of them have, their mean."""
    for x, y in members.values():
        style.draw_seed(axes, look, x, y, look.dash)
    first = max(x[0] for x, _ in members.values())
    last = max(first, min(x[-1] for x, _ in members.values()))
    grid = np.linspace(first, last, GRID)
    values = np.stack([np.interp(grid, x, y) for x, y in members.values()])
    label = f"{arm}, mean of {len(members)} seed{'s' if len(members) > 1 else ''}"
    low = high = np.full(GRID, np.nan)
    if len(members) >= style.MIN_BAND:
        low, high = interval(values)
        label += " and 95% interval"
    style.draw_line(axes, look, grid, values.mean(0), low, high, label=label)
