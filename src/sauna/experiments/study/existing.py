"""`sauna compare RUN RUN...`: compares runs that exist, also those of other trainers."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.presets import COMPARED
from sauna.experiments.curves import area_under_curve
from sauna.experiments.report.sources import Curve, Source, read_sources
from sauna.experiments.report.style import short
from sauna.experiments.study.command import lines
from sauna.experiments.study.evaluations import evaluated
from sauna.experiments.study.report import write_report
from sauna.experiments.study.results import DIGITS, FORMAT, POINTS
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.units import digest_of
from sauna.system import run_directory
from sauna.system.errors import BadInput

# Values of what `sauna compare` takes for trainings, where it is not given.
UNREAD: dict[str, Any] = {
    "arms": ",".join(COMPARED),
    "processes": "0",
    "on": "local",
    "address": "",
    "rules": "",
    "controls": True,
    "accept_changed_code": False,
}
LAST = 0.1  # share of the compared env steps whose mean return is the final return


def compare_existing(
    paths: Sequence[Path], tag: str = "", *, out: str = "runs", **others: Any
) -> list[str]:
    """Compares the arms of runs that exist; the first is the baseline. Nothing is trained.

    Only env steps that every seed of every arm reaches are compared, and one definition of the
    final return holds for all: the mean over the last tenth of them.

    Args:
      paths, tag: see `read_sources`.
      out: where the folder of the results and the report is made.
      **others: settings of trainings, which are refused.

    Returns:
      what was found, as lines of text.

    Raises:
      BadInput: a path cannot be read, there is one arm only, or the curves do not overlap.
    """
    for name, value in others.items():
        if value != UNREAD.get(name, False):
            raise BadInput(f"{name}: not read for runs that exist")
    sources = read_sources(paths, tag)
    if len(sources) < 2:
        raise BadInput("give two runs or more, or a run of several arms")
    command = f"sauna compare {shlex.join(map(str, paths))}"
    command += f" --tag {shlex.quote(tag)}" if tag else ""
    command += f" --out {shlex.quote(out)}" if out != "runs" else ""
    results = results_of(sources, command)
    summary = summarize(results)
    place = Path(out) / f"compare_{digest_of([str(path.resolve()) for path in paths])}"
    place.mkdir(parents=True, exist_ok=True)
    run_directory.write_json(place / "results.json", results)
    run_directory.write_json(place / "summary.json", summary)
    report = write_report(results, summary, place)
    about = (
        f"final return here: {final_of(sources)}; `sauna compare ENV` takes the last 100 episodes"
    )
    return [ends_of(sources), about, "", *lines(summary), "", f"report: {report}"]


def final_of(sources: Sequence[Source]) -> str:
    """Says what the final return of runs that exist is."""
    end = min(curve.x[-1] for source in sources for curve in source.seeds.values())
    return f"mean of the returns from {short((1 - LAST) * end)} to {short(end)} env steps"


def ends_of(sources: Sequence[Source]) -> str:
    """Writes where each arm ends: what lies behind the first end is not compared."""
    ends = {s.label: min(curve.x[-1] for curve in s.seeds.values()) for s in sources}
    listed = ", ".join(f"{label} at {short(end)}" for label, end in ends.items())
    return f"compared up to {short(min(ends.values()))} env steps; the arms end: {listed}"


def results_of(sources: Sequence[Source], command: str) -> dict[str, Any]:
    """Returns the curves as `results.json` has them, cut where the first of them ends.

    Raises:
      BadInput: the runs are of several tasks, or no env step is on all curves.
    """
    tasks = list(dict.fromkeys(source.task for source in sources if source.task))
    if len(tasks) > 1:
        raise BadInput(f"runs of different tasks cannot be compared: {', '.join(tasks)}")
    task = tasks[0] if tasks else "the task"
    curves = [curve for source in sources for curve in source.seeds.values()]
    start, end = max(c.x[0] for c in curves), min(c.x[-1] for c in curves)
    if start >= end:
        raise BadInput("the curves have no env steps in common, so nothing can be compared")
    metric = f"{final_of(sources)}, which every seed reaches ({ends_of(sources)})"
    return {
        "format": FORMAT,
        "name": "runs that exist",
        "command": command,
        "metric": metric,
        "curve": "Returns as the files hold them.",
        "baseline": sources[0].label,
        "settings": {"compared up to env steps": end},
        "versions": {},
        "machine": {},
        "git": None,
        "cells": [_cell(source, task, end) for source in sources],
    }


def _cell(source: Source, task: str, end: float) -> dict[str, Any]:
    return {
        "task": task,
        "label": source.label,
        "arm": source.arm or source.label,
        "preset": "",
        "config": source.config or {"algorithm": "of another trainer"},
        "command": f"# read from {source.path}",
        "members": [_member(seed, curve, end) for seed, curve in source.seeds.items()],
    }


def _member(seed: int, curve: Curve, end: float) -> dict[str, Any]:
    """A seed's numbers over the env steps up to `end`; between two points a curve is linear."""
    within = curve.x < end
    x = np.append(curve.x[within], end)
    y = np.append(curve.y[within], np.interp(end, curve.x, curve.y))
    last = x >= (1 - LAST) * end
    chosen = np.unique(np.linspace(0, len(x) - 1, POINTS).astype(int))
    return {
        "seed": seed,
        "status": "complete",
        "error": None,
        "final_return": float(y[last].mean()),
        "auc": area_under_curve(x, y),
        "env_steps": end,
        "kept_steps": None,
        "keep_rate": curve.keep_rate,
        "episodes": None,
        "explained_variance": None,
        **evaluated([r for r in curve.evaluations if r["env_steps"] <= end], POINTS, DIGITS),
        "curve": {
            "env_steps": [float(step) for step in x[chosen]],
            "return_mean": [float(f"{value:.{DIGITS}g}") for value in y[chosen]],
        },
    }
