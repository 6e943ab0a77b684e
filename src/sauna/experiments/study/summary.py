"""From the results of a study to what they support, in numbers and in words.

Everything is computed from `results` alone, so a summary can be remade at any time. Members that
trained to the end count; in the tests and in the probability of improvement a failed one counts as
the worst outcome, and above a share of `MAX_FAILED` there is no verdict. The words follow from
tests and intervals, never from which mean is larger, and no arm gets credit for an inactive filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sauna.experiments.curves import common_grid, on_grid
from sauna.experiments.statistics import (
    Comparison,
    compare,
    improvement_over_tasks,
    iqm_estimate,
    mean_interval,
    performance_profile,
)
from sauna.experiments.study import ranking
from sauna.experiments.study.cells import Cell
from sauna.experiments.study.equal_compute import by_compute, compute_verdicts
from sauna.experiments.study.evaluations import evaluation_curve, last_evaluations
from sauna.experiments.study.verdicts import (
    ABLATION,
    CONTROL,
    MORE_STEPS,
    UNFILTERED,
    ablations_of,
    about_ablations,
    families_of,
    is_random_control,
    verdicts_of,
)
from sauna.system.errors import BadInput

__all__ = ["MORE_STEPS", "UNFILTERED", "random_controls", "summarize"]

FORMAT = 1
GRID = 60  # points of a curve at most
# What a curve shows, and the values it can take at all: no interval claims more.
QUANTITIES = {
    "return_mean": (-math.inf, math.inf),
    "keep_rate": (0.0, 1.0),
    "sample_rate": (0.0, 1.0),
    "vex_mean": (-math.inf, math.inf),
    "explained_variance": (-math.inf, 1.0),
}


def summarize(results: Mapping[str, Any]) -> dict[str, Any]:
    """Summarizes `results` (format 1): verdicts, table, profiles and curves, ready for JSON.

    Values that cannot be computed are None.

    Raises:
      BadInput: results of another format.
    """
    if results.get("format") != FORMAT:
        raise BadInput(f"results: format {results.get('format')!r}, but only {FORMAT} is known")
    cells = [_cell(stored, results["baseline"]) for stored in results["cells"]]
    of_task = {
        task: [c for c in cells if c.task == task]
        for task in dict.fromkeys(cell.task for cell in cells)
    }
    found = {task: _compare(of_task[task]) for task in of_task}
    summary = {
        "verdicts": [
            verdict
            for task, of_label in found.items()
            for verdict in verdicts_of(of_task[task], of_label, len(of_task))
        ],
        "filtering": [v for own in of_task.values() for v in ablations_of(own, len(of_task))],
        "about_filtering": max(
            (about_ablations(own) for own in of_task.values()), key=len, default=""
        ),
        "table": [_row(cell, found[cell.task].get(cell.label)) for cell in cells],
        "over_tasks": _over_tasks(of_task),
        "profiles": {task: _profiles(of_task[task]) for task in of_task},
        "curves": {task: {cell.label: _curves(cell) for cell in of_task[task]} for task in of_task},
        "equal_compute": [v for own in of_task.values() for v in compute_verdicts(own)],
        "by_compute": {task: by_compute(own) for task, own in of_task.items()},
    }
    evaluations = {
        task: {c.label: curve for c in own if (curve := evaluation_curve(c, GRID)) is not None}
        for task, own in of_task.items()
    }
    if any(evaluations.values()):
        summary["evaluations"] = evaluations
    if "tournament" in results:
        rows = ranking.rank(results)
        summary |= {
            "ranking": rows,
            "table": _as_ranked(summary["table"], rows),
            "verdicts": ranking.verdicts(rows),
            "filtering": ranking.control_verdicts(rows),
            "about_filtering": f"{ABLATION}{CONTROL}.",
        }
    return summary


def _as_ranked(table: Any, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Replaces each probability of improvement by that of the look where the arm stopped."""
    ranked = {(row["task"], row["label"]): row["improvement"] for row in rows}
    return [{**row, "improvement": ranked.get((row["task"], row["label"]))} for row in table]


def random_controls(results: Mapping[str, Any], label: str) -> list[str]:
    """Lists the labels of the matched random controls of `label`, those of 0.1.0 last."""
    cells = [_cell(stored, results["baseline"]) for stored in results["cells"]]
    found = [
        other
        for cell in cells
        if cell.label == label
        for other in cells
        if other.task == cell.task and is_random_control(other, cell)
    ]
    found.sort(key=lambda other: other.rates_of is not None)
    return list(dict.fromkeys(other.label for other in found))


def _cell(stored: Mapping[str, Any], baseline: str) -> Cell:
    own = stored.get("baseline") or (None if stored["label"] == baseline else baseline)
    members = stored["members"]
    failed, running, waiting = (
        sum(member["status"] == status for member in members)
        for status in ("failed", "running", "waiting")
    )
    complete = [
        {**member, "auc": member["auc"] if "auc" in member else member.get("area")}  # as in 0.1.0
        for member in members
        if member["status"] == "complete"
    ]
    return Cell(
        stored["task"],
        stored["label"],
        stored["arm"],
        own,
        complete,
        failed,
        running,
        waiting,
        stored.get("rates_of"),
        stored.get("config") or {},
        stored.get("command") or "",
    )


def _compare(cells: Sequence[Cell]) -> dict[str, Comparison]:
    """Each arm against its baseline, family by family."""
    scores = {cell.label: cell.scores() for cell in cells}
    found: dict[str, Comparison] = {}
    for family in families_of(cells):
        base = scores.get(str(family[0].baseline), np.zeros(0))
        found |= compare({cell.label: (scores[cell.label], base) for cell in family})
    return {cell.label: found[cell.label] for cell in cells if cell.baseline}


def _row(cell: Cell, comparison: Comparison | None) -> dict[str, Any]:
    final = cell.values("final_return")
    stopped = sum("stopped_early" in member for member in cell.complete)
    return {
        "task": cell.task,
        "label": cell.label,
        "baseline": cell.baseline,
        "seeds": len(cell.complete),
        "failed": cell.failed,
        "running": cell.running,
        "final_iqm": _iqm(final),
        "auc_iqm": _iqm(cell.values("auc")),
        "final_mean": cell.mean("final_return"),
        "final_std": float(final.std(ddof=1)) if len(final) > 1 else None,
        "keep_rate": cell.mean("keep_rate"),
        "sampler": cell.config.get("sampler", "none"),
        "sample_rate": cell.mean("sample_rate"),
        "env_steps": cell.mean("env_steps"),
        "kept_steps": cell.mean("kept_steps"),
        "samples_backward": cell.mean("samples_backward"),
        "fewest_episodes": min(
            (m["episodes"] for m in cell.complete if m.get("episodes")), default=None
        ),
        "improvement": list(comparison.improvement) if comparison else None,
        **last_evaluations(cell),
        **({"stopped_early": stopped} if stopped else {}),
    }


def _iqm(scores: np.ndarray) -> list[float | None]:
    return list(iqm_estimate([scores])) if len(scores) else [None, None, None]


def _over_tasks(of_task: Mapping[str, Sequence[Cell]]) -> list[dict[str, Any]]:
    """Each label against its baseline, over the tasks where both have two seeds or more."""
    pairs_of = dict.fromkeys((c.label, c.baseline) for cells in of_task.values() for c in cells)
    rows = []
    for label, baseline in pairs_of:
        if baseline is None:
            continue
        pairs = []
        for cells in of_task.values():
            scores = {cell.label: cell.scores() for cell in cells}
            if min(len(scores.get(name, ())) for name in (label, baseline)) > 1:
                pairs.append((scores[label], scores[baseline]))
        if len(pairs) > 1:
            improvement = list(improvement_over_tasks(pairs))
            rows.append(
                {
                    "label": label,
                    "baseline": baseline,
                    "tasks": len(pairs),
                    "improvement": improvement,
                }
            )
    return rows


def _profiles(cells: Sequence[Cell]) -> dict[str, dict[str, list[float | None]]]:
    """Shares at each return seen on the task and just above it, where they change: lines drawn
    between the points are then the steps that a profile consists of."""
    seen = np.unique(np.concatenate([cell.values("final_return") for cell in cells]))
    returns = np.stack([seen, np.nextafter(seen, np.inf)], -1).ravel()
    profiles = {}
    for cell in cells:
        scores = cell.scores()
        if len(seen) and len(scores):
            lines = (returns, *performance_profile(scores, returns))
            names = ("returns", "share", "low", "high")
            profiles[cell.label] = {n: _listed(x) for n, x in zip(names, lines, strict=True)}
    return profiles


def _curves(cell: Cell) -> dict[str, Any]:
    """Mean curves of the complete members, where each of them has values."""
    curves = [member["curve"] for member in cell.complete]
    env_steps = [np.array(curve["env_steps"], float) for curve in curves]
    grid = common_grid(env_steps, GRID)
    drawn: dict[str, Any] = {"env_steps": [int(x) for x in grid]}
    for name, bounds in QUANTITIES.items():
        values = np.array(
            [
                on_grid(x, np.array(curve.get(name) or [None] * len(x), float), grid)
                for x, curve in zip(env_steps, curves, strict=True)
            ]
        ).reshape(len(curves), len(grid))
        lines = mean_interval(values) if len(curves) else (np.zeros(0),) * 3
        mean, low, high = (_listed(np.clip(line, *bounds)) for line in lines)
        drawn[name] = {"mean": mean, "low": low, "high": high}
    return drawn


def _listed(values: np.ndarray) -> list[float | None]:
    return [float(x) if math.isfinite(x) else None for x in values]
