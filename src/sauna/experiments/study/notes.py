"""What is known of a study before anything is trained, said while it can still be changed."""

from __future__ import annotations

import numpy as np

from sauna.config.parsing import many_seeds
from sauna.config.zoo import entry_for
from sauna.experiments.statistics import compare
from sauna.experiments.study.spec import Arm, Spec


def before_training(spec: Spec) -> list[str]:
    """Says which presets are picked, and if there are too few seeds, or surprisingly many."""
    notes = [note for arm in spec.arms if (note := many_seeds(arm.seeds))]
    notes += [note for arm in spec.arms for note in _picked(arm)]
    for task in spec.tasks:
        arms = {arm.label: arm for arm in spec.arms if task in arm.tasks}
        for baseline in dict.fromkeys(arm.baseline for arm in arms.values() if arm.baseline):
            family = [arm for arm in arms.values() if arm.baseline == baseline]
            notes += _underpowered(task, arms[baseline], family)
    return list(dict.fromkeys(notes))


def _picked(arm: Arm) -> list[str]:
    """Says which presets `auto` stands for in an arm."""
    picked = {task: entry_for({**arm.settings, "env": task}) for task in arm.tasks}
    named = "steps" in arm.settings
    return [entry.said(task, named) for task, entry in picked.items() if entry]


def _underpowered(task: str, baseline: Arm, family: list[Arm]) -> list[str]:
    """Tries the test with every score of an arm above every score of its baseline."""
    low = np.arange(len(baseline.seeds), dtype=float)
    found = compare({arm.label: (low[-1] + 1.0 + np.arange(len(arm.seeds)), low) for arm in family})
    short = {label: result for label, result in found.items() if result.kind == "underpowered"}
    if not short:
        return []
    needed = max(result.least for result in short.values())
    return [
        f"note: underpowered: so few seeds cannot show a difference between {baseline.label} and "
        f"{', '.join(short)} on {task}, whatever they are; give at least --seeds {needed}"
    ]
