"""`results/claims.py`: what is said of the paper's claims follows from the members alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from claims import CLAIMS, HEADER, claims_rows, sentences

from sauna.experiments.study.tables import PAPER

LOW, HIGH = np.arange(6.0), np.arange(6.0) + 10
TASKS = ("A-v5", "B-v5", "C-v5")


def cell(task: str, label: str, scores: np.ndarray, keep_rate: float = 1.0) -> dict[str, Any]:
    members = [
        {
            "status": "complete",
            "final_return": x,
            "auc": -x,
            "keep_rate": keep_rate,
            "env_steps": 1000.0,
        }
        for x in scores.tolist()
    ]
    return {"task": task, "label": label, "arm": label, "members": members}


def study(sauna: tuple[np.ndarray, ...], keep_rate: float = 0.8) -> dict[str, Any]:
    cells = [cell(task, "ppo", LOW) for task in TASKS]
    pairs = zip(TASKS, sauna, strict=False)
    cells += [cell(task, "sauna", x, keep_rate) for task, x in pairs]
    return {"baseline": "ppo", "settings": {"seeds": 6}, "cells": cells}


def said(results: dict[str, Any], claim: int = 0) -> dict[str, str]:
    rows = [dict(zip(HEADER, row, strict=True)) for row in claims_rows(results)]
    (row,) = [row for row in rows if row["claim"] == CLAIMS[claim].text]
    return row


@pytest.mark.parametrize(
    "sauna, so",
    [
        ((HIGH, HIGH, HIGH), "better on A, B, C; better over the tasks by the interval"),
        ((HIGH, LOW, LOW), "better on A, not decided on the other 2"),
        ((LOW, LOW, LOW), "not decided"),
        ((-HIGH, LOW, LOW), "does not hold: worse on A"),
        ((-HIGH, -HIGH, LOW), "does not hold: worse on A, B; worse over the tasks by the interval"),
        ((-HIGH, HIGH, LOW), "does not hold: worse on A, better on B"),
    ],
)
def test_a_claim_is_judged_by_every_task(sauna, so) -> None:
    row = said(study(sauna))
    assert (row["arm"], row["against"], row["tasks"], row["so"]) == ("sauna", "ppo", "3", so)


def test_the_tests_of_a_claim_are_one_family() -> None:
    """Won 31 of 36 pairs: p = 0.041 alone, and 0.123 of three."""
    won = np.array([2.5, 3.5, 5.5, 6.5, 7.5, 8.5])
    alone = study((won,))
    alone["cells"] = [cell for cell in alone["cells"] if cell["task"] == TASKS[0]]
    assert said(alone)["so"] == "better on A"
    assert said(study((won, LOW, LOW)))["so"] == "not decided"


def test_the_auc_is_judged_by_the_auc() -> None:
    assert said(study((HIGH, HIGH, HIGH)), claim=1)["so"].startswith("does not hold")


def test_what_is_not_trained_to_the_end_is_not_judged() -> None:
    so = said(study((HIGH, HIGH)))["so"]
    assert so == "better on A, B; better over the tasks by the interval (2 of 3 tasks so far)"
    assert claims_rows(study((HIGH[:5],))) == []


def test_it_holds_on_the_papers_tasks_and_on_no_fewer() -> None:
    cells = [cell(task, "ppo", LOW) for task in PAPER]
    cells += [cell(task, "sauna", HIGH, 0.8) for task in PAPER]
    results = {"baseline": "ppo", "settings": {"seeds": 6}, "cells": cells}
    assert said(results)["so"] == "holds; better over the tasks by the interval"
    for member in results["cells"][-1]["members"]:
        member["keep_rate"] = 1.0
    assert said(results)["so"].endswith("; it drops at most 1% of its steps on Swimmer")


@pytest.mark.parametrize("keep_rate", [0.995, 1.0])
def test_no_credit_for_filtering_next_to_nothing(keep_rate: float) -> None:
    row = said(study((HIGH,) * 3, keep_rate))
    assert row["so"].endswith("; it drops at most 1% of its steps")
    assert row["keep rate"] == f"{keep_rate:.3f}"


def test_no_credit_where_it_filtered_nothing_on_the_task_it_won() -> None:
    results = study((HIGH, LOW, LOW), 0.8)
    for member in results["cells"][3]["members"]:
        member["keep_rate"] = 1.0
    assert said(results)["so"] == (
        "better on A, not decided on the other 2; it drops at most 1% of its steps on A"
    )


def test_a_random_control_of_either_kind_is_found() -> None:
    """One that repeated the drop rates of `sauna 0.8`, as in 0.1.0, and one with its settings."""
    threshold = "sauna train A-v5 --threshold {} --arm {} --seeds 0,1"
    own = [
        cell(task, "sauna 0.8", HIGH, 0.8)
        | {"arm": "sauna", "command": threshold.format(0.8, "sauna")}
        for task in TASKS
    ]
    former = [cell(task, "coin", LOW, 0.8) | {"rates_of": "sauna 0.8"} for task in TASKS]
    today, other = (
        [
            cell(task, f"{value} random", LOW, 0.8)
            | {"arm": "sauna+random", "command": threshold.format(value, "sauna+random")}
            for task in TASKS
        ]
        for value in (0.8, 0.3)
    )
    results = {"baseline": "ppo", "settings": {"seeds": 6}}
    for cells, label in ((former, "coin"), (today, "0.8 random"), (former + today, "0.8 random")):
        row = said({**results, "cells": own + other + cells}, claim=4)
        assert (row["against"], row["so"].split(";")[0]) == (label, "better on A, B, C")
    row = said({**results, "cells": own + former + today[:2]}, claim=4)
    assert row["against"] == "coin"  # until the other has as many tasks
    assert claims_rows({**results, "cells": own + other}) == []


def test_failed_seeds_count_as_the_worst_outcome() -> None:
    results = study((HIGH, HIGH, HIGH))
    results["cells"][-1]["members"][0] |= {"status": "failed", "final_return": None}
    assert said(results)["so"] == (
        "better on A, B, not decided on the other 1; better over the tasks by the interval; "
        "1 failed seeds count as the worst outcome"
    )


def test_more_env_steps_are_told() -> None:
    results = study((HIGH, HIGH, HIGH))
    for steps, told_ in (
        (1020.0, "; it took up to 1.02 times the env steps"),
        (1010.0, "interval"),
    ):
        for member in results["cells"][-1]["members"]:
            member["env_steps"] = steps
        assert said(results)["so"].endswith(told_)


def test_a_sentence_for_each_claim() -> None:
    """An arm beside another than the claim's first pair has names it."""
    first, second = CLAIMS[0].text, CLAIMS[3].text
    rows = [
        [first, "x", "ppo", "holds"],
        [first, "y", "ppo", "not decided"],
        [first, "z", "ppo", "holds"],
        [first, "r", "ppo, limits end", "holds"],
        [second, "x", "ppo", "holds"],
    ]
    assert sentences(rows) == [
        f"**{first}.** `x`, `z`: holds. `y`: not decided. `r` (against `ppo, limits end`): holds.",
        f"**{second}.** `x`: holds.",
    ]
