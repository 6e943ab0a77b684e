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
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sauna.experiments.statistics import MAX_FAILED, exact_p, holm, improvement


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


class Standing(NamedTuple):
    """Where an arm is after a look."""

    verdict: str  # better, worse, open, or not decided
    reason: str  # one sentence; empty while it is open
    probability: float  # of improvement over the baseline, estimated
    p: float  # after Holm's correction, at this look
    seeds: int


class Replay(NamedTuple):
    """How far a tournament has come on the scores so far.

    Attributes:
      standings: of each arm that was looked at, its last one.
      beside_control: of each such arm with a control, at the same look, against that control.
      running: the arms that are still open.
      look: the index of the look that waits for seeds; None once everything is decided.
    """

    standings: dict[str, Standing]
    beside_control: dict[str, Standing]
    running: list[str]
    look: int | None


def capped(most: int, design: Sequence[Look] = DESIGN) -> tuple[Look, ...]:
    """Returns the design that ends with `most` seeds; its last look spends all that is left.

    Raises:
      ValueError: the design has fewer seeds.
    """
    if most > design[-1].seeds:
        raise ValueError(f"a tournament takes at most {design[-1].seeds} seeds, not {most}")
    if most == design[-1].seeds:
        return tuple(design)
    before = [look for look in design if look.seeds < most]
    left = sum(look.level for look in design) - sum(look.level for look in before)
    return (*before, Look(most, left, 0.0))


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
    pairs = {arm: (scores[arm], scores[baseline]) for arm in scores if arm != baseline}
    return _stand(pairs, look, running, is_last)


def _stand(
    pairs: Mapping[str, tuple[np.ndarray, np.ndarray]],
    look: Look,
    running: Sequence[str],
    is_last: bool,
) -> dict[str, Standing]:
    """Tests the pairs still running; all pairs that entered are one family."""
    raw = [exact_p(*pair) if arm in running else 1.0 for arm, pair in pairs.items()]
    corrected = dict(zip(pairs, holm(raw), strict=True))
    found = {}
    for arm in (arm for arm in running if arm in pairs):
        x, y = pairs[arm]
        probability, failed = improvement(x, y), max(map(_failed, (x, y)))
        verdict, reason = _verdict(probability, corrected[arm], look, is_last, failed)
        found[arm] = Standing(verdict, reason, probability, corrected[arm], len(x))
    return found


def _failed(scores: np.ndarray) -> float:
    return float(np.isneginf(scores).mean())


def _verdict(
    probability: float, p: float, look: Look, is_last: bool, failed: float
) -> tuple[str, str]:
    """`failed`: the larger share of failed seeds; above `MAX_FAILED` nothing is called better."""
    if p < look.level and failed <= MAX_FAILED:
        verdict = "better" if probability > 0.5 else "worse"
        return verdict, f"{verdict} at p {p:.3g} with {look.seeds} seeds (level {look.level:g})"
    many = f": {failed:.0%} of the seeds of one side failed" if failed > MAX_FAILED else ""
    if is_last:
        return "not decided", f"not decided with all {look.seeds} seeds{many}"
    if probability < look.futile:
        text = f"stopped with {look.seeds} seeds: probability of improvement {probability:.2f}"
        return "not decided", f"{text}, below {look.futile:g}"
    return "open", ""


def replay(
    scores: Mapping[str, np.ndarray],
    baseline: str,
    design: Sequence[Look] = DESIGN,
    controls: Mapping[str, str] = MappingProxyType({}),
) -> Replay:
    """Plays the design as far as the scores go: the same scores, the same tournament.

    An arm is compared with its control at the look where it stops. These comparisons are a second
    family, with the levels of the same looks: so the chance of any false claim among them is at
    most 0.05 as well. An arm's scores beyond the look where it stopped are not read.

    Args:
      scores: `[seeds]` of the baseline, the arms and their controls, in the order of the seeds.
      controls: the label of each arm's matched random control, where it has one.
    """
    arms = [arm for arm in scores if arm != baseline and arm not in controls.values()]
    running, ended = arms, Replay({}, {}, arms, None)
    for number, look in enumerate(design):
        needed = [baseline, *running, *(controls[arm] for arm in running if arm in controls)]
        if min(len(scores[name]) for name in needed) < look.seeds:
            return ended._replace(running=running, look=number)
        cut = {name: values[: look.seeds] for name, values in scores.items()}
        is_last = number == len(design) - 1
        found = look_at({a: cut[a] for a in (baseline, *arms)}, baseline, look, running, is_last)
        running = [arm for arm in running if found[arm].verdict == "open"]
        pairs = {arm: (cut[arm], cut[controls[arm]]) for arm in arms if arm in controls}
        stopped = [arm for arm in found if arm not in running]
        beside = _stand(pairs, look, stopped, is_last=True)
        ended = Replay(ended.standings | found, ended.beside_control | beside, running, None)
        if not running:
            break
    return ended


def tournament(
    draw: Mapping[str, np.ndarray], baseline: str, design: Sequence[Look] = DESIGN
) -> dict[str, Standing]:
    """Plays the whole design on scores that are known already, `[seeds]` of each arm.

    An arm's scores beyond its last look are not read.
    """
    return replay(draw, baseline, design).standings
