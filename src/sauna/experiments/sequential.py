"""A tournament that adds seeds only where something is still open: a group-sequential design.

All arms begin with few seeds. At each look every arm still running is compared with the baseline,
and some arms stop. The others get more seeds, up to the last look.

Why no error adds up: the level 0.05 is split over the looks, `sum alpha_l = 0.05`, and each look's
part is shared by all arms that entered (Holm), those that have stopped included. So the chance of
any false "better" or "worse" in the whole tournament is at most 0.05, by the union bound, whatever
the returns' distribution. Stopping an arm early for futility calls nothing better, and adds none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sauna.experiments.statistics import exact_p, holm, improvement


class Look(NamedTuple):
    """One look at the data.

    Attributes:
      seeds: of each arm by then.
      level: the part of 0.05 that this look may spend.
      futile: an arm whose estimated probability of improvement is below this stops.
    """

    seeds: int
    level: float
    futile: float


# Little is spent early (O'Brien and Fleming 1979), since few seeds decide nothing.
DESIGN = (
    Look(3, 0.0, 0.25),
    Look(6, 0.005, 0.45),
    Look(10, 0.015, 0.55),
    Look(16, 0.03, 0.0),
)
LEVEL = sum(look.level for look in DESIGN)


class Standing(NamedTuple):
    """Where an arm is after a look."""

    verdict: str  # better, worse, open, or not decided
    reason: str  # one sentence; empty while it is open
    probability: float  # of improvement over the baseline, estimated
    p: float  # after Holm's correction, at this look
    seeds: int


def look_at(
    scores: Mapping[str, np.ndarray],
    baseline: str,
    look: Look,
    running: Sequence[str],
    is_last: bool,
) -> dict[str, Standing]:
    """Compares the arms still running with the baseline.

    Args:
      scores: `[seeds]` of every arm that entered; a failed seed is -inf.
      running: the arms that have not stopped.
    """
    everyone = [arm for arm in scores if arm != baseline]
    raw = [exact_p(scores[arm], scores[baseline]) if arm in running else 1.0 for arm in everyone]
    corrected = dict(zip(everyone, holm(raw), strict=True))
    found = {}
    for arm in running:
        probability = improvement(scores[arm], scores[baseline])
        verdict, reason = _verdict(probability, corrected[arm], look, is_last)
        found[arm] = Standing(verdict, reason, probability, corrected[arm], len(scores[arm]))
    return found


def _verdict(probability: float, p: float, look: Look, is_last: bool) -> tuple[str, str]:
    if p < look.level:
        verdict = "better" if probability > 0.5 else "worse"
        return verdict, f"{verdict} at p {p:.3g} with {look.seeds} seeds (level {look.level:g})"
    if is_last:
        return "not decided", f"not decided with all {look.seeds} seeds"
    if probability < look.futile:
        text = f"stopped with {look.seeds} seeds: probability of improvement {probability:.2f}"
        return "not decided", f"{text}, below {look.futile:g}"
    return "open", ""


def tournament(
    draw: Mapping[str, np.ndarray], baseline: str, design: Sequence[Look] = DESIGN
) -> dict[str, Standing]:
    """Plays the whole design on scores that are there already, `[seeds]` of each arm.

    An arm's scores beyond its last look are not read.
    """
    running = [arm for arm in draw if arm != baseline]
    ended: dict[str, Standing] = {}
    for number, look in enumerate(design):
        scores = {arm: values[: look.seeds] for arm, values in draw.items()}
        found = look_at(scores, baseline, look, running, number == len(design) - 1)
        ended |= found
        running = [arm for arm in running if found[arm].verdict == "open"]
        if not running:
            break
    return ended
