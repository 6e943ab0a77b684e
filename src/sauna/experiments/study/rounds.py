"""A sequential study: which seeds are trained next, read off the runs so far.

Nothing is stored beside the runs. A study that is run again finds the same looks and goes on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sauna.config.controls import rule_of
from sauna.experiments.sequential import Replay, replay
from sauna.experiments.study.spec import Arm, Spec
from sauna.experiments.study.units import Unit, parts, units_of
from sauna.system import run_directory


class Round(NamedTuple):
    """How far a sequential study has come.

    Attributes:
      units: every unit up to the look that each task waits for.
      waiting: the study that the next look needs, on the tasks where it is the earliest; None once
        everything is decided.
      look: the index of that look.
      replays: how far each task has come.
    """

    units: list[Unit]
    waiting: Spec | None
    look: int
    replays: dict[str, Replay]


def next_round(spec: Spec, size: int, folder: Path) -> Round:
    """Reads from the runs in `folder` what has been decided, and what has to be trained next.

    Args:
      spec: a study with looks.
      size: seeds per unit at most; a unit never reaches beyond a look.
      folder: where the units' folders are.
    """
    played = {task: _play(spec, task, size, folder) for task in spec.tasks}
    replays = {task: found for task, (_, found) in played.items()}
    looks = [found.look for found in replays.values() if found.look is not None]
    look = min(looks, default=len(spec.looks))
    waiting = None
    if looks:
        tasks = [task for task, found in replays.items() if found.look == look]
        waiting = _at_look(spec, look, {task: _needed(spec, task, replays[task]) for task in tasks})
    return Round([u for units, _ in played.values() for u in units], waiting, look, replays)


def first_look(spec: Spec) -> Spec:
    """Returns what is trained before the first look: all of a study without looks."""
    if not spec.looks:
        return spec
    labels = {arm.label for arm in spec.arms}
    return _at_look(spec, 0, dict.fromkeys(spec.tasks, labels))


def every_unit(spec: Spec, size: int) -> list[Unit]:
    """Returns all units that a study may come to train."""
    if not spec.looks:
        return units_of(spec, size)
    labels = {arm.label for arm in spec.arms}
    needed = dict.fromkeys(spec.tasks, labels)
    starts = [0, *(look.seeds for look in spec.looks[:-1])]
    return [
        unit
        for look, start in enumerate(starts)
        for unit in units_of(_at_look(spec, look, needed, start), size)
    ]


def round_units(found: Round) -> list[Unit]:
    """Returns the units that belong to what the next look needs, the trained ones included."""
    assert found.waiting is not None
    cells = {(arm.label, task) for arm in found.waiting.arms for task in arm.tasks}
    return [unit for unit in found.units if (unit.label, unit.task) in cells]


def controls_of(arms: Sequence[Arm]) -> dict[str, str]:
    """Returns the label of each arm's control, which has the arm's own settings."""
    found: dict[str, str] = {}
    for control in arms:
        for arm in arms:
            if rule_of(control.arm) == arm.arm and control.settings == arm.settings:
                found.setdefault(arm.label, control.label)
    return found


def tournament_of(spec: Spec) -> dict[str, Any]:
    """Returns what `results.json` holds of the design."""
    return {
        "looks": [look._asdict() for look in spec.looks],
        "controls": controls_of(spec.arms),
    }


def stopped(before: Mapping[str, Replay], after: Mapping[str, Replay]) -> Iterator[str]:
    """Says which arms the last look has stopped, and why."""
    for task, found in after.items():
        for label, standing in found.standings.items():
            old = before[task].standings.get(label)
            if standing.verdict != "open" and (old is None or old.verdict == "open"):
                yield f"{label} on {task}: {standing.reason}"


def _play(spec: Spec, task: str, size: int, folder: Path) -> tuple[list[Unit], Replay]:
    """Plays the looks of one task as far as their runs have ended, and lists the units until
    there."""
    here = [arm for arm in spec.arms if task in arm.tasks]
    arms, controls = [arm.label for arm in here], controls_of(here)
    scores: dict[str, list[float]] = {label: [] for label in arms}
    units: list[Unit] = []
    found = replay(_arrays(scores), spec.baseline, spec.looks, controls)
    while (look := found.look) is not None:
        start = spec.looks[look - 1].seeds if look else 0
        needed = {task: _needed(spec, task, found)}
        block = units_of(_at_look(spec, look, needed, start), size)
        units += block
        for unit in block:
            scores[unit.label] += _scores(unit, folder)
        found = replay(_arrays(scores), spec.baseline, spec.looks, controls)
        if found.look == look:
            break
    return units, found


def _needed(spec: Spec, task: str, found: Replay) -> set[str]:
    """Labels that the next look needs: the baseline, the arms still open, and their controls."""
    controls = controls_of([arm for arm in spec.arms if task in arm.tasks])
    return {
        spec.baseline,
        *found.running,
        *(controls[label] for label in found.running if label in controls),
    }


def _at_look(spec: Spec, look: int, needed: Mapping[str, set[str]], start: int = 0) -> Spec:
    """Cuts the study to the seeds from `start` up to a look, and to the labels of each task."""
    seeds = slice(start, spec.looks[look].seeds)
    arms = [
        arm._replace(
            seeds=arm.seeds[seeds],
            tasks=tuple(task for task in arm.tasks if arm.label in needed.get(task, ())),
        )
        for arm in spec.arms
    ]
    return spec._replace(arms=[arm for arm in arms if arm.tasks])


def _arrays(scores: Mapping[str, list[float]]) -> dict[str, np.ndarray]:
    """Scores up to the first seed that has not ended."""
    ended = {label: _until_unknown(values) for label, values in scores.items()}
    return {label: np.array(values) for label, values in ended.items()}


def _until_unknown(values: list[float]) -> list[float]:
    unknown = np.isnan(np.array(values))
    return values[: int(unknown.argmax())] if unknown.any() else values


def _scores(unit: Unit, folder: Path) -> list[float]:
    """Each seed's final return; -inf of a failed seed or one without a return, NaN if it has not
    ended."""
    found = []
    for part in parts(unit, folder):
        if part.is_complete(folder):
            last = {row["seed"]: row for row in run_directory.rows(part.run(folder))}
            found += [last.get(seed, {}).get("return_mean", -np.inf) for seed in part.seeds]
        else:
            failed = part.error(folder) is not None
            found += [-np.inf if failed else np.nan] * len(part.seeds)
    return found
