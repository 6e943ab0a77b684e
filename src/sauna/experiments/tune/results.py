"""What a tuning has found: `results.json`, `trials.txt`, `tuned.json` and the page."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from sauna.config.trust import named_code, seal
from sauna.experiments.report.numbers import aligned, digits_of, number
from sauna.experiments.tune import fresh
from sauna.experiments.tune.page import write_page
from sauna.experiments.tune.plan import Plan
from sauna.experiments.tune.population import FOLDER as POPULATION
from sauna.experiments.tune.population import exchanges_in
from sauna.experiments.tune.search import BATCHES, steps_below
from sauna.experiments.tune.tables import seeds_rows, trial_rows
from sauna.system import run_directory
from sauna.system.safe_write import replace_file

FORMAT = 1
RESULTS, TABLE, TUNED, PAGE = "results.json", "trials.txt", "tuned.json", "report.html"
METRIC = "mean training return (sampled actions) of the last 100 episodes, at the end of a trial"
EVALUATED = "mean return of a trial's last evaluation"


class Searching(Protocol):
    """What has trials: a search, or a population."""

    def ended(self) -> list[dict[str, Any]]:
        """Lists them as JSON values."""

    def importance(self) -> dict[str, float]:
        """Shares of the searched settings; nothing if that is not known."""


def gather(plan: Plan, search: Searching, folder: Path, command: str) -> dict[str, Any]:
    """Gathers everything that is known, as JSON values."""
    trials = search.ended()
    best, finalists = fresh.best_of(plan, trials, folder)
    found = fresh.read_fresh(plan, best["settings"], folder) if best and plan.fresh else {}
    steps = {
        "trials": steps_below(folder / BATCHES) + steps_below(folder / POPULATION),
        "fresh": steps_below(folder / "units"),
    }
    return {
        "format": FORMAT,
        "command": command,
        "env": plan.env,
        "steps": plan.steps,
        "tune": plan.identity(),
        "metric": EVALUATED if plan.settings.get("eval_every") else METRIC,
        "versions": run_directory.versions(),
        "env_steps": steps,
        "trials": trials,
        "importance": search.importance(),
        "exchanges": exchanges_in(folder),
        "best": None if best is None else dict(best),
        "finalist_seeds": plan.finalist_seeds,
        "finalists": finalists,
        "fresh_seeds": plan.fresh_seeds,
        "fresh": found,
        "verdict": fresh.verdict(found),
    }


def write(plan: Plan, search: Searching, folder: Path, command: str) -> dict[str, Any]:
    """Writes what there is; returns what `results.json` holds."""
    found = gather(plan, search, folder, command)
    run_directory.write_json(folder / RESULTS, found)
    write_page(found, folder / PAGE)
    text = "\n".join([*aligned(trial_rows(found)), "", *_ends(found)]) + "\n"
    replace_file(folder / TABLE, text.encode())
    if found["best"] is not None:
        settings = fresh.tuned_settings(plan, found["best"]["settings"])
        sealed = {"seal": seal(settings)} if named_code(settings) else {}
        run_directory.write_json(folder / TUNED, {**settings, **sealed})
    return found


def _ends(found: Mapping[str, Any]) -> list[str]:
    counts: dict[str, int] = {}
    for trial in found["trials"]:
        counts[trial["state"]] = counts.get(trial["state"], 0) + 1
    ended = ", ".join(f"{count} {state}" for state, count in counts.items())
    steps = found["env_steps"]
    return [
        f"return: {found['metric']}",
        f"trials: {ended or 'none'}; env steps: {steps['trials']:,} of trials, "
        f"{steps['fresh']:,} on further seeds",
        f"command: {found['command']}",
    ]


def lines(found: Mapping[str, Any], folder: Path) -> list[str]:
    """Writes what was found as lines of text: the table, the fresh seeds, what to do next."""
    text = [*aligned(trial_rows(found)), "", *_ends(found)[:2]]
    for name in ("finalists", "fresh"):
        if rows := seeds_rows(found, name):
            text += ["", *aligned(rows)]
    text.append("")
    if (best := found["best"]) is not None:
        digits = digits_of([best["return"]])
        text.append(f"best: trial {best['number']}, return {number(best['return'], digits)}")
        text.append(f"fresh seeds: {found['verdict']['text']}")
        path = shlex.quote(str(folder / TUNED))
        believed = found["verdict"]["believed"]
        with_what = "what was found" if believed else "what was found all the same"
        text.append(f"train with {with_what}: sauna train --config {path} --seeds 5")
    return text
