"""`results/selection_standing.py`: which rules of the screen go on."""

from __future__ import annotations

from typing import Any

import pytest
from selection_standing import Standing, best, chance, ordered, planned_of, standing, standing_text

from sauna.experiments.study.spec import load_spec
from selection_cells import BASE, cell, study

TASKS = ("A-v5", "B-v5")
LABELS = ("ppo", "spo", "espo", "avec", "merl", "gigaflow", "gigaflow+random")
PLANNED = {(label, task): 5 for task in TASKS for label in LABELS}


def on(task: str, *without: str, **changed: dict[str, Any]) -> dict[str, Any]:
    """A result file in which each rule is a little better than the one before it."""
    returns = {label: BASE + i / 5 for i, label in enumerate(LABELS)}
    cells = [changed.get(x) or cell(x, y) for x, y in returns.items() if x not in without]
    return study(*({**own, "task": task} for own in cells))


def test_final_return_and_auc_count_alike_and_a_failed_seed_is_the_worst_in_both() -> None:
    base = cell("ppo", BASE)
    better = cell("spo", BASE + 50)
    assert chance(better, base) == 1.0
    lower_area = cell("spo", BASE + 50, auc=0.0)
    assert chance(lower_area, base) == 0.5
    # Two of five lose all of their comparisons, whatever their last numbers were.
    assert chance(cell("spo", BASE[:3] + 50, failed=2), base) == pytest.approx(0.6)
    assert chance(cell("spo", BASE[:0], failed=5), base) == 0.0


def test_a_rule_that_drops_next_to_nothing_gets_no_credit() -> None:
    base = cell("ppo", BASE)
    assert chance(cell("sauna", BASE + 50, keep_rate=0.9964), base) == 0.5
    assert chance(cell("sauna", BASE + 50, keep_rate=0.98), base) == 1.0
    assert chance(cell("sauna", BASE - 50, keep_rate=0.9964), base) == 0.0  # it may lose
    assert chance(cell("gigaflow", BASE + 50, sample_rate=0.995), base) == 0.5
    # These learn from as many samples by their nature.
    assert chance(cell("prioritized", BASE + 50, sample_rate=1.0), base) == 1.0
    assert chance(cell("spo", BASE + 50, sample_rate=1.0), base) == 1.0


def test_the_standing_is_the_mean_over_tasks_of_rules_alone() -> None:
    low = cell("merl", BASE - 50)
    rows = standing([on("A-v5"), on("B-v5", merl=low)], PLANNED)
    assert {row.label for row in rows} == set(LABELS) - {"ppo", "gigaflow+random"}
    merl = next(row for row in rows if row.label == "merl")
    one = chance(cell("merl", BASE + 0.8), cell("ppo", BASE))
    assert merl.chances == {"A-v5": one, "B-v5": 0.0}
    assert merl.mean == pytest.approx(one / 2)
    assert [row.mean for row in rows] == sorted((row.mean for row in rows), reverse=True)
    assert best(rows, PLANNED) == [row.label for row in rows[:4]]
    assert "The screen is complete. The four best are `gigaflow`, `avec`," in standing_text(
        rows, PLANNED
    )


@pytest.mark.parametrize(
    "second",
    [
        None,
        on("B-v5", "merl"),  # an arm has not begun
        on("B-v5", merl=cell("merl", BASE[:4])),  # a seed has not ended
        on("B-v5", ppo=cell("ppo", BASE[:4])),  # the baseline has not
    ],
)
def test_no_rule_is_chosen_while_a_task_is_missing(second: dict[str, Any] | None) -> None:
    studies = [on("A-v5"), *([second] if second else [])]
    rows = standing(studies, PLANNED)
    assert best(rows, PLANNED) is None
    text = standing_text(rows, PLANNED)
    assert "The screen is not complete: on 1 of 2 tasks some rule has seeds" in text
    assert "| `merl` | 0.6" in text or "| `merl` | 0.7" in text
    assert "| 1 of 2 |" in text and "four best" not in text


def test_a_failed_seed_has_ended() -> None:
    rows = standing(
        [on("A-v5"), on("B-v5", merl=cell("merl", BASE[:1], failed=4))],
        PLANNED,
    )
    assert best(rows, PLANNED) is not None


def test_rules_of_more_tasks_come_first() -> None:
    rows = standing([on("A-v5"), on("B-v5", "gigaflow")], PLANNED)
    assert rows[-1].label == "gigaflow" and rows[-1].mean > rows[0].mean


def row(label: str, mean: float, samples: float | None, seconds: float | None = None) -> Standing:
    return Standing(label, {"A-v5": mean}, samples, seconds)


def names(*rows: Standing) -> str:
    return "".join(found.label for found in ordered(rows))


def test_ties_go_to_the_rule_that_takes_less_compute() -> None:
    assert names(row("a", 0.60, 1.0), row("b", 0.59, 0.5)) == "ba"
    assert names(row("a", 0.60, 1.0), row("b", 0.589, 0.5)) == "ab"
    assert names(row("a", 0.60, 1.001, 1.6), row("b", 0.59, 1.0, 1.2)) == "ba"
    assert names(row("a", 0.60, 1.0, 1.2), row("b", 0.59, 1.0, 1.6)) == "ab"
    assert names(row("a", 0.60, None), row("b", 0.59, 2.0)) == "ba"
    # c is within 0.01 of b and not of a, the highest.
    assert names(row("a", 0.60, 1.0), row("b", 0.592, 1.0, 1.0), row("c", 0.585, 0.1)) == "bac"


def test_the_plan_of_the_screen_has_every_rule_on_every_task() -> None:
    names = ("mujoco", "minatar", "cartpole", "lunarlander")
    planned = planned_of(load_spec(f"selection-screen-{name}") for name in names)
    labels, tasks = ({key[i] for key in planned} for i in (0, 1))
    assert len(tasks) == 8 and len(planned) == len(labels) * len(tasks)
    assert set(planned.values()) == {5}
    assert {"sauna", "gigaflow+random", "vex-oracle"} < labels
