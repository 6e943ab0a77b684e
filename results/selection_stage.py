"""The tests of a stage of the protocol, which Holm's correction covers all together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from selection_standing import Planned
from selection_trainings import cells_of, outcomes, tasks_of, twins

from sauna.config.presets import RANDOM_CONTROL
from sauna.experiments.statistics import ALPHA, exact_p, holm


class Stage(NamedTuple):
    """The tests of a stage.

    Attributes:
      p: of each test that can be made so far, before the correction; its name is
        `top-advantage` against `ppo` on Hopper-v5.
      planned: the number of tests of the whole stage; a training that two arms share counts once.
      least: the lowest p value that a test can have with the seeds of the plan.
    """

    p: Mapping[str, float]
    planned: int
    least: float

    def corrected(self) -> dict[str, float]:
        """Applies Holm's correction over the stage; a test still to come counts as p = 1."""
        left = [1.0] * (self.planned - len(self.p))
        return dict(zip(self.p, holm([*self.p.values(), *left]), strict=False))


def stage_of(studies: Sequence[Mapping[str, Any]], planned: Planned, base: str = "ppo") -> Stage:
    """Makes the tests of a stage: each arm against `ppo`, each rule against its random control."""
    p: dict[str, float] = {}
    shared = 0
    for results in studies:
        for task in tasks_of(results):
            cells = cells_of(results, task)
            same = twins(cells)
            shared += len(same)
            scores = {label: outcomes(cell, "final_return") for label, cell in cells.items()}
            for label, other in _pairs(scores, base):
                own, against = scores[label], scores.get(other, ())
                if len(own) and len(against) and not (other == base and label in same):
                    p[f"`{label}` against `{other}` on {task}"] = exact_p(own, against)
    number = len(_pairs_of_plan(planned, base)) - shared
    seeds = min(planned.values(), default=1)
    return Stage(p, max(number, len(p)), 2 / math.comb(2 * seeds, seeds))


def _pairs(labels: Mapping[str, Any], base: str) -> list[tuple[str, str]]:
    against_base = [(label, base) for label in labels if label != base]
    controlled = [(x, x + RANDOM_CONTROL) for x in labels if x + RANDOM_CONTROL in labels]
    return against_base + controlled


def _pairs_of_plan(planned: Planned, base: str) -> list[tuple[str, str]]:
    found = []
    for task in dict.fromkeys(task for _, task in planned):
        found += _pairs({label: None for label, t in planned if t == task}, base)
    return found


def stage_text(stage: Stage) -> str:
    """Says what the tests of a stage decide after the correction."""
    said = [
        f"The stage has {stage.planned} tests: each arm against `ppo`, and each rule against its "
        "matched random control. Arms that are one and the same training count once. Holm's "
        f"correction covers all of them. {len(stage.p)} can be made so far."
    ]
    corrected = stage.corrected()
    decided = [name for name, p in corrected.items() if p < ALPHA]
    lowest = min(1.0, stage.planned * stage.least)
    if decided:
        said.append(f"After the correction these are below {ALPHA:.2f}: {', '.join(decided)}.")
    elif lowest >= ALPHA:
        said.append(
            f"No exact test of so few seeds can be below {stage.least:.3f}, which is {lowest:.2f} "
            "after the correction. So no test of this stage decides anything."
        )
    elif corrected:
        said.append(
            f"The lowest p value after the correction is {min(corrected.values()):.2f}. No test "
            "decides anything."
        )
    return " ".join(said)
