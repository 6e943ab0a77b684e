"""The page of a tuning and its tables, from results that are written here."""

from __future__ import annotations

from typing import Any

from sauna.experiments.tune.page import make_page
from sauna.experiments.tune.tables import exchange_rows, seeds_rows, trial_rows


def trial(number: int, state: str, value: float | None, **more: Any) -> dict[str, Any]:
    curve = [] if value is None else [[0.5, value - 1], [1.0, value]]
    searched = {"gamma": 0.9 + number / 100, "hidden": "64,64"}
    common = {"number": number, "state": state, "return": value, "env_steps": 1000}
    return {**common, "searched": searched, "settings": searched, "curve": curve, **more}


def found(**changes: Any) -> dict[str, Any]:
    trials = [
        trial(0, "complete", -3.0),
        trial(1, "pruned", -9.0),
        trial(2, "complete", -1.0),
        trial(3, "fail", None, error="trial-3/0: <b>not finite</b>"),
    ]
    row = {"failed": 0, "seeds": 5, "final_std": 0.5, "env_steps": 1000.0}
    return {
        "env": "Task-v0",
        "steps": 1000,
        "metric": "mean training return",
        "command": "sauna tune Task-v0",
        "tune": {
            "values": {"gamma": {"low": 0.8, "high": 1.0}, "hidden": [[64, 64], [8]]},
            "exchange_every": 0,
        },
        "env_steps": {"trials": 4000, "fresh": 10000},
        "trials": trials,
        "best": trials[2],
        "importance": {"gamma": 0.75, "hidden": 0.25},
        "exchanges": [],
        "finalists": {},
        "fresh": {
            "report": "fresh_0/report.html",
            "table": [
                {"label": "preset task", "final_mean": -2.0, **row},
                {"label": "tuned", "final_mean": -1.5, **row},
            ],
            "verdicts": [{"text": "No difference is decided."}],
        },
        "verdict": {"believed": True, "text": "mean final return on fresh seeds: -1.5"},
        **changes,
    }


def test_the_page_says_what_was_found_and_on_what_evidence() -> None:
    page = make_page(found())
    assert "Which settings are best for Task-v0?" in page
    assert "Best is trial 2, with a return of -1.00." in page
    assert "4 trials" in page and "1 pruned" in page and "1 fail" in page
    for title in ("Curves", "Settings and returns", "Importance", "Fresh seeds", "Trials"):
        assert f"<h2>{title}</h2>" in page
    assert page.count("data:image/svg+xml") == 3
    assert "&lt;b&gt;not finite&lt;/b&gt;" in page and "<b>not finite" not in page
    assert "No difference is decided." in page and 'href="fresh_0/report.html"' in page


def test_a_page_of_nothing_and_of_no_fresh_seeds_says_so() -> None:
    nothing = {"trials": [], "best": None, "importance": {}, "fresh": {}}
    page = make_page(found(**nothing, verdict={"believed": None, "text": "not tried"}))
    assert "No trial has ended well so far." in page
    assert "Nothing was trained on fresh seeds." in page and "data:image/svg" not in page


def test_trials_are_listed_best_first_and_failed_ones_with_their_reason() -> None:
    head, *rows = trial_rows(found())
    assert head == ["trial", "state", "return", "env steps", "gamma", "hidden"]
    assert [row[0] for row in rows] == ["2", "0", "1", "3"]
    assert rows[0] == ["2", "complete", "-1.00", "1,000", "0.92", "64,64"]
    assert rows[3][1] == "failed: trial-3/0: <b>not finite</b>" and rows[3][2] == "-"


def test_fresh_seeds_and_exchanges_as_tables() -> None:
    assert seeds_rows(found(), "fresh")[1:] == [
        ["preset task", "5", "-2.00 +- 0.50", "1000"],
        ["tuned", "5", "-1.50 +- 0.50", "1000"],
    ]
    one = {"iteration": 2, "env_steps": 400, "member": 1, "source": 0}
    one |= {"score": -3.0, "source_score": -1.0}
    one |= {"copied": {"gamma": 0.9, "hidden": "8"}, "settings": {"gamma": 0.95, "hidden": "8"}}
    rows = exchange_rows(found(exchanges=[one]))
    assert rows[1] == ["400", "1", "-3.00", "0", "-1.00", "0.9 -> 0.95", "8 -> 8"]
    nothing = {"trials": [], "best": None, "importance": {}, "fresh": {}}  # which draws nothing
    assert "<h2>Exchanges</h2>" in make_page(found(**nothing, exchanges=[one]))
