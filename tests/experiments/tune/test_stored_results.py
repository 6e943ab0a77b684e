"""`results/tune.json` keeps what runs/ no longer holds, and its text says who lost."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import tune as results
from tune_page import tune_text

AFTER = 2_000_000_000  # a time


def write(runs: Path, name: str, returns: list[float | None], exchange_every: int = 0) -> Path:
    """What a population, or a search at equal steps, leaves behind."""
    path = runs / f"tune_{name}" / "results.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {
        "command": f"sauna tune {name}",
        "tune": {"values": {}, "exchange_every": exchange_every, "seeds": [0]},
        "trials": [{"return": value} for value in returns],
        "env_steps": {"trials": 80},
        "exchanges": [{}, {}] if exchange_every else [],
    }
    path.write_text(json.dumps(found))
    return path


def test_what_is_stored_stays_unless_runs_holds_something_newer(tmp_path: Path) -> None:
    members = results.MEMBERS
    write(tmp_path, "a", [1.0] * members, exchange_every=4)
    search = {"trials": [], "steps": 7}
    stored = {
        "commands": {
            "LunarLander-v3": "as it was then",
            "Pendulum-v1": "not stored any more",
            "random 2": "typed",
        },
        "searches": {"LunarLander-v3": search},
        "equal_steps": {"random": {"2": {"returns": [5.0]}}},
    }
    first = results.collect(stored, tmp_path)
    assert first["searches"] == {"LunarLander-v3": search}
    assert first["equal_steps"]["random"] == {"2": {"returns": [5.0]}}
    assert first["equal_steps"]["population"]["0"]["returns"] == [1.0] * members
    assert first["commands"]["LunarLander-v3"] == "as it was then"
    assert first["commands"]["Pendulum-v1"] == results.commands()["Pendulum-v1"]
    assert first["commands"]["population 0"] == "sauna tune a"
    empty = tmp_path / "empty"
    assert results.collect(first, empty) == first
    newer = write(tmp_path, "b", [2.0] * members, exchange_every=4)
    os.utime(newer, (AFTER, AFTER))
    again = results.collect(first, tmp_path)
    assert again["equal_steps"]["population"]["0"]["returns"] == [2.0] * members
    os.utime(newer, (0, 0))
    assert results.collect(first, tmp_path) == first
    assert results.collect(again, tmp_path) == again


def test_a_tuning_that_has_not_ended_replaces_nothing(tmp_path: Path) -> None:
    for name, returns in (("few", [1.0] * 3), ("open", [None] * results.MEMBERS)):
        write(tmp_path, name, returns)
    assert results.collect({}, tmp_path)["equal_steps"] == {"population": {}, "random": {}}


def test_the_text_counts_what_the_population_lost(tmp_path: Path) -> None:
    runs = {"population": [[-5, -6], [-3, -9]], "random": [[-4, -8], [-2, -2]]}
    equal = {
        kind: {
            str(seed): {"returns": own, "env_steps": 80, "exchanges": 2}
            for seed, own in enumerate(returns)
        }
        for kind, returns in runs.items()
    }
    text = tune_text({"commands": {}, "searches": {}, "equal_steps": equal})
    assert text.endswith(
        "The population lost on the best return of its eight in 2 of 2, and the mean return of its "
        "eight in 1 of 2 repetitions."
    )
