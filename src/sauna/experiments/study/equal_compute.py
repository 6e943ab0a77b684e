"""Each arm at equal compute: its curve over compute, and what it needs to reach the baseline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sauna.experiments.compute import AXES, Curves, Ratio, compute_ratio, drawn, has_risen, joined
from sauna.experiments.statistics import mean_interval
from sauna.experiments.study.cells import Cell

ABOUT = (
    "Learner compute is the number of samples through the gradient. The ratio is that of the first "
    "points where the two mean curves reach the baseline's mean final return. The interval is a "
    "percentile bootstrap over seeds, too narrow with few of them; no verdict rests on it. No "
    "ratio is given if the baseline has one seed, or if its return has not risen by more than its "
    "noise. "
    "CPU seconds leave out the compilation of a run's first iteration, but not of a resumed one."
)
WORDS = {"samples_backward": "learner compute", "learner_cpu_seconds": "learner CPU seconds"}


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
    """Says for each arm with how much of its baseline's compute it reaches the same return.

    A baseline that has not risen above its start has a row of its own, in place of its arms.
    """
    of_label = {cell.label: cell for cell in cells}
    found = {}
    for cell in cells:
        base = of_label.get(cell.baseline or "")
        if base is None:
            continue
        known = [(axis, curves_over(cell, axis), curves_over(base, axis)) for axis in AXES]
        pairs = {axis: (own, other) for axis, own, other in known if own and other}
        if not pairs:
            continue
        if not all(has_risen(other) for _, other in pairs.values()):
            found[base.label] = _verdict(base, base, {}, _flat(base))
            continue
        ratios = {axis: compute_ratio(*pair) for axis, pair in pairs.items()}
        found[cell.label] = _verdict(cell, base, ratios, _text(cell, base, ratios))
    return [*found.values()]


def _verdict(cell: Cell, base: Cell, ratios: dict[str, Ratio], text: str) -> dict[str, Any]:
    return {
        "task": cell.task,
        "label": cell.label,
        "against": base.label,
        "ratios": {axis: list(ratio) for axis, ratio in ratios.items()},
        "text": text,
    }


def _flat(base: Cell) -> str:
    return (
        f"{base.label}: its return on {base.task} has not risen above its start by more than its "
        "noise, so no ratio of compute is given."
    )


def _text(cell: Cell, base: Cell, ratios: dict[str, Ratio]) -> str:
    goal = f"{base.label}'s final return on {cell.task}"
    if all(ratio == (None, None, None) for ratio in ratios.values()):
        return f"{cell.label}: does not reach {goal}."
    said = " and ".join(_share(r, f"{base.label}'s {WORDS[axis]}") for axis, r in ratios.items())
    if any(None in ratio for ratio in ratios.values()):
        return f"{cell.label}: not decided how much it takes to reach {goal}: {said}."
    return f"{cell.label}: reaches {goal} with {said}."


def _share(ratio: Ratio, words: str) -> str:
    value, low, high = ("not reached" if v is None else f"{v:.2f}" for v in ratio)
    of = f"{value} by the mean, of {words}" if ratio.value is None else f"{value} of {words}"
    return f"{of}, no interval" if ratio.low is None else f"{of} [{low}, {high}]"
