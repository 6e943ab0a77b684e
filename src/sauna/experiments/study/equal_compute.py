"""Each arm at equal compute: its curve over compute, and what it needs to reach the baseline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sauna.experiments.compute import AXES, Curves, Ratio, compute_ratio, drawn, joined
from sauna.experiments.statistics import mean_interval
from sauna.experiments.study.cells import Cell

ABOUT = (
    "Learner compute is the number of samples through the gradient. The ratio is that of the first "
    "points where the two mean curves reach the baseline's mean final return. The interval is a "
    "percentile bootstrap over seeds, too narrow with few of them; no verdict rests on it. CPU "
    "seconds leave out the compilation of a run's first iteration, but not of a resumed one."
)
WORDS = {"samples_backward": "learner compute", "learner_cpu_seconds": "CPU seconds of the learner"}


def curves_over(cell: Cell, axis: str) -> Curves | None:
    """Returns the returns of the complete seeds over compute; None where it was not recorded."""
    curves = [member["curve"] for member in cell.complete]
    if not all(axis in curve for curve in curves):
        return None
    return joined([(curve[axis], curve["return_mean"]) for curve in curves])


def by_compute(cells: Sequence[Cell]) -> dict[str, dict[str, Any]]:
    """Returns the mean curve of each arm over each kind of compute: `{axis: {label: curve}}`."""
    found: dict[str, dict[str, Any]] = {}
    for axis in AXES:
        for cell in cells:
            if curves := curves_over(cell, axis):
                thinned = drawn(curves)
                lines = (thinned.x, *mean_interval(thinned.y))
                found.setdefault(axis, {})[cell.label] = {
                    name: [float(v) if np.isfinite(v) else None for v in line]
                    for name, line in zip(("x", "mean", "low", "high"), lines, strict=True)
                }
    return found


def compute_verdicts(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Says for each arm with how much of its baseline's compute it reaches the same return."""
    of_label = {cell.label: cell for cell in cells}
    found = []
    for cell in cells:
        base = of_label.get(cell.baseline or "")
        if base is None:
            continue
        ratios: dict[str, Ratio] = {}
        for axis in AXES:
            own, other = curves_over(cell, axis), curves_over(base, axis)
            if own and other:
                ratios[axis] = compute_ratio(own, other)
        if ratios:
            found.append(
                {
                    "task": cell.task,
                    "label": cell.label,
                    "against": base.label,
                    "ratios": {axis: list(ratio) for axis, ratio in ratios.items()},
                    "text": _text(cell, base, ratios),
                }
            )
    return found


def _text(cell: Cell, base: Cell, ratios: dict[str, Ratio]) -> str:
    goal = f"{base.label}'s final return on {cell.task}"
    if all(ratio.value is None for ratio in ratios.values()):
        return f"{cell.label}: does not reach {goal}."
    said = [
        _share(ratio, f"{whose} {WORDS[axis]}")
        for (axis, ratio), whose in zip(ratios.items(), (f"{base.label}'s", "its"), strict=False)
        if ratio.value is not None
    ]
    return f"{cell.label}: reaches {goal} with {' and '.join(said)}."


def _share(ratio: Ratio, words: str) -> str:
    text = f"{ratio.value:.2f} of {words}"
    if ratio.low is None:
        return text
    high = "not reached" if ratio.high is None else f"{ratio.high:.2f}"
    return f"{text} [{ratio.low:.2f}, {high}]"
