"""The report's numbers as HTML tables. All that comes from data is escaped here, and only once."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from sauna.experiments.report.numbers import digits_of, digits_of_tasks
from sauna.experiments.report.tables import DOT, MINUS, mean_and_std, number, table, with_interval

# Table 1 of the SAUNA paper, as printed.
PAPER: dict[str, dict[str, tuple[float, float]]] = {
    "HalfCheetah": {"PPO": (2277, 432), "SAUNA": (2929, 169)},
    "Hopper": {"PPO": (2106, 133), "SAUNA": (2250, 73)},
    "InvertedDoublePendulum": {"PPO": (6100, 143), "SAUNA": (6893, 350)},
    "InvertedPendulum": {"PPO": (532, 19), "SAUNA": (609, 24)},
    "Reacher": {"PPO": (-7.5, 0.8), "SAUNA": (-7.2, 0.3)},
    "Swimmer": {"PPO": (99.5, 5.4), "SAUNA": (100.8, 10.4)},
}
_PAPER_CAPTION = (
    "Final return. Ours: mean &plusmn; std. The paper's: as printed in its Table 1 (MuJoCo tasks "
    "of version 2, 10<sup>6</sup> steps, the last 100 episodes, 6 seeds). Versions and rules "
    "differ from ours: compare the arms of either side with each other, not numbers across."
)
_SEED_COLUMNS = {
    "final_return": "Final return",
    "area": "Area under curve",
    "keep_rate": "Keep rate",
    "explained_variance": "Explained variance",
    "env_steps": "Env steps",
    "kept_steps": "Kept steps",
    "episodes": "Episodes",
}


def main_table(results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Every task and label: returns, chance to be better, rates, steps and seeds."""
    labels = list(dict.fromkeys(cell["label"] for cell in results["cells"]))
    head = (
        "Arm",
        "Final return, IQM",
        f"Better than {escape(results['baseline'])}",
        "Area under curve, IQM",
        "Final return, mean &plusmn; std",
        "Keep rate",
        "Env steps",
        "Seeds",
    )
    rows: list[tuple[str, Sequence[str]]] = []
    for task, digits in digits_of_tasks(summary["table"]).items():
        of_task = [row for row in summary["table"] if row["task"] == task]
        rows.append((escape(task), ()))
        for row in of_task:
            final = with_interval(row["final_iqm"], digits)
            final += _whisker(row, of_task, labels.index(row["label"]))
            cells = (
                final,
                _improvement(row, results["baseline"]),
                with_interval(row["area_iqm"], digits),
                mean_and_std(row["final_mean"], row["final_std"], digits),
                number(row["keep_rate"], 3),
                number(row["env_steps"], 0),
                _seed_counts(row),
            )
            rows.append((escape(row["label"]), cells))
    return table(head, rows, name="Results by task and arm")


def _improvement(row: Mapping[str, Any], baseline: str) -> str:
    """The chance to be better; than what, where that is not the study's baseline."""
    text = with_interval(row["improvement"], 2)
    if row["baseline"] in (None, baseline):
        return text
    return f'{text} <span class="interval">than {escape(row["baseline"])}</span>'


def _seed_counts(row: Mapping[str, Any]) -> str:
    text = str(row["seeds"])
    if row["failed"]:
        text += f' <a class="interval" href="#failed">{row["failed"]} failed</a>'
    if row["running"]:
        text += f' <span class="interval">{row["running"]} running</span>'
    return text


def _whisker(row: Mapping[str, Any], of_task: Sequence[Mapping[str, Any]], index: int) -> str:
    """The interval as a line and the value as a dot, on one scale for the task."""
    ends = [v for other in of_task for v in other["final_iqm"] if v is not None]
    value, low, high = row["final_iqm"]
    if value is None or low is None or high is None or min(ends) == max(ends):
        return ""
    x, left, right = (
        4 + 112 * (v - min(ends)) / (max(ends) - min(ends)) for v in (value, low, high)
    )
    return (
        f'<svg class="whisker" width="120" height="10" aria-hidden="true" '
        f'style="color:var(--line{index})"><line x1="{left:.1f}" x2="{right:.1f}" y1="5" y2="5"/>'
        f'<circle cx="{x:.1f}" cy="5" r="3.5"/></svg>'
    )


def over_tasks(results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """The comparison over all tasks together; nothing where there is one task."""
    if not summary["over_tasks"]:
        return ""
    rows = [
        (escape(row["label"]), (str(row["tasks"]), _improvement(row, results["baseline"])))
        for row in summary["over_tasks"]
    ]
    head = ("Arm", "Tasks", f"Better than {escape(results['baseline'])}")
    return "<h3>Over all tasks</h3>" + table(head, rows, name="Over all tasks")


def paper(results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """The paper's numbers beside those of our PPO, for the tasks that it has; else nothing."""
    is_ppo = {
        (cell["task"], cell["label"]): cell["config"].get("algorithm", "ppo") == "ppo"
        for cell in results["cells"]
    }
    ours = {key: row for row in summary["table"] if is_ppo[key := (row["task"], row["label"])]}
    tasks = [task for task in dict.fromkeys(task for task, _ in ours) if unversioned(task) in PAPER]
    if not tasks:
        return ""
    labels = list(dict.fromkeys(label for task, label in ours if task in tasks))
    head = ("Task", "PPO, the paper", "SAUNA, the paper", *(f"{escape(x)}, here" for x in labels))
    found = []
    for task in tasks:
        cells = [_as_printed(*PAPER[unversioned(task)][arm]) for arm in ("PPO", "SAUNA")]
        own = [ours.get((task, label)) for label in labels]
        digits = digits_of(row["final_mean"] for row in own if row)
        cells += [
            mean_and_std(row["final_mean"], row["final_std"], digits) if row else "-" for row in own
        ]
        found.append((escape(task), cells))
    return (
        f'<section id="paper"><h2>Beside the paper</h2><p>{_PAPER_CAPTION}</p>'
        f"{table(head, found, name='Beside the paper')}</section>"
    )


def _as_printed(mean: float, std: float) -> str:
    return f"{mean:,g}".replace("-", MINUS) + f" &plusmn; {std:g}"


def unversioned(task: str) -> str:
    """The task's name without its version."""
    return re.sub(r"-v\d+$", "", task)


def failures(cells: Sequence[Mapping[str, Any]]) -> str:
    """Every failed seed with all of its error's text; nothing where none failed."""
    items = "".join(
        f"<li>{escape(cell['task'])} {DOT} {escape(cell['label'])} {DOT} "
        f"seed {member['seed']}<pre>{escape(member['error'] or '-')}</pre></li>"
        for cell in cells
        for member in cell["members"]
        if member["status"] == "failed"
    )
    if not items:
        return ""
    return (
        '<section id="failed"><h2>Failed seeds</h2><p>These are left out of every number '
        f'above.</p><ul class="failed">{items}</ul></section>'
    )


def settings(results: Mapping[str, Any]) -> str:
    """Every setting: one fold for each cell, and one for what the study itself ran on."""
    base = {c["task"]: c for c in results["cells"] if c["label"] == results["baseline"]}
    folds = "".join(_cell(cell, base.get(cell["task"])) for cell in results["cells"])
    parts = {name: results[name] for name in ("settings", "versions", "machine")}
    rows: list[tuple[str, Sequence[str]]] = [("git revision", [_value(results["git"])])]
    for name, found in parts.items():
        for values in found if isinstance(found, list) else [found]:  # a list: runs differ in it
            rows.append((name, ()))
            rows += [(escape(key), [_value(value)]) for key, value in values.items()]
    return folds + _fold("The study: settings, versions, machine", table(("Name", "Value"), rows))


def _cell(cell: Mapping[str, Any], base: Mapping[str, Any] | None) -> str:
    """A cell's command, its seeds one by one, and its settings beside the baseline's."""
    seeds = [(str(member["seed"]), _seed_cells(member)) for member in cell["members"]]
    own = cell["config"]
    other = base["config"] if base and base is not cell else own
    head = ["Setting", "Value"] + (
        [f"Where {escape(base['label'])} differs"] if base and other is not own else []
    )
    revisions = [_value(c.get("git")) for c in ([cell, base] if base else [cell])]
    revisions[1:] = ["" if revisions[0] == other else other for other in revisions[1:]]
    rows = [("git revision", revisions[: len(head) - 1])]
    for key, value in own.items():
        differs = _value(other.get(key)) if other.get(key) != value else ""
        rows.append((escape(key), [_value(value), differs][: len(head) - 1]))
    name = f"{escape(cell['task'])} {DOT} {escape(cell['label'])}"
    return _fold(
        name,
        f'<pre class="command">{escape(cell["command"])}</pre>'
        + table(("Seed", "Status", *_SEED_COLUMNS.values()), seeds, name=f"Seeds of {name}")
        + table(head, rows, name=f"Settings of {name}"),
    )


def _seed_cells(member: Mapping[str, Any]) -> list[str]:
    cells = [escape(member["status"])]
    for key in _SEED_COLUMNS:
        value = member[key]
        whole = value is None or isinstance(value, int)
        cells.append(number(value, 0 if whole else max(1, digits_of([value]))))
    return cells


def _fold(name: str, inside: str) -> str:
    return f"<details><summary>{name}</summary>{inside}</details>"


def _value(value: Any) -> str:
    if value is None or value == "":
        return "-"
    return escape(value if isinstance(value, str) else json.dumps(value))
