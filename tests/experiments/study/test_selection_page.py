"""`results/selection_page.py` and what it is made of: words, marks, tables of a task."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import selection_page
from selection_arms import arms, share_to_level
from selection_trainings import seeds_said
from selection_words import (
    compute_word,
    difference_interval,
    shown_chance,
    shown_improvement,
    shown_ratio,
    word_of,
    words_of,
)

from sauna.experiments.study.summary import summarize
from selection_cells import BASE, cell, study

NONE = np.full(5, -np.inf)  # what seeds that failed are compared as


@pytest.mark.parametrize(
    ("improvement", "own", "expected"),
    [
        ([0.9, 0.6, 1.0], BASE + 50, "better"),
        ([0.1, 0.0, 0.4], BASE - 50, "worse"),
        ([0.6, 0.4, 0.8], BASE + 1, "same"),  # 1% of 100, and hardly any spread
        ([0.6, 0.4, 0.8], BASE + 11, "not decided"),  # more than 10% of the mean
        ([0.6, 0.4, 0.8], BASE + np.array([-40, 40, 0, -20, 20]), "not decided"),
        ([0.6, None, None], BASE[:1], "not decided"),
        ([0.6, 0.4, 0.8], BASE[:1], "not decided"),  # one seed has no interval
        # Without the failed seed the means would be the same.
        ([0.4, 0.2, 0.7], np.array([*BASE[:4], -np.inf]), "not decided"),
        ([0.0, 0.0, 0.55], NONE[:3], "worse"),
    ],
)
def test_words(improvement: list[float | None], own: np.ndarray, expected: str) -> None:
    assert word_of(improvement, own, BASE) == expected


def test_welchs_interval_by_hand() -> None:
    x, y = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 6.0])
    # Variances 1 and 4: standard error sqrt(1/3 + 4/3), 2.94 degrees of freedom, t = 3.2207.
    error, freedom = np.sqrt(5 / 3), (5 / 3) ** 2 / ((1 / 3) ** 2 / 2 + (4 / 3) ** 2 / 2)
    assert freedom == pytest.approx(2.941, abs=1e-3)
    low, high = difference_interval(x, y)
    assert (low + high) / 2 == pytest.approx(-2.0)
    assert (high - low) / 2 == pytest.approx(3.2207 * error, rel=1e-3)
    assert difference_interval(BASE * 0, BASE * 0 + 1) == (-1.0, -1.0)


def test_a_cell_says_the_word_the_probability_and_the_share_of_compute() -> None:
    cells = [
        cell("ppo", BASE, 1000.0),
        cell("half", BASE + 50, 500.0),
        cell("low", BASE - 50, 500.0),
    ]
    results = study(*cells)
    summary = summarize(results)
    words = words_of(results, summary)
    assert set(words) == {("half", "A-v5"), ("low", "A-v5")}
    # 100 of 150 is reached after two thirds of 500 samples, a third of the 1000 of `ppo`.
    half, low = words["half", "A-v5"], words["low", "A-v5"]
    assert half.shown.startswith('<span class="better">better</span> 1.00<br>x 0.33 [')
    assert low.shown.startswith('<span class="worse">worse</span> 0.00<br>not reached')
    assert "| `half` | 5 | 0 | 150.0 ± 0.8 |" in arms("A-v5", results, summary)
    assert "| `half` | 0.50 of PPO's | x 0.33 [" in arms("A-v5", results, summary)


def test_the_answer_counts_tasks_and_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection_page, "load", lambda name: None)
    assert selection_page.screen_answer() is None

    def on(task: str, *cells: dict[str, Any]) -> dict[str, Any]:
        of_task = [{**own, "task": task} for own in cells]
        return study(*of_task)

    ppo, high = cell("ppo", BASE, 1000.0), cell("high", BASE + 50, 1000.0)
    low, control = cell("low", BASE - 50, 1000.0), cell("low+random", BASE + 50, 1000.0)
    found = {
        "selection-screen-cartpole": on("CartPole-v1", ppo, high, low, control),
        "selection-screen-mujoco": on("Hopper-v5", ppo, high),
    }
    monkeypatch.setattr(selection_page, "load", found.get)
    labels, tasks = ["ppo", "high", "low", "low+random"], ["CartPole-v1", "Hopper-v5"]
    planned = {(label, task): 5 for label in labels for task in tasks}
    monkeypatch.setattr(selection_page, "planned_of", lambda specs: planned)
    answer = selection_page.screen_answer()
    assert answer is not None
    whole = "All rules are trained on 1 of 8 tasks, some on 1 more, with 5 seeds."
    assert answer.startswith(f"**not decided**. {whole} By the intervals")
    assert "better on a task: `high`, and 1 of 2 scored worse on a task" in answer
    planned["untrained", "CartPole-v1"] = 5  # a rule that no task has yet counts, too
    assert "on 0 of 8 tasks, some on 2 more" in (selection_page.screen_answer() or "")


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [
        (None, "-"),
        ([None, None, None], "not reached"),
        ([0.5, 0.3, 0.9], "better"),
        ([0.5, 0.3, 1 - 1e-9], "not decided"),  # 1 but for the order of additions
        ([0.5, 0.3, None], "not decided"),  # a resample never reaches it
        ([1.5, 1.2, 2.0], "worse"),
        ([1.5, 1.2, None], "worse"),
        ([0.5, None, None], "not decided"),
    ],
)
def test_words_at_equal_compute(ratio: list[float | None] | None, expected: str) -> None:
    assert compute_word(ratio) == expected


def test_a_ratio_shows_on_which_side_of_1_its_interval_ends() -> None:
    assert shown_ratio([0.5, 0.3, 0.9996]) == "x 0.50 [0.30, 0.9996]"
    assert shown_ratio([0.5, 0.3, 1 - 1e-9]) == "x 0.50 [0.30, 1.00]"
    assert shown_ratio([1.5, 1.0004, None]) == "x 1.50 [1.0004, -]"
    assert shown_ratio([0.5, None, None]) == "x 0.50"


def test_the_first_page_shows_two_words_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection_page, "load", lambda name: None)
    assert selection_page.glance() == "The screen has not been trained yet."
    high, low = BASE + 50, BASE - 50
    cells = [cell("ppo", BASE, 1000.0), cell("spo", low), cell("kondo", high, 500.0)]
    cells += [cell("kondo+random", low, 500.0), cell("pods", high, 500.0)]
    cells += [cell("pods+random", high, 500.0)]
    found = {"selection-screen-mujoco": study(*cells)}
    monkeypatch.setattr(selection_page, "load", found.get)
    lines = selection_page.glance().splitlines()
    assert lines[0] == "| Rule | [A](selection.md#a) |" and len(lines) == 2 + 3
    worse, better, alike = lines[2:]
    assert '<span class="worse">worse</span><br><span class="not-reached">' in worse
    assert better == (
        '| `kondo` | [<span class="better">better</span><br><span class="better">better</span>]'
        "(selection.md#a) |"
    )
    assert ">better</span><br>" in alike and ">better, as its control</span>](" in alike


def shown(*cells: dict[str, Any]) -> dict[str, str]:
    """What the table shows of each arm on the only task."""
    results = study(*cells)
    return {label: c.shown for (label, _), c in words_of(results, summarize(results)).items()}


def test_failed_seeds_never_flatter_an_arm() -> None:
    """The seeds that are left are better than PPO, and would reach its return at once."""
    base, well = cell("ppo", BASE), BASE + 50
    found = {n: shown(base, cell("spo", well[n:], failed=n))["spo"] for n in range(6)}
    assert found[0].startswith('<span class="better">better</span> 1.00<br>x 0.67 [')
    for n in range(1, 6):
        word = "worse" if n == 5 else "not decided"
        assert f">{word}</span> {1 - n / 5:.2f}<br>not reached<br>{n} of 5 failed" in found[n]
    assert "-<br>" not in shown(base, cell("spo", BASE[:0], failed=3))["spo"]
    assert ">worse</span> 0.00" in shown(base, cell("spo", BASE[:0], failed=3))["spo"]
    lost = study(base, cell("spo", BASE[:0], failed=5))
    assert "| `spo` | 0 | 5 | - | - | 0.00 [" in arms("A-v5", lost, summarize(lost))


def test_an_arm_is_not_the_same_as_ppo_if_a_seed_failed() -> None:
    base = cell("ppo", BASE)
    assert ">same<" in shown(base, cell("spo", BASE + 0.1))["spo"]
    assert ">not decided<" in shown(base, cell("spo", BASE[1:] + 0.1, failed=1))["spo"]
    assert ">not decided<" in shown(cell("ppo", BASE[1:], failed=1), cell("spo", BASE))["spo"]


def test_a_rule_that_drops_next_to_nothing_is_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    base = cell("ppo", BASE)
    idle, active = (cell("sauna", BASE + 50, keep_rate=rate) for rate in (0.9964, 0.98))
    assert shown(base, idle)["sauna"].endswith("<br>drops 0.36%")
    assert "drops" not in shown(base, active)["sauna"]
    assert "drops" not in shown(base, cell("spo", BASE, sample_rate=1.0))["spo"]
    assert "drops" not in shown(base, cell("gigaflow", BASE))["gigaflow"]  # not recorded then
    results = study(base, idle)
    text = arms("A-v5", results, summarize(results))
    assert "`sauna` left out 0.36% of its samples. No difference can be credited" in text
    monkeypatch.setattr(selection_page, "load", {selection_page.SCREENS[0]: results}.get)
    assert "no rule beats `ppo`" in (selection_page.screen_answer() or "")


def test_one_training_under_two_names_is_said() -> None:
    one, two = cell("pods+random", BASE + 1), cell("gigaflow+random", BASE + 1)
    cells = [cell("ppo", BASE), one, two]
    assert shown(*cells)["gigaflow+random"].endswith("<br>same training as `pods+random`")
    assert "same training" not in shown(*cells)["pods+random"]
    text = arms("A-v5", study(*cells), summarize(study(*cells)))
    assert "`gigaflow+random` is the same training as `pods+random`" in text
    two["members"][3]["auc"] += 1e-9
    assert "same training" not in shown(*cells)["gigaflow+random"]
    lost = [cell(f"{name}+random", BASE[:0], failed=5) for name in ("pods", "gigaflow")]
    assert "same training" not in "".join(shown(cells[0], *lost).values())


def test_seeds_on_which_a_rule_did_nothing_are_counted() -> None:
    returns = BASE + np.array([0, 0, 0, 1, 0])
    stop = cell("target-kl", returns)
    stop["members"][4]["env_steps"] += 1
    cells = [cell("ppo", BASE), stop]
    assert shown(*cells)["target-kl"].endswith("<br>is `ppo` in 3 of 5 seeds")
    text = arms("A-v5", study(*cells), summarize(study(*cells)))
    assert "AUC and the env steps of `ppo` in 3 of 5 seeds. There the rule changed nothing" in text
    assert "is `ppo`" not in shown(cells[0], cell("spo", BASE + 1))["spo"]


def test_compute_is_counted_in_seconds_and_gradient_steps_where_they_are_known() -> None:
    cells = [
        cell("ppo", BASE, learner_cpu_seconds=10.0, gradient_steps=100.0),
        cell("recompute", BASE, learner_cpu_seconds=16.2, gradient_steps=50.0),
        cell("spo", BASE),  # of before
    ]
    text = arms("A-v5", study(*cells), summarize(study(*cells)))
    assert "| CPU seconds of the learner | Gradient steps |" in text
    assert "] | 1.62 of PPO's | 0.50 of PPO's |" in text
    assert "] | - | - |" in text
    former = study(cells[2], cell("ppo", BASE))
    text = arms("A-v5", former, summarize(former))
    assert "CPU seconds" not in text and "Gradient steps" not in text


def test_the_page_says_what_a_ratio_divides_by() -> None:
    """PPO rises to its last return within the first half of its samples."""
    early = cell("ppo", BASE)
    for member in early["members"]:
        curve, final = member["curve"], member["final_return"]
        curve["return_mean"] = [min(2 * y, final) for y in curve["return_mean"]]
    assert share_to_level(early) == pytest.approx(0.5)
    assert share_to_level(cell("ppo", BASE)) == pytest.approx(1.0)
    assert share_to_level(cell("ppo", BASE, failed=1)) is None
    text = arms("A-v5", study(early), summarize(study(early)))
    assert "`ppo` takes 0.50 of its own samples until its mean curve first reaches" in text


def test_an_end_that_is_not_one_half_does_not_look_like_it() -> None:
    assert [shown_chance(x) for x in (0.5, 0.4949, 0.4951, 0.50004)] == [
        "0.50",
        "0.49",
        "0.495",
        "0.50004",
    ]
    assert shown_improvement([0.1, 0.012, 0.4964]) == "0.10 [0.01, 0.496]"
    assert shown_improvement([0.6, None, None]) == "0.60"
    assert shown_improvement(None) == shown_improvement([None] * 3) == "-"


def test_the_seeds_are_counted_and_not_told() -> None:
    arms_of = [cell("ppo", BASE), cell("spo", BASE[:2], failed=1)]
    assert seeds_said(arms_of[:1]) == "5 seeds"
    assert seeds_said(arms_of) == "3 to 5 seeds"
    assert seeds_said([cell("ppo", BASE[:1])]) == "1 seed"
    assert seeds_said([]) == "no seeds"


def test_the_whole_page(monkeypatch: pytest.MonkeyPatch) -> None:
    results = study(cell("ppo", BASE), cell("gigaflow", BASE + 50), cell("gigaflow+random", BASE))
    found = {"selection-screen-cartpole": results, "selection-pilot-hopper": None}
    monkeypatch.setattr(selection_page, "load", found.get)
    text = selection_page.selection_page()
    assert text is not None
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings == [
        "## The screen: rule by task",
        "## How to read the tables",
        "## What the tests decide",
        "## Standing after the screen so far",
        "## Every arm, task by task",
    ]
    assert "5 seeds of each arm." in text and "A curve has 20 points" in text
    assert "The stage has 295 tests" in text  # 27 arms and 10 pairs on 8 tasks; one is ppo's
