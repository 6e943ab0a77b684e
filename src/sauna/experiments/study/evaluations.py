"""Evaluations while the members of a study trained: their numbers, curves and words.

They are in the results of members that were evaluated (`--eval-every`), and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sauna.experiments.curves import common_grid, on_grid
from sauna.experiments.statistics import mean_interval
from sauna.experiments.study.cells import Cell


def evaluated(rows: Sequence[Mapping[str, Any]], points: int, digits: int) -> dict[str, Any]:
    """Returns a member's last and best evaluation and their thinned curve; nothing without any.

    Args:
      rows: of its `metrics.jsonl`.
      points: of the curve at most; digits: significant ones of its values.
    """
    seen = [row for row in rows if "eval_return_mean" in row]
    if not seen:
        return {}
    means = [row["eval_return_mean"] for row in seen]
    chosen = np.unique(np.linspace(0, len(seen) - 1, points).astype(int)).tolist()
    return {
        "eval_return": means[-1],
        "eval_return_best": max(means),
        "evaluations": {
            "env_steps": [seen[i]["env_steps"] for i in chosen],
            "return_mean": [float(f"{means[i]:.{digits}g}") for i in chosen],
        },
    }


def evaluation_curve(cell: Cell, most: int) -> dict[str, list[Any]] | None:
    """Returns mean and 95% interval of the members' evaluations; None if a member has none.

    Args:
      most: points of the curve at most.
    """
    curves = [member.get("evaluations") for member in cell.complete]
    found = [curve for curve in curves if curve is not None]
    if not found or len(found) < len(curves):
        return None
    steps = [np.array(curve["env_steps"], float) for curve in found]
    grid = common_grid(steps, most)
    values = [
        on_grid(x, np.array(curve["return_mean"], float), grid)
        for x, curve in zip(steps, found, strict=True)
    ]
    lines = mean_interval(np.array(values).reshape(len(found), len(grid)))
    listed = [[float(v) if math.isfinite(v) else None for v in line] for line in lines]
    drawn = dict(zip(("mean", "low", "high"), listed, strict=True))
    return {"env_steps": [int(x) for x in grid], **drawn}


def last_evaluations(cell: Cell) -> dict[str, float | None]:
    """Returns mean and standard deviation of the members' last evaluations; nothing without any."""
    values = cell.values("eval_return")
    if not len(values):
        return {}
    std = float(values.std(ddof=1)) if len(values) > 1 else None
    return {"eval_mean": float(values.mean()), "eval_std": std}


def has_evaluations(table: Sequence[Mapping[str, Any]]) -> bool:
    """Returns whether an arm was evaluated while it trained."""
    return any("eval_mean" in row for row in table)
