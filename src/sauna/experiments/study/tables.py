"""What the report's tables show, as plain values: the page's templates lay them out."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from sauna.experiments.report.numbers import digits_of, digits_of_tasks
from sauna.experiments.report.page import MINUS
from sauna.experiments.report.style import Look
from sauna.training.summary import WINDOW

PAPER_STEPS = 1_000_000  # env steps of each of its trainings
# Table 1 of the SAUNA paper, as printed.
PAPER: dict[str, dict[str, tuple[float, float]]] = {
    "HalfCheetah": {"PPO": (2277, 432), "SAUNA": (2929, 169)},
    "Hopper": {"PPO": (2106, 133), "SAUNA": (2250, 73)},
    "InvertedDoublePendulum": {"PPO": (6100, 143), "SAUNA": (6893, 350)},
    "InvertedPendulum": {"PPO": (532, 19), "SAUNA": (609, 24)},
    "Reacher": {"PPO": (-7.5, 0.8), "SAUNA": (-7.2, 0.3)},
    "Swimmer": {"PPO": (99.5, 5.4), "SAUNA": (100.8, 10.4)},
}
SEED_COLUMNS = {
    "final_return": "Final return",
    "auc": "AUC",
    "keep_rate": "Keep rate",
    "sample_rate": "Samples used",
    "explained_variance": "Explained variance",
    "env_steps": "Env steps",
    "eval_return": "Last evaluation",
    "eval_return_best": "Best evaluation",
    "kept_steps": "Kept steps",
    "episodes": "Episodes",
    "samples_backward": "Samples learned from",
    "learner_cpu_seconds": "Learner CPU seconds",
    "cpu_seconds": "CPU seconds",
}
OF_EVALUATIONS = ("eval_return", "eval_return_best")  # left out where no member has any
FORMER_KEYS = {"auc": "area"}  # in results of 0.1.0


def has_samplers(table: Sequence[Mapping[str, Any]]) -> bool:
    """Returns whether an arm has a sampler, so that the share of samples it uses is shown."""
    return any(row.get("sampler", "none") != "none" for row in table)


def few_episodes(table: Sequence[Mapping[str, Any]]) -> str:
    """Says which arms have a seed with fewer episodes than a final return covers; empty if none."""
    few = [row for row in table if (row.get("fewest_episodes") or WINDOW) < WINDOW]
    tasks = len({row["task"] for row in table}) > 1
    parts = [
        f"{row['label']}{' on ' + row['task'] if tasks else ''} {row['fewest_episodes']}"
        for row in few
    ]
    return (
        f"note: a seed has fewer than {WINDOW} episodes ({', '.join(parts)}): its final return is "
        f"the mean of all of them, from the untrained policy on; more --steps give more"
        if parts
        else ""
    )


def main_columns(baseline: str, sampled: bool, evaluated: bool) -> dict[str, str]:
    """Returns the columns of the main table.

    Args:
      sampled: with the share of samples used; evaluated: with the last evaluations.
    """
    columns = {
        "arm": "Arm",
        "final_iqm": "Final return, IQM",
        "improvement": f"Better than {baseline}",
        "auc_iqm": "AUC, IQM",
        "final_mean": "Final return, mean ± std",
        "eval_mean": "Last evaluation, mean ± std",
        "keep_rate": "Keep rate",
        "sample_rate": "Samples used",
        "env_steps": "Env steps",
        "seeds": "Seeds",
    }
    left = {"sample_rate": sampled, "eval_mean": evaluated}
    return {name: text for name, text in columns.items() if left.get(name, True)}


def main_groups(summary: Mapping[str, Any], looks: Mapping[str, Look]) -> list[dict[str, Any]]:
    """Returns the rows of the main table, task by task, each with its look and its whisker."""
    groups = []
    for task, digits in digits_of_tasks(summary["table"]).items():
        own = [row for row in summary["table"] if row["task"] == task]
        rows = [{**r, "look": looks[r["label"]], "whisker": _whisker(r, own)} for r in own]
        groups.append({"task": task, "digits": digits, "rows": rows})
    return groups


def _whisker(row: Mapping[str, Any], of_task: Sequence[Mapping[str, Any]]) -> list[str] | None:
    """Places of the value and the ends of its interval, in pixels on one scale for the task."""
    ends = [v for other in of_task for v in other["final_iqm"] if v is not None]
    if None in row["final_iqm"] or min(ends) == max(ends):
        return None
    width = max(ends) - min(ends)
    return [f"{4 + 112 * (v - min(ends)) / width:.1f}" for v in row["final_iqm"]]


def ranking(summary: Mapping[str, Any]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Returns the rows of a tournament's ranking, task by task; none of other studies."""
    rows = summary.get("ranking", [])
    tasks = dict.fromkeys(row["task"] for row in rows)
    return [(task, [row for row in rows if row["task"] == task]) for task in tasks]


def paper(results: Mapping[str, Any], summary: Mapping[str, Any]) -> dict[str, Any] | None:
    """Returns the paper's numbers beside those of our PPO, for the tasks that it has and as many
    env steps; None for others."""
    alike = {
        (cell["task"], cell["label"]): cell["config"].get("algorithm", "ppo") == "ppo"
        and cell["config"].get("steps", PAPER_STEPS) == PAPER_STEPS
        for cell in results["cells"]
    }
    ours = {key: row for row in summary["table"] if alike[key := (row["task"], row["label"])]}
    tasks = [task for task in dict.fromkeys(task for task, _ in ours) if unversioned(task) in PAPER]
    if not tasks:
        return None
    labels = list(dict.fromkeys(label for task, label in ours if task in tasks))
    rows = []
    for task in tasks:
        own = [ours.get((task, label)) for label in labels]
        rows.append(
            {
                "task": task,
                "printed": [_printed(*PAPER[unversioned(task)][arm]) for arm in ("PPO", "SAUNA")],
                "ours": own,
                "digits": digits_of(row["final_mean"] for row in own if row),
            }
        )
    return {"labels": labels, "rows": rows}


def _printed(mean: float, std: float) -> str:
    return f"{mean:,g}".replace("-", MINUS) + f" ± {std:g}"


def unversioned(task: str) -> str:
    """Returns the task's name without its version."""
    return re.sub(r"-v\d+$", "", task)


def failures(cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns every failed seed with all of its error's text."""
    return [
        {"task": cell["task"], "label": cell["label"], **member}
        for cell in cells
        for member in cell["members"]
        if member["status"] == "failed"
    ]


def settings(results: Mapping[str, Any]) -> dict[str, Any]:
    """Returns every setting: of each cell, and of what the study itself ran on."""
    base = {c["task"]: c for c in results["cells"] if c["label"] == results["baseline"]}
    members = [member for cell in results["cells"] for member in cell["members"]]
    evaluated = any("eval_return" in member for member in members)
    columns = [name for name in SEED_COLUMNS if evaluated or name not in OF_EVALUATIONS]
    groups = [
        (name, values)
        for name in ("settings", "versions", "machine")
        # A list: the runs differ in it.
        for values in (results[name] if isinstance(results[name], list) else [results[name]])
    ]
    return {
        "cells": [_cell(cell, base.get(cell["task"]), columns) for cell in results["cells"]],
        "seed_columns": [SEED_COLUMNS[name] for name in columns],
        "git": results["git"],
        "groups": groups,
    }


def _cell(
    cell: Mapping[str, Any], base: Mapping[str, Any] | None, columns: Sequence[str]
) -> dict[str, Any]:
    """A cell's command, its seeds one by one, and its settings beside the baseline's."""
    own = {"git revision": cell.get("git"), **cell["config"]}
    beside = base if base is not cell else None
    other = {"git revision": beside.get("git"), **beside["config"]} if beside else own
    return {
        "task": cell["task"],
        "label": cell["label"],
        "command": cell["command"],
        "baseline": beside["label"] if beside else "",
        "seeds": [
            {"seed": m["seed"], "status": m["status"], "numbers": _numbers(m, columns)}
            for m in cell["members"]
        ],
        "rows": [(k, v, other.get(k) != v, other.get(k)) for k, v in own.items()],
    }


def _numbers(member: Mapping[str, Any], columns: Sequence[str]) -> list[tuple[Any, int]]:
    """Each number of a seed, and its decimals."""
    found = []
    for key in columns:
        value = member[key] if key in member else member.get(FORMER_KEYS.get(key, key))
        whole = value is None or isinstance(value, int)
        found.append((value, 0 if whole else max(1, digits_of([value]))))
    return found
