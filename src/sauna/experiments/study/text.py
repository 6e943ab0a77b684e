"""The summary of a study as lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sauna.experiments.report.numbers import aligned, digits_of_tasks, interval, number
from sauna.experiments.study.equal_compute import ABOUT as EQUAL_COMPUTE
from sauna.experiments.study.evaluations import has_evaluations
from sauna.experiments.study.ranking import ABOUT as RANKING
from sauna.experiments.study.tables import few_episodes, has_samplers
from sauna.experiments.study.verdicts import seeds_needed


def lines(summary: Mapping[str, Any]) -> list[str]:
    """Returns the table and the verdicts, as text."""
    sampled, evaluated = has_samplers(summary["table"]), has_evaluations(summary["table"])
    head = [
        "task",
        "arm",
        "seeds",
        "final return, IQM",
        "AUC, IQM",
        "mean +- std",
        *(["last evaluation"] if evaluated else []),
        "keep rate",
        *(["samples used"] if sampled else []),
        "env steps",
        "P(improvement)",
    ]
    digits = digits_of_tasks(summary["table"])
    table = summary["table"]
    rows = [head, *(_row(row, digits[row["task"]], sampled, evaluated) for row in table)]
    said = [v["text"] for v in summary["verdicts"]]
    if "ranking" in summary:
        said = [*ranking_lines(summary["ranking"]), "", RANKING]
    if summary["filtering"]:
        ablation = "Ablation of the selection rule. " + summary["about_filtering"]
        said += ["", ablation, *(v["text"] for v in summary["filtering"])]
    if seeds := seeds_needed([*summary["verdicts"], *summary["filtering"]]):
        said += ["", seeds]
    if equal := summary.get("equal_compute"):
        said += ["", "At equal compute. " + EQUAL_COMPUTE, *(v["text"] for v in equal)]
    said += summary.get("measured", [])
    few = few_episodes(summary["table"])
    return [*aligned(rows), *([few] if few else []), "", *said]


def ranking_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the ranking of a tournament, as text."""
    head = ["task", "rank", "arm", "P(improvement)", "seeds", "verdict", "stopped when, why"]
    texts = [
        head,
        *(
            [
                row["task"],
                str(row["rank"]),
                row["label"],
                interval(row["improvement"], 2),
                str(row["seeds"]),
                row["verdict"],
                row["reason"],
            ]
            for row in rows
        ),
    ]
    return aligned(texts)


def _row(row: Mapping[str, Any], digits: int, sampled: bool, evaluated: bool) -> list[str]:
    failed = f" ({row['failed']} failed)" if row["failed"] else ""
    stopped = f" ({row['stopped_early']} stopped early)" if row.get("stopped_early") else ""
    mean, std = number(row["final_mean"], digits), number(row["final_std"], digits)
    return [
        row["task"],
        row["label"],
        f"{row['seeds']}{failed}{stopped}",
        interval(row["final_iqm"], digits),
        interval(row["auc_iqm"], digits),
        f"{mean} +- {std}",
        *([number(row.get("eval_mean"), digits)] if evaluated else []),
        number(row["keep_rate"], 3),
        *([number(row["sample_rate"], 3)] if sampled else []),
        number(row["env_steps"], 0),
        interval(row["improvement"], 2),
    ]
