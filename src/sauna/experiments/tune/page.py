"""The page of a tuning: `report.html`, one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.experiments.report.numbers import digits_of, number
from sauna.experiments.report.page import render
from sauna.experiments.report.style import short
from sauna.experiments.tune import figures, tables
from sauna.system.safe_write import replace_file
from sauna.training.display import counted


def write_page(found: Mapping[str, Any], path: Path) -> None:
    """Writes the page of what `results.json` holds; the same bytes for the same input."""
    replace_file(path, make_page(found).encode())


def make_page(found: Mapping[str, Any]) -> str:
    """Renders the page as text."""
    env, population = found["env"], bool(found["tune"]["exchange_every"])
    drawn = {
        name: draw(found)
        for name, draw in (
            ("Curves", figures.curves),
            ("Settings and returns", figures.coordinates),
            ("Importance", figures.importance),
        )
    }
    return render(
        "tune",
        title=f"Which settings are best for {env}?",
        answer=answer(found),
        scope=scope(found),
        captions={
            "Curves": (
                f"{found['metric'].capitalize()}. The best trial is drawn in orange; one that was "
                f"pruned is grey and ends in a cross."
            ),
            "Settings and returns": (
                "Each line is a trial, from the values of its settings to its return. The brighter "
                "it is, the higher is the return. Pruned trials are there with their last score."
            ),
            "Importance": (
                "How much each setting sets the best trials apart from the others, by PED-ANOVA "
                "(Watanabe et al. 2023) over the complete trials. They sum to 1. Few trials give "
                "rough numbers."
            ),
        },
        figures={name: svg for name, svg in drawn.items() if svg is not None},
        finalists=tables.seeds_rows(found, "finalists"),
        finalists_report=found["finalists"].get("report", ""),
        fresh=tables.seeds_rows(found, "fresh"),
        fresh_report=found["fresh"].get("report", ""),
        verdicts=[v["text"] for v in found["fresh"].get("verdicts", [])],
        trials=tables.trial_rows(found),
        exchanges=tables.exchange_rows(found),
        population=population,
        command=found["command"],
    )


def answer(found: Mapping[str, Any]) -> str:
    """Says what came of the tuning in one or two sentences."""
    best = found["best"]
    if best is None:
        return "No trial has ended well so far."
    kind = "member" if found["tune"]["exchange_every"] else "trial"
    score = number(best["return"], digits_of([best["return"]]))
    return f"Best is {kind} {best['number']}, with a return of {score}. On fresh seeds: " + (
        f"{found['verdict']['text']}."
    )


def scope(found: Mapping[str, Any]) -> list[str]:
    """Says how much was tried."""
    states = [trial["state"] for trial in found["trials"]]
    kinds = [f"{states.count(state)} {state}" for state in dict.fromkeys(states)]
    steps = found["env_steps"]
    return [
        counted(len(states), "member" if found["tune"]["exchange_every"] else "trial"),
        *kinds,
        f"{short(found['steps'])} env steps each at most",
        f"{steps['trials']:,} env steps of trials",
        f"{steps['fresh']:,} on further seeds",
    ]
