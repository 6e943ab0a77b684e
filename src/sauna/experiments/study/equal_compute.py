"""Each arm at equal compute: its curve over compute, and what it needs to reach the baseline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sauna.experiments.compute import AXES, Curves, Ratio, compute_ratio, drawn, has_risen, joined
from sauna.experiments.statistics import mean_interval
from sauna.experiments.study.cells import Cell

ABOUT = (
    "Each sentence says how much compute an arm takes until its mean curve first "
    "reaches the baseline's mean final return, as a multiple of what the baseline itself takes "
    "until then: 0.5 is half of it. Compute is counted in samples that pass through the gradient, "
    "in CPU seconds of the learner, and in CPU seconds of the training, which are those of "
    "collecting as well. On the device the two are one program. The interval is a percentile "
    "bootstrap over seeds, too narrow with few of them; no verdict rests on it. There is no ratio "
    "if the baseline has one seed, if one of its seeds failed, or if its return has not risen by "
    "more than its noise. An arm of which a seed failed does not reach the baseline's return. "
    "CPU seconds leave out the compilation of a run's first iteration, but not of a resumed one."
)
NEVER = Ratio(None, None, None)
WORDS = {
    "samples_backward": "in samples",
    "learner_cpu_seconds": "in CPU seconds of the learner",
    "cpu_seconds": "in CPU seconds of the training",
}


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

    A baseline that gives no level, because a seed failed or it has not risen above its start, has a
    row of its own, in place of its arms.
    """
    of_label = {cell.label: cell for cell in cells}
    found = {}
    for cell in cells:
        base = of_label.get(cell.baseline or "")
        levels = _levels(base) if base else {}
        if base is None or not levels:
            continue
        if base.failed or not all(map(has_risen, levels.values())):
            found[base.label] = _verdict(base, base, {}, _without_level(base))
        elif ratios := _ratios(cell, levels):
            found[cell.label] = _verdict(cell, base, ratios, _text(cell, base, ratios))
    return [*found.values()]


def _levels(base: Cell) -> dict[str, Curves]:
    known = {axis: curves_over(base, axis) for axis in AXES}
    return {axis: curves for axis, curves in known.items() if curves}


def _ratios(cell: Cell, levels: Mapping[str, Curves]) -> dict[str, Ratio]:
    """Computes the ratio in each kind of compute that both arms know.

    A failed seed is the worst outcome, so that the mean with it never reaches a level.
    """
    if cell.failed:
        return dict.fromkeys(levels, NEVER)
    known = {axis: (curves_over(cell, axis), base) for axis, base in levels.items()}
    return {axis: compute_ratio(own, base) for axis, (own, base) in known.items() if own}


def _verdict(cell: Cell, base: Cell, ratios: dict[str, Ratio], text: str) -> dict[str, Any]:
    return {
        "task": cell.task,
        "label": cell.label,
        "against": base.label,
        "ratios": {axis: list(ratio) for axis, ratio in ratios.items()},
        "text": text,
    }


def _without_level(base: Cell) -> str:
    if base.failed:
        return (
            f"{base.label}: {_failed(base)} on {base.task}, so no ratio of compute is given to "
            "reach its return."
        )
    return (
        f"{base.label}: its return on {base.task} has not risen above its start by more than its "
        "noise, so no ratio of compute is given."
    )


def _failed(cell: Cell) -> str:
    return f"{cell.failed} of {cell.failed + len(cell.complete)} seeds failed"


def _text(cell: Cell, base: Cell, ratios: dict[str, Ratio]) -> str:
    goal = f"{base.label}'s final return on {cell.task}"
    if all(ratio == NEVER for ratio in ratios.values()):
        return f"{cell.label}: does not reach {goal}{f', as {_failed(cell)}' * bool(cell.failed)}."
    said = "; ".join(f"{WORDS[axis]} {_share(ratio)}" for axis, ratio in ratios.items())
    if any(None in ratio for ratio in ratios.values()):
        return f"{cell.label}: not decided with how much compute it reaches {goal}: {said}."
    return f"{cell.label}: reaches {goal} with this multiple of {base.label}'s compute: {said}."


def _share(ratio: Ratio) -> str:
    """`0.25, between 0.20 and 0.31`; an end that no resample has is `never`."""
    value = "the mean curve never gets there" if ratio.value is None else f"{ratio.value:.2f}"
    if ratio.low is None:
        return f"{value}, without an interval"
    high = "never" if ratio.high is None else f"{ratio.high:.2f}"
    return f"{value} (interval from {ratio.low:.2f} to {high})"
