"""What is known of a study before anything is trained, said while it can still be changed."""

from __future__ import annotations

import numpy as np

from sauna.config.checks import budget_note, cautions
from sauna.config.parsing import many_seeds
from sauna.config.presets import chosen_preset
from sauna.config.settings import Config, flag, to_json
from sauna.config.zoo import entry_for, entry_of
from sauna.experiments.statistics import compare
from sauna.experiments.study.cells import Cell
from sauna.experiments.study.spec import Arm, Spec, check
from sauna.experiments.study.verdicts import families_of, least_of


def before_training(spec: Spec, seeds: str = "seeds") -> list[str]:
    """Says which presets are picked, and if seeds are too few for any difference, or very many.

    Args:
      seeds: the option that says how many seeds there are.
    """
    notes = [note for arm in spec.arms if (note := many_seeds(arm.seeds))]
    notes += [note for arm in spec.arms for note in _picked(arm)]
    notes += [note for arm in spec.arms for task in arm.tasks for note in _of_config(arm, task)]
    for task in spec.tasks:
        notes += _too_few(task, {arm.label: arm for arm in spec.arms if task in arm.tasks}, seeds)
    return list(dict.fromkeys(notes))


def _of_config(arm: Arm, task: str) -> list[str]:
    """Says which preset stands where none is named, and how far a small budget reaches."""
    config = check(arm, task)
    notes = [budget_note(config), *(text for text in cautions(config) if text.startswith("note:"))]
    if "preset" not in arm.settings:
        notes.append(_unnamed(chosen_preset(arm.settings), config, task, "steps" in arm.settings))
    return [note for note in notes if note]


def _unnamed(preset: str, config: Config, task: str, has_steps: bool) -> str:
    """Says which preset and how many env steps are taken, and which the zoo has for the task."""
    entry = entry_of(task)
    taken = f"note: no preset is named: {preset} is taken"
    taken += "" if has_steps else f", with {config.steps:,} env steps"
    if entry is None or config.algorithm != Config.algorithm:
        return taken
    if entry.preset == preset and (has_steps or entry.steps == config.steps):
        return f"{taken}, as for {task} in the zoo"
    steps = "" if has_steps else f", with {entry.steps:,} env steps"
    return f"{taken}; preset auto is {entry.preset} for {task}{steps}"


def _picked(arm: Arm) -> list[str]:
    """Says which presets `auto` stands for in an arm."""
    picked = {task: entry_for({**arm.settings, "env": task}) for task in arm.tasks}
    named = "steps" in arm.settings
    return [entry.said(task, named) for task, entry in picked.items() if entry]


def _too_few(task: str, arms: dict[str, Arm], seeds: str) -> list[str]:
    """Tries the tests with every score of an arm above every score of its baseline."""
    cells = [_cell(arm, task) for arm in arms.values()]
    short: dict[str, list[str]] = {}
    for family in families_of(cells):
        baseline = str(family[0].baseline)
        low = np.arange(len(arms[baseline].seeds), dtype=float)
        above = {c.label: low[-1] + 1.0 + np.arange(len(arms[c.label].seeds)) for c in family}
        found = compare({label: (scores, low) for label, scores in above.items()})
        few = [label for label, result in found.items() if result.kind == "underpowered"]
        short[baseline] = short.get(baseline, []) + few
    return [
        f"note: too few seeds: so few cannot show a difference between {baseline} and "
        f"{', '.join(labels)} on {task}, whatever they are; give at least "
        f"{flag(seeds)} {least_of(cells)}"
        for baseline, labels in short.items()
        if labels
    ]


def _cell(arm: Arm, task: str) -> Cell:
    """An arm of which nothing is trained yet."""
    config = to_json(check(arm, task))
    return Cell(task, arm.label, arm.arm, arm.baseline, [], 0, 0, 0, None, config)
