"""What `results/tune.json` says, for `docs/how-to/tune.md`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

COMMAND = "`python results/tune.py` (numbers and the table of all trials: `results/tune.json`)."


def tune_text(found: Mapping[str, Any]) -> str:
    """Searches on fresh seeds, and populations beside random searches."""
    parts = [COMMAND]
    for name, search in found["searches"].items():
        parts += [_search(name, search, found["commands"][name]), _fresh(search)]
    if any(found["equal_steps"].values()):
        parts += [_equal(found["equal_steps"])]
    return "\n\n".join(parts)


def _search(name: str, search: Mapping[str, Any], command: str) -> str:
    states = Counter(trial["state"] for trial in search["trials"])
    ended = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
    best = next(t for t in search["trials"] if t["number"] == search["best"])
    start = search["trials"][0]
    steps = search["env_steps"]
    parts = [
        f"**{name}**, {search['steps']:,} env steps: `{command}`.",
        f"Of {len(search['trials'])} trials: {ended};",
        f"{steps['trials']:,} env steps of trials, {steps['fresh']:,} on further seeds.",
        f"The first trial, from the poor start, returned {start['return']:.0f};",
        f"trial {best['number']}, which the finalists' seeds chose, {best['return']:.0f}.",
        f"{search['verdict']['text'].capitalize()}.",
    ]
    return " ".join(parts)


def _fresh(search: Mapping[str, Any]) -> str:
    rows = ["| On the fresh seeds | seeds | env steps | final return, mean ± std |"]
    rows.append("|---|---|---|---|")
    for row in search["fresh"]:
        value = f"{row['final_mean']:.0f} ± {row['final_std']:.0f}"
        rows.append(f"| {row['label']} | {row['seeds']} | {row['env_steps']:,.0f} | {value} |")
    for row in search["highest_score_on_fresh_seeds"]:
        value = f"{row['final_mean']:.0f} ± {row['final_std']:.0f}"
        label = "the trial of the highest score, which the finalists' seeds did not choose"
        rows.append(f"| {label} | {row['seeds']} | {row['env_steps']:,.0f} | {value} |")
    return "\n".join(rows) + "\n\n" + "\n".join(f"- {text}" for text in search["verdicts"])


def _equal(runs: Mapping[str, Mapping[str, Any]]) -> str:
    seeds = sorted(set(runs["population"]) & set(runs["random"]))
    steps = {run["env_steps"] for kind in runs.values() for run in kind.values()}
    exchanges = [runs["population"][seed]["exchanges"] for seed in seeds]
    head = (
        f"**Population-based training against random search at equal steps**, Pendulum-v1, "
        f"{_spread(sorted(steps))} env steps each, eight members or trials; {len(seeds)} "
        f"repetitions with different seeds ({_spread(exchanges)} exchanges):"
    )
    rows = ["| | best return of the eight | mean return of the eight |", "|---|---|---|"]
    for kind, words in (("population", "population"), ("random", "random search")):
        returns = [runs[kind][seed]["returns"] for seed in seeds]
        best = ", ".join(f"{max(own):.0f}" for own in returns)
        mean = ", ".join(f"{np.mean(own):.0f}" for own in returns)
        rows.append(f"| {words} | {best} | {mean} |")
    said = ", and ".join(
        f"the {name} return of its eight in {_compared(runs, seeds, of)}"
        for name, of in (("best", max), ("mean", np.mean))
    )
    return f"{head}\n\n" + "\n".join(rows) + f"\n\nThe population lost on {said} repetitions."


def _compared(runs: Mapping[str, Mapping[str, Any]], seeds: Sequence[str], of: Any) -> str:
    """In how many repetitions the population's return is the lower one, as `3 of 3`."""
    pairs = [
        [of(runs[kind][seed]["returns"]) for kind in ("population", "random")] for seed in seeds
    ]
    return f"{sum(population < random for population, random in pairs)} of {len(pairs)}"


def _spread(values: Sequence[int]) -> str:
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"
