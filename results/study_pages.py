"""The page of a study that compares returns: a table, a figure, the decided comparisons.

Everything else is folded, task by task.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from collapse import collapse_text
from studies import (
    DECIDED,
    TITLES,
    WHY,
    folded,
    former_controls,
    listed,
    markdown,
    page,
    shown_label,
)

from sauna.experiments.report.numbers import digits_of, digits_of_tasks, interval, number
from sauna.experiments.study.spec import load_spec
from sauna.experiments.study.tables import PAPER, unversioned
from sauna.experiments.study.verdicts import seeds_needed

CAPTION = (
    "*Training return, mean of the last 100 episodes. Line: mean of the seeds. Band: 95% interval "
    "of the mean.*"
)
# PPO's published means for 10^6 steps, for orientation: the paper's Table 1 and baselines on v2
# tasks, CleanRL on v4 tasks.
PUBLISHED = {
    "HalfCheetah-v5": ("2277", "1669", "1443"),
    "Hopper-v5": ("2106", "2316", "2383"),
    "InvertedDoublePendulum-v5": ("6100", "7103", "-"),
    "InvertedPendulum-v5": ("532", "809", "963"),
    "Reacher-v5": ("-7.5", "-6.7", "-"),
    "Swimmer-v5": ("99.5", "111", "-"),
}


def study_page(name: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """A study's page: table, figure, decided comparisons; the rest is folded."""
    alone = len(summary["table"]) == 1
    about = ABOUT[name](results) if name in ABOUT else ""
    tasks = "\n\n".join(_of_task(task, name, results, summary) for task in summary["curves"])
    return page(
        "study",
        name=name,
        title=TITLES[name],
        why=WHY[name],
        facts=_facts(results),
        about=about,
        overview=overview(results, summary),
        legend="" if alone else _legend(summary),
        controls=former_controls(results["cells"], [name]),
        caption="" if alone else CAPTION,
        decided=_decided([*summary["verdicts"], *summary["filtering"]]),
        missing=_missing(name, results),
        same_runs=_same_runs(results),
        tasks="" if alone else tasks,
    )


def _facts(results: Mapping[str, Any]) -> str:
    settings = results["settings"]
    preset = results["cells"][0]["preset"]
    seeds = f"{settings['seeds']} seed" + ("s" if settings["seeds"] != 1 else "")
    return (
        f"`{results['command']}`: {seeds} per arm, {int(settings['steps']):,} env steps each, "
        f"preset `{preset}`. Returns are training returns (sampled actions, last 100 episodes)."
    )


def overview(results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Arms against tasks: the IQM of the final return, marked where a comparison is decided."""
    table, digits = summary["table"], digits_of_tasks(summary["table"])
    tasks, labels = list(digits), list(dict.fromkeys(row["label"] for row in table))
    kinds = {(v["task"], v["label"]): v["kind"] for v in summary["verdicts"]}
    cells = {(row["task"], row["label"]): row for row in table}
    baselines = {row["label"]: row["baseline"] for row in table}
    head = ["Arm", *map(_column, tasks), "Keep rate", "Compared with"]
    rows = [head]
    for label in labels:
        shown = []
        for task in tasks:
            cell, kind = cells.get((task, label)), kinds.get((task, label))
            text = number(cell["final_iqm"][0], digits[task]) if cell else "-"
            shown.append(f"**{text} {kind}**" if kind in DECIDED else text)
        rates = [c["keep_rate"] for t in tasks if (c := cells.get((t, label))) and c["keep_rate"]]
        baseline = baselines[label]
        rows.append(
            [
                f"`{label}`",
                *shown,
                _range(rates),
                baseline or "-",
            ]
        )
    return markdown(rows)


def _column(task: str) -> str:
    """A task's name, which may break at its capitals."""
    name = unversioned(task).removeprefix("gymnax/").removesuffix("-MinAtar")
    name = name.removeprefix("sauna.envs.memory_tasks:")
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "&shy;", name)


def _legend(summary: Mapping[str, Any]) -> str:
    ends = any(row["label"] == "ppo, limits end" for row in summary["table"])
    return (
        "IQM of the seeds' final returns. **better** and **worse** mark decided comparisons with "
        "the arm in the last column. A keep rate of 1.000 means that nothing was dropped."
        + " In `ppo, limits end` a time limit counts as the end of the episode, as in the authors' "
        "code." * ends
    )


def _range(values: list[float]) -> str:
    if not values:
        return "-"
    low, high = f"{min(values):.3f}", f"{max(values):.3f}"
    return low if low == high else f"{low} to {high}"


def _decided(verdicts: list[dict[str, Any]]) -> str:
    if not verdicts:
        return ""
    decided = [verdict["text"] for verdict in verdicts if verdict["kind"] in DECIDED]
    head = f"## Decided comparisons: {len(decided)} of {len(verdicts)}"
    return f"{head}\n\n{listed(decided)}" if decided else f"{head}\n\nNone is decided."


def _of_task(task: str, name: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Every arm and every comparison of one task, folded."""
    verdicts = [v["text"] for v in summary["verdicts"] if v["task"] == task]
    controls = [v["text"] for v in summary["filtering"] if v["task"] == task]
    parts = [arms_table(task, name, results, summary)]
    if verdicts:
        parts += ["Against the baseline:", listed(verdicts)]
    if controls:
        parts += [
            "Ablation of the selection rule (against the head-only ablation and the matched "
            "random control):",
            listed(controls),
        ]
    both = [v for v in [*summary["verdicts"], *summary["filtering"]] if v["task"] == task]
    if seeds := seeds_needed(both):
        parts.append(seeds)
    return folded(f"{task}: all arms and comparisons", "\n\n".join(parts))


def arms_table(task: str, name: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Every arm of one task, the paper's numbers beside it."""
    wanted = {arm.label: len(arm.seeds) for arm in load_spec(name).arms}
    digits = digits_of_tasks(summary["table"])[task]
    paper = results["settings"].get("algorithm", "ppo") == "ppo" and unversioned(task) in PAPER
    head = [
        "Arm",
        "Seeds",
        "Final return, IQM [95%]",
        "Mean ± std",
        "Keep rate",
        "Probability of improvement [95%]",
    ]
    rows = [[*head, "Paper (v2)"] if paper else head]
    for row in summary["table"]:
        if row["task"] != task:
            continue
        label = row["label"]
        failed = f", {row['failed']} failed" if row["failed"] else ""
        mean, std = (number(row[key], digits) for key in ("final_mean", "final_std"))
        cells = [
            shown_label(label),
            f"{row['seeds']} of {wanted.get(label, row['seeds'])}{failed}",
            interval(row["final_iqm"], digits),
            f"{mean} ± {std}",
            number(row["keep_rate"], 3),
            interval(row["improvement"], 2),
        ]
        rows.append([*cells, _paper(task, label)] if paper else cells)
    return markdown(rows)


def _paper(task: str, label: str) -> str:
    """The paper's Table 1, beside its PPO and beside the variants of its method."""
    known = PAPER.get(unversioned(task), {})
    column = "PPO" if label.startswith("ppo") else "SAUNA" if _is_variant(label) else ""
    return f"{known[column][0]} ± {known[column][1]}" if column in known else "-"


def _is_variant(label: str) -> bool:
    return label.startswith("sauna") and not label.endswith("random")


def _same_runs(results: Mapping[str, Any]) -> str:
    """Names the arms whose runs are the same as far as both go: evidence that counts once."""
    said = []
    for task in dict.fromkeys(cell["task"] for cell in results["cells"]):
        cells = [cell for cell in results["cells"] if cell["task"] == task]
        said += [
            f"On {task} `{a['label']}` and `{b['label']}` are the same runs up to the point where "
            f"one of them stops. Count their evidence once."
            for a, b in itertools.combinations(cells, 2)
            if _agree(a, b)
        ]
    return listed(said)


def _agree(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    curves = [
        {
            m["seed"]: dict(zip(m["curve"]["env_steps"], m["curve"]["return_mean"], strict=True))
            for m in cell["members"]
        }
        for cell in (a, b)
    ]
    if not curves[0] or set(curves[0]) != set(curves[1]):
        return False
    for seed, one in curves[0].items():
        other = curves[1][seed]
        both = [step for step in set(one) & set(other) if one[step] is not None]
        if len(both) < 3 or any(one[step] != other[step] for step in both):
            return False
    return True


def _missing(name: str, results: Mapping[str, Any]) -> str:
    """Names what of a study is not trained yet."""
    done = {
        (c["task"], c["label"]): sum(m["status"] == "complete" for m in c["members"])
        for c in results["cells"]
    }
    missing = []
    for arm in load_spec(name).arms:
        tasks = [t for t in arm.tasks if done.get((t, arm.label), 0) < len(arm.seeds)]
        if tasks:
            every = len(tasks) == len(arm.tasks) > 1
            missing.append(f"{arm.label} ({'every task' if every else ', '.join(tasks)})")
    return f"Not trained to the end yet: {'; '.join(missing)}." if missing else ""


def ppo_table(results: Mapping[str, Any]) -> str:
    """PPO's final training returns beside published numbers."""
    rows = [
        [
            "Task",
            "PPO here, mean ± std",
            "Seeds, lowest to highest",
            "Paper (v2)",
            "baselines (v2)",
            "CleanRL (v4)",
        ]
    ]
    for cell in results["cells"]:
        if cell["label"] not in ("ppo", "ppo, limits end"):
            continue
        complete = [m for m in cell["members"] if m["status"] == "complete"]
        final = sorted(m["final_return"] for m in complete if m["final_return"] is not None)
        if not final:
            continue
        mean, std = float(np.mean(final)), float(np.std(final, ddof=1))
        digits = digits_of([mean])
        task = cell["task"] + (", limits end" if cell["label"] != "ppo" else "")
        seeds = ", ".join(number(x, digits) for x in final)
        rows.append(
            [
                task,
                f"{number(mean, digits)} ± {number(std, digits)}",
                seeds,
                *PUBLISHED[cell["task"]],
            ]
        )
    return markdown(rows)


def ppo_page(results: Mapping[str, Any]) -> str:
    """`docs/results/ppo.md`."""
    return page("ppo", table=ppo_table(results))


def pong_text(results: Mapping[str, Any]) -> str:
    """How the one seed of `pong` went, and its curve."""
    member = results["cells"][0]["members"][0]
    steps, score = (member["curve"][key] for key in ("env_steps", "return_mean"))
    known = [(n, x) for n, x in zip(steps, score, strict=True) if x is not None]
    if member["status"] != "complete" or not known:
        return f"The run failed (`{results['command']}`)."
    (early, low), (late, high) = known[0], known[-1]
    return (
        f"One seed of PPO (`{results['command']}`): the mean training score of the last 100 games "
        f"rises from {low:.1f} after {early:,} env steps to {high:.1f} after {late:,}."
    )


# What a page says of its study alone.
ABOUT = {"pong": pong_text, "late-collapse": collapse_text}
