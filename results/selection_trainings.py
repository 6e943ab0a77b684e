"""What a result file of the study `selection` says of an arm's trainings, and of two that are one.

A cell is an arm on a task as a result file stores it: a label and its members, one per seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from sauna.config.arms import SHARES, arm_settings
from sauna.config.presets import RANDOM_CONTROL
from sauna.experiments.study.verdicts import UNFILTERED
from sauna.system.errors import BadInput

Stored: TypeAlias = Mapping[str, Any]
LEAST = 1 - UNFILTERED  # share of its samples that a rule leaves out at least to be credited
SAME_NUMBERS = ("final_return", "auc", "env_steps")


def cells_of(results: Stored, task: str) -> dict[str, Stored]:
    """Returns the cells of a task by label, in the order of the study."""
    return {cell["label"]: cell for cell in results["cells"] if cell["task"] == task}


def tasks_of(results: Stored) -> list[str]:
    """Lists the tasks of a result file."""
    return list(dict.fromkeys(cell["task"] for cell in results["cells"]))


def is_control(label: str) -> bool:
    """Returns whether an arm is the matched random control of a rule."""
    return label.endswith(RANDOM_CONTROL)


def complete(cell: Stored) -> list[Stored]:
    """Lists the members that trained to the end."""
    return [member for member in cell["members"] if member["status"] == "complete"]


def failed(cell: Stored) -> int:
    """Counts the members that failed."""
    return sum(member["status"] == "failed" for member in cell["members"])


def outcomes(cell: Stored, name: str) -> np.ndarray:
    """Returns a number of each seed that has ended; a failed seed has the worst outcome, -inf."""
    known = np.array([member.get(name) for member in complete(cell)], float)
    return np.concatenate([known[np.isfinite(known)], np.full(failed(cell), -np.inf)])


def mean_of(cell: Stored, name: str) -> float | None:
    """Computes the mean of a number over the complete members; None if one does not have it."""
    values = [member.get(name) for member in complete(cell)]
    return None if not values or None in values else float(np.mean(values))


def share_of(cell: Stored, base: Stored, name: str) -> float | None:
    """Divides an arm's mean of a count by the baseline's; None where one is not known."""
    own, other = mean_of(cell, name), mean_of(base, name)
    return None if own is None or not other else own / other


def left_out(cell: Stored) -> float | None:
    """Computes the share of its samples that a rule left out.

    None for an arm that learns from all by its nature, and where it was not recorded.
    """
    kept = mean_of(cell, "keep_rate")
    if not leaves_out(cell["arm"]) or kept is None:
        return None
    if _settings(cell["arm"]).get("sampler", "none") == "none":
        return 1 - kept
    taken = mean_of(cell, "sample_rate")
    return None if taken is None else 1 - kept * taken


def leaves_out(arm: str) -> bool:
    """Returns whether an arm is meant to leave samples out; one that draws as many does not."""
    settings = _settings(arm)
    sampler = settings.get("sampler", "none")
    return settings.get("filter", "none") != "none" or (
        sampler != "none" and SHARES.get(sampler, 0.0) < 1
    )


def _settings(arm: str) -> Mapping[str, Any]:
    """Returns the settings of an arm; none if this version does not know it."""
    try:
        return arm_settings(arm)
    except BadInput:
        return {}


def is_idle(cell: Stored) -> bool:
    """Returns whether a rule left out so little that no difference can be credited to it."""
    share = left_out(cell)
    return share is not None and share < LEAST


def fingerprint(cell: Stored) -> tuple[Any, ...] | None:
    """Returns what two arms share if they are one and the same training, seed by seed.

    None if no seed is complete: failures are alike without being the same.
    """
    if not complete(cell):
        return None
    members = sorted(cell["members"], key=lambda member: member["seed"])
    return tuple((m["seed"], m["status"], *(m.get(n) for n in SAME_NUMBERS)) for m in members)


def twins(cells: Mapping[str, Stored]) -> dict[str, str]:
    """Finds arms whose seeds all have the numbers of an arm before them: `{arm: that arm}`."""
    first: dict[tuple[Any, ...], str] = {}
    found = {}
    for label, cell in cells.items():
        key = fingerprint(cell)
        if key is not None and first.setdefault(key, label) != label:
            found[label] = first[key]
    return found


def seeds_of_baseline(cell: Stored, base: Stored) -> int:
    """Counts the seeds on which an arm has the baseline's own numbers: its rule did nothing."""
    own, other = ({m["seed"]: _numbers(m) for m in complete(c)} for c in (cell, base))
    return sum(None not in own[seed] and own[seed] == other.get(seed) for seed in own)


def _numbers(member: Stored) -> tuple[Any, ...]:
    return tuple(member.get(name) for name in SAME_NUMBERS)


def seeds_said(cells: Sequence[Stored]) -> str:
    """Says how many seeds of each arm have ended: `5 seeds`, `3 to 5 seeds`."""
    numbers = sorted({len(complete(cell)) + failed(cell) for cell in cells} - {0})
    if not numbers:
        return "no seeds"
    number = f"{numbers[0]}" if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"
    return f"{number} seed{'s' * (number != '1')}"


def percent(share: float) -> str:
    """Writes a small share with two digits: `0.36%`."""
    return f"{100 * share:.2g}%" if share > 0 and math.isfinite(share) else "nothing"
