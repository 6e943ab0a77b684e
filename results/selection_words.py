"""What the table rule x task says of an arm: better, worse, same, not decided, and its compute."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from selection_trainings import (
    cells_of,
    complete,
    failed,
    is_idle,
    left_out,
    outcomes,
    percent,
    seeds_of_baseline,
    tasks_of,
    twins,
)

from sauna.experiments.statistics import QUANTILES

SAME = 0.1  # of the baseline's mean: differences up to this count as none
COMPUTE = "samples_backward"
ROUNDING = 1e-6  # of a ratio or a probability, by the order of additions


class Cell(NamedTuple):
    """A rule on a task: the word at equal env steps, and all that the table shows."""

    word: str
    compute: str  # the word at equal compute
    shown: str
    idle: bool = False  # it left out so little that its choice gets no credit


def words_of(results: Mapping[str, Any], summary: Mapping[str, Any]) -> dict[tuple[str, str], Cell]:
    """Says for each arm and task whether it beats the baseline, at equal steps and compute.

    Arms of which no seed has ended are left out; one whose seeds all failed is not.
    """
    base = results["baseline"]
    ratios = {(v["label"], v["task"]): v["ratios"].get(COMPUTE) for v in summary["equal_compute"]}
    improvements = {(row["label"], row["task"]): row["improvement"] for row in summary["table"]}
    found = {}
    for task in tasks_of(results):
        cells = cells_of(results, task)
        for label, cell in cells.items():
            improvement = improvements[label, task]
            if label == base or not improvement or improvement[0] is None:
                continue
            own, other = (outcomes(c, "final_return") for c in (cell, cells[base]))
            word = word_of(improvement, own, other)
            ratio = ratios.get((label, task))
            shown = [f"{coloured(word)} {shown_chance(improvement[0])}", shown_ratio(ratio)]
            text = "<br>".join([*shown, *marks(label, cells, base)])
            found[label, task] = Cell(word, compute_word(ratio), text, is_idle(cell))
    return found


def marks(label: str, cells: Mapping[str, Mapping[str, Any]], base: str) -> list[str]:
    """Lists what a reader has to know beside an arm's numbers on a task."""
    cell = cells[label]
    lost, own, twin = failed(cell), seeds_of_baseline(cell, cells[base]), twins(cells).get(label)
    said = {
        f"{lost} of {len(complete(cell)) + lost} failed": lost > 0,
        f"drops {percent(left_out(cell) or 0.0)}": is_idle(cell),
        f"is `{base}` in {own} of {len(complete(cell))} seeds": own > 0,
        f"same training as `{twin}`": twin not in (None, base),
    }
    return [text for text, holds in said.items() if holds]


def word_of(improvement: Sequence[float | None], own: np.ndarray, base: np.ndarray) -> str:
    """Chooses better, worse, same or not decided; see the page's notes.

    Args:
      improvement: the probability of improvement and its interval.
      own, base: final returns of the arm and of the baseline, `[n]` each; -inf of a failed seed.
    """
    _, low, high = improvement
    if low is None or high is None:
        return "not decided"
    if low > 0.5:
        return "better"
    if high < 0.5 or (np.isneginf(own).all() and np.isfinite(base).all()):
        return "worse"
    if min(len(own), len(base)) < 2 or not np.isfinite([*own, *base]).all():
        return "not decided"
    limits = difference_interval(own, base)
    return "same" if max(map(abs, limits)) <= SAME * abs(base.mean()) else "not decided"


def compute_word(ratio: Sequence[float | None] | None) -> str:
    """Chooses better, worse, not decided or not reached; a dash if no compute is recorded.

    Args:
      ratio: the compute to PPO's final return, of PPO's, and its interval. Below 1 is better.
    """
    if ratio is None:
        return "-"
    value, low, high = ratio
    if value is None:
        return "not reached"
    if high is not None and high < 1 - ROUNDING:
        return "better"
    return "worse" if low is not None and low > 1 + ROUNDING else "not decided"


def difference_interval(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Computes Welch's 95% interval of the difference of two means."""
    if np.ptp(x) == np.ptp(y) == 0:
        return (float(x.mean() - y.mean()),) * 2
    with warnings.catch_warnings(action="ignore"):  # SciPy's, of seeds that hardly differ
        result = scipy.stats.ttest_ind(x, y, equal_var=False)
    limits = result.confidence_interval(QUANTILES[1] - QUANTILES[0])
    return float(limits.low), float(limits.high)


def shown_chance(value: float) -> str:
    """Writes a probability with as many digits as show on which side of one half it lies."""
    return _beside(0.5, value)


def _beside(limit: float, value: float) -> str:
    """Writes a number with two digits, or as many as show on which side of a limit it lies."""
    digits = 2
    while float(text := f"{value:.{digits}f}") == limit and abs(value - limit) > ROUNDING:
        digits += 1
    return text


def shown_improvement(improvement: Sequence[float | None] | None) -> str:
    """Writes a probability of improvement and its interval: `0.10 [0.01, 0.498]`."""
    if not improvement or improvement[0] is None:
        return "-"
    value, low, high = improvement
    ends = "" if low is None or high is None else f" [{shown_chance(low)}, {shown_chance(high)}]"
    return f"{shown_chance(value)}{ends}"


def shown_ratio(ratio: Sequence[float | None] | None) -> str:
    """Writes a ratio of compute and its interval; `-` where there is none to give."""
    if ratio is None:
        return "-"
    value, low, high = ratio
    if value is None:
        return "not reached"
    if low is None:
        return f"x {value:.2f}"
    return f"x {value:.2f} [{_beside(1, low)}, {'-' if high is None else _beside(1, high)}]"


def coloured(word: str) -> str:
    """Writes a word in the colour that the site gives it."""
    return f'<span class="{word.replace(",", "").replace(" ", "-")}">{word}</span>'
