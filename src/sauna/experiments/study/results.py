"""What a study has found so far, gathered from the runs of its units: `results.json`."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.settings import flag, to_json
from sauna.experiments.compute import cumulated, learner_seconds, training_seconds
from sauna.experiments.curves import area_under_curve
from sauna.experiments.study.evaluations import evaluated
from sauna.experiments.study.rounds import tournament_of
from sauna.experiments.study.spec import Arm, Spec, check
from sauna.experiments.study.units import Unit, parts
from sauna.system import run_directory

FORMAT = 1
POINTS = 60  # of each member's curve that are kept
METRIC = "mean training return (sampled actions) of the last 100 episodes"
CURVES = (
    "return_mean",
    "keep_rate",
    "sample_rate",
    "vex_mean",
    "vex_spread",
    "vex_median",
    "explained_variance",
    "entropy",
)
DIGITS = 6  # significant digits of a curve's points


def gather(spec: Spec, units: list[Unit], folder: Path, command: str) -> dict[str, Any]:
    """Gathers everything that is known, one entry per trained member."""
    cells = [
        _cell(arm, task, [u for u in units if (u.label, u.task) == (arm.label, task)], folder)
        for task in spec.tasks
        for arm in spec.arms
        if task in arm.tasks
    ]
    top = {key: value for key, value in spec.text.items() if key != "arms"}
    return {
        "format": FORMAT,
        "name": spec.name,
        "command": command,
        "metric": METRIC,
        "baseline": spec.baseline,
        "settings": top,
        **_made_with(units, folder),
        **({"tournament": tournament_of(spec)} if spec.looks else {}),
        "cells": cells,
    }


def _made_with(units: list[Unit], folder: Path) -> dict[str, Any]:
    """Versions and machines of the runs; each difference is listed."""
    found: dict[str, list[Any]] = {"versions": [], "machine": [], "git": []}
    for unit in units:
        for part in parts(unit, folder):
            path = part.run(folder) / "config.json"
            stored = run_directory.read_config_file(path) if path.is_file() else {}
            for name, values in found.items():
                values += [stored[name]] if name in stored else []
    return {name: each_once(values) for name, values in found.items()}


def each_once(values: Iterable[Any]) -> Any:
    """Lists values that differ, each once; one alone stands without a list."""
    found: list[Any] = []
    for value in values:
        if value not in found:
            found.append(value)
    return found[0] if len(found) == 1 else found


def _cell(arm: Arm, task: str, units: list[Unit], folder: Path) -> dict[str, Any]:
    config = to_json(check(arm, task))
    members = [m for unit in units for m in _members(unit, folder, config["steps"])]
    return {
        "task": task,
        "label": arm.label,
        "arm": arm.arm,
        "baseline": arm.baseline,
        "preset": config["preset"],
        "config": config,
        "command": cell_command(arm, task),
        "git": _made_with(units, folder)["git"],
        "members": sorted(members, key=lambda member: arm.seeds.index(member["seed"])),
    }


def cell_command(arm: Arm, task: str) -> str:
    """Returns what a user types to train the members of one arm on one task.

    It names the preset and the steps, as `sauna train TASK` alone would pick those of the zoo.
    """
    config = check(arm, task)
    usual = {name: getattr(config, name) for name in ("preset", "steps")}
    missing = {name: value for name, value in usual.items() if name not in arm.settings}
    flags = {**missing, **arm.settings, "arm": arm.arm, "seeds": arm.seeds}
    text = " ".join(typed(key, value) for key, value in flags.items())
    return f"sauna train {shlex.quote(task)} {text}"


def typed(name: str, value: Any) -> str:
    """Returns a setting as it is typed; one seed ends in a comma, without which it would be a
    count."""
    if isinstance(value, bool):
        return flag(name) if value else flag("no_" + name)
    if isinstance(value, list | tuple):
        value = ",".join(map(str, value)) + "," * (name == "seeds" and len(value) == 1)
    text = json.dumps(value) if isinstance(value, dict) else str(value)
    return f"{flag(name)} {shlex.quote(text)}"


def _members(unit: Unit, folder: Path, budget: int) -> list[dict[str, Any]]:
    found = []
    for part in parts(unit, folder):
        rows: dict[int, list[dict[str, Any]]] = {seed: [] for seed in part.seeds}
        for row in run_directory.rows(part.run(folder)):
            rows[row["seed"]].append(row)
        timings = run_directory.rows(part.run(folder), "timing.jsonl")
        for seed in part.seeds:
            error, stopped = part.error(folder), _stopped_early(part.run(folder), seed)
            status = "running" if rows[seed] else "waiting"
            if part.is_complete(folder):
                status = "complete"
            elif error is not None:
                status = "failed"
            ended = _ended(rows[seed], budget, timings, stopped is not None)
            member = {"seed": seed, "status": status, "error": error, **ended}
            found.append(member | ({"stopped_early": stopped} if stopped else {}))
    return found


def _stopped_early(run: Path, seed: int) -> str | None:
    """Says what stopped a member before the end of its budget; None: nothing did."""
    path = run / "summary.json"
    if not path.is_file():
        return None
    members = run_directory.read_config_file(path).get("members", {}).values()
    return next((m.get("stopped_early") for m in members if m.get("seed") == seed), None)


def _ended(
    rows: list[dict[str, Any]],
    budget: int,
    timings: Sequence[dict[str, Any]] = (),
    stopped_early: bool = False,
) -> dict[str, Any]:
    """A member's last numbers and its thinned curve.

    The AUC is that of the first `budget` env steps, also if kept steps are counted and a member
    takes more env steps. A member that was stopped early keeps its last return up to there.
    """
    last, compute = rows[-1] if rows else {}, _compute(rows, timings)
    if stopped_early and last and last["env_steps"] < budget:
        rows = [*rows, {"env_steps": budget, "return_mean": last.get("return_mean")}]
        compute = {name: [*values, values[-1]] for name, values in compute.items()}
    steps = np.array([row["env_steps"] for row in rows], float)
    returns = np.array([row.get("return_mean") for row in rows], float)
    within = steps <= budget
    kept, tried = last.get("kept_steps"), last.get("env_steps")
    return {
        "final_return": last.get("return_mean"),
        "auc": area_under_curve(steps[within], returns[within]),
        "env_steps": tried,
        "kept_steps": kept,
        "keep_rate": kept / tried if kept is not None and tried else None,
        "sample_rate": _short(_mean([row["sample_rate"] for row in rows if "sample_rate" in row])),
        "gradient_steps": _sum(row["gradient_steps"] for row in rows if "gradient_steps" in row),
        "episodes": last.get("episodes"),
        "explained_variance": last.get("explained_variance"),
        **{name: _short(values[-1]) for name, values in compute.items()},
        **evaluated(rows, POINTS, DIGITS),
        "curve": _curve(rows, compute),
    }


def _sum(numbers: Iterable[float]) -> int | None:
    """Returns the sum of whole numbers; None of nothing."""
    known = list(numbers)
    return int(sum(known)) if known else None


def _compute(
    rows: list[dict[str, Any]], timings: Sequence[dict[str, Any]]
) -> dict[str, list[float | None]]:
    """What a member's learning has taken up to each row, for what was recorded."""
    if not rows:
        return {}
    member, iterations = rows[0].get("member", ""), [row.get("iteration", -1) for row in rows]
    learner, whole = learner_seconds(timings, member), training_seconds(timings, member)
    found = {
        "samples_backward": cumulated([row.get("samples_backward") for row in rows]),
        "learner_cpu_seconds": cumulated([*map(learner.get, iterations)]),
        "cpu_seconds": cumulated([*map(whole.get, iterations)]),
    }
    return {name: values for name, values in found.items() if values[0] is not None}


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.{DIGITS}g}")


def _curve(
    rows: list[dict[str, Any]], compute: Mapping[str, list[float | None]]
) -> dict[str, list[Any]]:
    chosen = np.unique(np.linspace(0, len(rows) - 1, POINTS).astype(int)).tolist()
    thinned = [rows[i] for i in chosen] if rows else []
    curve: dict[str, list[Any]] = {"env_steps": [row["env_steps"] for row in thinned]}
    moved = ("threshold",) if any("threshold" in row for row in thinned) else ()
    for name in (*CURVES, *moved):
        curve[name] = [_short(row.get(name)) for row in thinned]
    for name, values in compute.items():
        curve[name] = [_short(values[i]) for i in chosen]
    return curve
