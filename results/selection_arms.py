"""Every arm of a task: its returns, its compute, and what a reader has to know of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from selection_trainings import (
    cells_of,
    complete,
    is_idle,
    left_out,
    outcomes,
    percent,
    seeds_of_baseline,
    share_of,
    twins,
)
from selection_words import shown_improvement, shown_ratio
from studies import listed, markdown

from sauna.config.presets import RANDOM_CONTROL
from sauna.experiments.compute import joined, reached
from sauna.experiments.report.numbers import digits_of_tasks, number
from sauna.experiments.statistics import improvement_estimate

# What an arm's learning takes: a member's number, and the heads of two columns.
COSTS = {
    "samples_backward": ("Samples learned from", "To PPO's return, in samples"),
    "learner_cpu_seconds": ("CPU seconds of the learner", "To PPO's return, in CPU seconds"),
    "gradient_steps": ("Gradient steps", ""),
}


def arms(task: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Writes the tables of a task and the notes below them."""
    cells, base = cells_of(results, task), results["baseline"]
    rows = [r for r in summary["table"] if r["task"] == task and (r["seeds"] or r["failed"])]
    ratios = {v["label"]: v["ratios"] for v in summary["equal_compute"] if v["task"] == task}
    parts = [
        _returns(rows, cells, digits_of_tasks(summary["table"])[task]),
        _costs([row["label"] for row in rows], cells, ratios, base),
        _level(task, cells, base),
        listed(notes(cells, base)),
    ]
    return "\n\n".join(part for part in parts if part)


def _returns(
    rows: Sequence[Mapping[str, Any]], cells: Mapping[str, Mapping[str, Any]], digits: int
) -> str:
    """Tabulates returns, failed seeds and the probabilities of improvement."""
    head = ["Arm", "Seeds", "Failed", "Final return, mean ± std", "AUC, IQM"]
    table = [[*head, "Improvement over `ppo` [95%]", "Over its random control [95%]"]]
    for row in rows:
        mean, std = row["final_mean"], row["final_std"]
        table.append(
            [
                f"`{row['label']}`",
                str(row["seeds"]),
                str(row["failed"]),
                "-" if mean is None else f"{number(mean, digits)} ± {number(std or 0.0, digits)}",
                "-" if row["auc_iqm"][0] is None else number(row["auc_iqm"][0], digits),
                shown_improvement(row["improvement"]),
                _over_control(row["label"], cells),
            ]
        )
    return markdown(table)


def _over_control(label: str, cells: Mapping[str, Mapping[str, Any]]) -> str:
    control = cells.get(label + RANDOM_CONTROL)
    if control is None:
        return "-"
    own, other = (outcomes(cell, "final_return") for cell in (cells[label], control))
    return shown_improvement(improvement_estimate(own, other)) if len(own) and len(other) else "-"


def _costs(
    labels: Sequence[str],
    cells: Mapping[str, Mapping[str, Any]],
    ratios: Mapping[str, Mapping[str, Any]],
    base: str,
) -> str:
    """Tabulates what learning took beside PPO's, in each count that some arm has."""
    if base not in cells:
        return ""
    head, columns = ["Arm"], [[f"`{label}`" for label in labels]]
    for name, (title, to_level) in COSTS.items():
        shares = [share_of(cells[label], cells[base], name) for label in labels]
        found = [ratios.get(label, {}).get(name) for label in labels]
        if any(share is not None for share in shares):
            head.append(title)
            columns.append(["-" if x is None else f"{x:.2f} of PPO's" for x in shares])
        if any(ratio is not None for ratio in found):
            head.append(to_level)
            columns.append([*map(shown_ratio, found)])
    return markdown([head, *map(list, zip(*columns, strict=True))]) if len(head) > 1 else ""


def _level(task: str, cells: Mapping[str, Mapping[str, Any]], base: str) -> str:
    """Says how much of its own samples the baseline takes until it is at its final return."""
    share = share_to_level(cells[base]) if base in cells else None
    if share is None:
        return ""
    return (
        f"`{base}` takes {share:.2f} of its own samples until its mean curve first reaches its "
        "mean final return. The ratios of compute are to that."
    )


def share_to_level(cell: Mapping[str, Any]) -> float | None:
    """Computes the share of its samples after which an arm's mean curve is at its final mean."""
    known = [member["curve"] for member in complete(cell)]
    if len(known) < len(cell["members"]) or not all("samples_backward" in x for x in known):
        return None
    curves = joined([(curve["samples_backward"], curve["return_mean"]) for curve in known])
    if curves is None:
        return None
    mean = curves.y.mean(0)
    level = mean[-1:] - 1e-9 * np.abs(mean[-1:])  # up to the order of additions
    return float(reached(curves.x, mean[None], level)[0] / curves.x[-1])


def notes(cells: Mapping[str, Mapping[str, Any]], base: str) -> list[str]:
    """Lists arms that are one training, that changed nothing, that left out next to nothing."""
    same = {label: twin for label, twin in twins(cells).items() if twin != base}
    said = [
        f"`{label}` is the same training as `{twin}`: final return, AUC and env steps agree in "
        "every seed. They are one piece of evidence."
        for label, twin in same.items()
    ]
    for label, cell in cells.items():
        own = seeds_of_baseline(cell, cells[base]) if label != base and base in cells else 0
        if own:
            said.append(
                f"`{label}` has the final return, the AUC and the env steps of `{base}` in {own} "
                f"of {len(complete(cell))} seeds. There the rule changed nothing."
            )
        if is_idle(cell):
            said.append(
                f"`{label}` left out {percent(left_out(cell) or 0.0)} of its samples. No "
                "difference can be credited to its choice."
            )
    return said
