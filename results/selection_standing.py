"""Which rules of the screen go on: their standing over all of its tasks, as the protocol has it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from selection_trainings import (
    cells_of,
    complete,
    failed,
    is_control,
    is_idle,
    outcomes,
    share_of,
    tasks_of,
)
from studies import markdown

from sauna.experiments.statistics import improvement
from sauna.experiments.study.spec import Spec

BEST = 4  # rules that go on to the tuning
TIE = 0.01  # means that differ by no more are a tie
EVEN = 0.5  # the probability of improvement of a rule that changes nothing
SCORES = ("final_return", "auc")  # counted alike
Planned = Mapping[tuple[str, str], int]  # the seeds of each arm on each task


class Standing(NamedTuple):
    """A rule over the tasks on which all of its seeds have ended.

    Attributes:
      chances: for each task the mean of two probabilities of improvement over `ppo`, that of the
        final return and that of the AUC.
      samples, seconds: compute as a share of PPO's, mean over these tasks; None if unknown on one.
    """

    label: str
    chances: Mapping[str, float]
    samples: float | None
    seconds: float | None

    @property
    def mean(self) -> float:
        """Returns the mean of the chances over tasks."""
        return float(np.mean([*self.chances.values()]))


def planned_of(specs: Iterable[Spec]) -> dict[tuple[str, str], int]:
    """Lists the seeds that studies plan for each arm on each task."""
    return {
        (arm.label, task): len(arm.seeds)
        for spec in specs
        for task in spec.tasks
        for arm in spec.arms
        if task in arm.tasks
    }


def standing(studies: Sequence[Mapping[str, Any]], planned: Planned) -> list[Standing]:
    """Orders the rules, the best first; controls are none.

    Rules of more tasks come first: a mean over fewer tasks cannot be compared with theirs.
    """
    found: dict[str, list[tuple[str, float, float | None, float | None]]] = {}
    for results in studies:
        for task in tasks_of(results):
            cells, base = cells_of(results, task), results["baseline"]
            ended = [label for label, cell in cells.items() if _ended(cell, planned)]
            rules = [label for label in ended if label != base and not is_control(label)]
            for label in rules if base in ended else ():
                pair = cells[label], cells[base]
                found.setdefault(label, []).append((task, chance(*pair), *_compute(*pair)))
    rows = [_standing(label, parts) for label, parts in found.items()]
    numbers = sorted({len(row.chances) for row in rows}, reverse=True)
    return [r for n in numbers for r in ordered([r for r in rows if len(r.chances) == n])]


def _ended(cell: Mapping[str, Any], planned: Planned) -> bool:
    seeds = planned.get((cell["label"], cell["task"]), 0)
    scored = all(len(outcomes(cell, name)) for name in SCORES)
    return scored and 0 < seeds <= len(complete(cell)) + failed(cell)


def _compute(cell: Mapping[str, Any], base: Mapping[str, Any]) -> tuple[float | None, float | None]:
    names = ("samples_backward", "learner_cpu_seconds")
    samples, seconds = (share_of(cell, base, name) for name in names)
    return samples, seconds


def _standing(
    label: str, parts: Sequence[tuple[str, float, float | None, float | None]]
) -> Standing:
    samples, seconds = ([part[i] for part in parts] for i in (2, 3))
    return Standing(
        label,
        {task: value for task, value, *_ in parts},
        *(None if None in values else float(np.mean(values)) for values in (samples, seconds)),
    )


def chance(cell: Mapping[str, Any], base: Mapping[str, Any]) -> float:
    """Computes how probably a rule beats `ppo` on a task, final return and AUC counted alike.

    A failed seed has the worst outcome in both. A rule that left out under 1% of its samples gets
    no credit for its choice: one half at most.
    """
    found = float(np.mean([improvement(outcomes(cell, n), outcomes(base, n)) for n in SCORES]))
    return min(found, EVEN) if is_idle(cell) else found


def ordered(rows: Sequence[Standing]) -> list[Standing]:
    """Orders by the mean; of those within `TIE` of the highest, the one of less compute is next.

    Less compute is fewer samples through the gradient; if those are alike to two digits, fewer CPU
    seconds of the learner.
    """
    left, found = sorted(rows, key=lambda row: -row.mean), []
    while left:
        tied = [row for row in left if left[0].mean - row.mean <= TIE + 1e-9]
        found.append(min(tied, key=_price))
        left.remove(found[-1])
    return found


def _price(row: Standing) -> tuple[float, float]:
    samples, seconds = row.samples, row.seconds
    return (
        np.inf if samples is None else round(samples, 2),
        np.inf if seconds is None else seconds,
    )


def missing(rows: Sequence[Standing], planned: Planned, base: str = "ppo") -> list[str]:
    """Lists the tasks that some rule of the plan has not ended on."""
    ended = {(row.label, task) for row in rows for task in row.chances}
    return list(
        dict.fromkeys(
            task
            for label, task in planned
            if label != base and not is_control(label) and (label, task) not in ended
        )
    )


def best(rows: Sequence[Standing], planned: Planned) -> list[str] | None:
    """Chooses the rules that go on; None while the screen is not complete."""
    return None if missing(rows, planned) else [row.label for row in rows[:BEST]]


def standing_text(rows: Sequence[Standing], planned: Planned) -> str:
    """Writes the table of the standing, and which rules go on or why none is chosen yet."""
    tasks = len({task for _, task in planned})
    chosen, left = best(rows, planned), len(missing(rows, planned))
    said = (
        f"The screen is complete. The four best are {', '.join(f'`{name}`' for name in chosen)}."
        if chosen
        else f"The screen is not complete: on {left} of {tasks} tasks some rule has seeds that "
        "are still to be trained. No rule is chosen. Means over different tasks cannot be compared."
    )
    head = [
        "Rule",
        "Mean over tasks",
        "Tasks",
        "Samples learned from",
        "CPU seconds of the learner",
    ]
    lines = [
        [f"`{r.label}`", f"{r.mean:.2f}", f"{len(r.chances)} of {tasks}", *map(_share, r[2:])]
        for r in rows
    ]
    return f"{said}\n\n{markdown([head, *lines])}" if rows else said


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} of PPO's"
