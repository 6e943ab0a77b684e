"""`results/selection_page.py`: the words of the table rule x task."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import selection_page
from selection_page import arms, difference_interval, word_of, words_of

from sauna.experiments.study.summary import summarize

BASE = np.array([100.0, 101.0, 99.0, 100.5, 99.5])


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


def cell(label: str, returns: np.ndarray, samples: float) -> dict[str, Any]:
    """Curves that rise linearly from 0 to each seed's final return."""
    share = np.linspace(0, 1, 11)
    members = [
        {
            "seed": seed,
            "status": "complete",
            "final_return": final,
            "auc": final / 2,
            "keep_rate": 1.0,
            "env_steps": 1000,
            "kept_steps": 1000,
            "samples_backward": samples,
            "curve": {
                "env_steps": (1000 * share).tolist(),
                "return_mean": (final * share).tolist(),
                "samples_backward": (samples * share).tolist(),
            },
        }
        for seed, final in enumerate(returns.tolist())
    ]
    baseline = None if label == "ppo" else "ppo"
    return {
        "task": "A-v5",
        "label": label,
        "arm": label,
        "baseline": baseline,
        "members": members,
    }


def test_a_cell_says_the_word_the_probability_and_the_share_of_compute() -> None:
    cells = [
        cell("ppo", BASE, 1000.0),
        cell("half", BASE + 50, 500.0),
        cell("low", BASE - 50, 500.0),
    ]
    results = {"format": 1, "baseline": "ppo", "cells": cells, "settings": {}}
    summary = summarize(results)
    words = words_of(results, summary)
    assert set(words) == {("half", "A-v5"), ("low", "A-v5")}
    # 100 of 150 is reached after two thirds of 500 samples, a third of the 1000 of `ppo`.
    half, low = words["half", "A-v5"], words["low", "A-v5"]
    assert half.shown.startswith('<span class="better">better</span> 1.00<br>x 0.33 [')
    assert low.shown.startswith('<span class="worse">worse</span> 0.00<br>not reached')
    assert "| `half` | 5 | 0 | 150.0 ± 0.8 |" in arms("A-v5", summary)
    assert "0.50 of PPO's" in arms("A-v5", summary)


def test_the_answer_counts_tasks_and_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection_page, "load", lambda name: None)
    assert selection_page.screen_answer() is None

    def on(task: str, *cells: dict[str, Any]) -> dict[str, Any]:
        of_task = [{**own, "task": task} for own in cells]
        return {"format": 1, "baseline": "ppo", "cells": of_task, "settings": {}}

    ppo, high = cell("ppo", BASE, 1000.0), cell("high", BASE + 50, 1000.0)
    low, control = cell("low", BASE - 50, 1000.0), cell("low+random", BASE + 50, 1000.0)
    found = {
        "selection-screen-cartpole": on("CartPole-v1", ppo, high, low, control),
        "selection-screen-mujoco": on("Hopper-v5", ppo, high),
    }
    monkeypatch.setattr(selection_page, "load", found.get)
    answer = selection_page.screen_answer()
    assert answer is not None
    assert "on 1 of 8 tasks and a part of 1 more. By the intervals" in answer
    assert "better on a task: `high`, and 1 of 2 scored worse on a task" in answer
