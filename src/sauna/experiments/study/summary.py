"""From the results of a study to what they support, in numbers and in words.

Everything is computed from `results` alone, so a summary can be remade at any time. Only members
that trained to the end count. The words follow from tests and intervals, never from which mean is
larger, and no arm gets credit for filtering where it filtered next to nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sauna.config.presets import arm_settings
from sauna.config.settings import Config
from sauna.experiments.curves import common_grid, on_grid
from sauna.experiments.statistics import (
    ALPHA,
    POWER,
    Comparison,
    compare,
    improvement_over_tasks,
    iqm_estimate,
    mean_interval,
    performance_profile,
)
from sauna.system.errors import BadInput

FORMAT = 1
# Settings that two arms may differ in and yet differ in the choice of steps alone.
FILTERS_OWN = (
    "arm",
    "seeds",
    "out",
    "processes",
    "filter",
    "threshold",
    "threshold_schedule",
    "keep_rate_target",
    "history",
    "decision",
    "dropped",
    "max_env_steps_factor",
    "drop_rate",
    "drop_rate_from",
)
GRID = 60  # points of a curve at most
UNFILTERED = 0.99  # mean keep rate from which a difference is not credited to filtering
MORE_STEPS = 0.01  # relative difference in env steps from which it is mentioned
FILTERING = (
    "Each arm that filters against what differs from it in the choice of steps alone: the head "
    "without a filter, and a coin that drops as much."
)
MANY_SEEDS = 1000  # no estimate of a number of seeds is worth more digits
# What a curve shows, and the values it can take at all: no interval claims more.
QUANTITIES = {
    "return_mean": (-math.inf, math.inf),
    "keep_rate": (0.0, 1.0),
    "vex_mean": (-math.inf, math.inf),
    "explained_variance": (-math.inf, 1.0),
}


class Cell(NamedTuple):
    """One arm on one task: its members that are complete, and how many are not."""

    task: str
    label: str
    arm: str
    baseline: str | None  # the label that it is compared with
    complete: list[dict[str, Any]]
    failed: int
    running: int
    waiting: int
    rates_of: str | None = None  # of a coin, the label whose drop rates it repeats
    config: Mapping[str, Any] = MappingProxyType({})  # empty where only numbers were stored

    def values(self, name: str) -> np.ndarray:
        """The finite values of a member's entry `name`, over complete members."""
        found = np.array([member.get(name) for member in self.complete], float)
        return found[np.isfinite(found)]

    def mean(self, name: str) -> float | None:
        values = self.values(name)
        return float(values.mean()) if len(values) else None


def summarize(results: Mapping[str, Any]) -> dict[str, Any]:
    """What `results` (format 1) support: verdicts, table, profiles and curves, ready for JSON.

    Values that cannot be computed are None.

    Raises:
      BadInput: results of another format.
    """
    if results.get("format") != FORMAT:
        raise BadInput(f"results: format {results.get('format')!r}, but only {FORMAT} is known")
    cells = [_cell(stored, results["baseline"]) for stored in results["cells"]]
    of_task = {
        task: [c for c in cells if c.task == task]
        for task in dict.fromkeys(cell.task for cell in cells)
    }
    found = {task: _compare(of_task[task]) for task in of_task}
    return {
        "verdicts": [
            verdict
            for task, of_label in found.items()
            for verdict in _verdicts(of_task[task], of_label, len(of_task))
        ],
        "filtering": [v for own in of_task.values() for v in _of_filtering(own, len(of_task))],
        "table": [_row(cell, found[cell.task].get(cell.label)) for cell in cells],
        "over_tasks": _over_tasks(of_task),
        "profiles": {task: _profiles(of_task[task]) for task in of_task},
        "curves": {task: {cell.label: _curves(cell) for cell in of_task[task]} for task in of_task},
    }


def _cell(stored: Mapping[str, Any], baseline: str) -> Cell:
    own = stored.get("baseline") or (None if stored["label"] == baseline else baseline)
    members = stored["members"]
    failed, running, waiting = (
        sum(member["status"] == status for member in members)
        for status in ("failed", "running", "waiting")
    )
    complete = [member for member in members if member["status"] == "complete"]
    return Cell(
        stored["task"],
        stored["label"],
        stored["arm"],
        own,
        complete,
        failed,
        running,
        waiting,
        stored.get("rates_of"),
        stored.get("config") or {},
    )


def _compare(cells: Sequence[Cell]) -> dict[str, Comparison]:
    """Each arm against its baseline; the arms of one baseline are one family of tests."""
    scores = {cell.label: cell.values("final_return") for cell in cells}
    found: dict[str, Comparison] = {}
    for baseline in dict.fromkeys(cell.baseline for cell in cells if cell.baseline):
        base = scores.get(baseline, np.zeros(0))
        family = [cell.label for cell in cells if cell.baseline == baseline]
        found |= compare({label: (scores[label], base) for label in family})
    return {cell.label: found[cell.label] for cell in cells if cell.baseline}


def _row(cell: Cell, comparison: Comparison | None) -> dict[str, Any]:
    final = cell.values("final_return")
    return {
        "task": cell.task,
        "label": cell.label,
        "baseline": cell.baseline,
        "seeds": len(cell.complete),
        "failed": cell.failed,
        "running": cell.running,
        "final_iqm": _iqm(final),
        "area_iqm": _iqm(cell.values("area")),
        "final_mean": cell.mean("final_return"),
        "final_std": float(final.std(ddof=1)) if len(final) > 1 else None,
        "keep_rate": cell.mean("keep_rate"),
        "env_steps": cell.mean("env_steps"),
        "kept_steps": cell.mean("kept_steps"),
        "improvement": list(comparison.improvement) if comparison else None,
    }


def _iqm(scores: np.ndarray) -> list[float | None]:
    return list(iqm_estimate([scores])) if len(scores) else [None, None, None]


def _over_tasks(of_task: Mapping[str, Sequence[Cell]]) -> list[dict[str, Any]]:
    """Each label against its baseline, over the tasks where both have two seeds or more."""
    pairs_of = dict.fromkeys((c.label, c.baseline) for cells in of_task.values() for c in cells)
    rows = []
    for label, baseline in pairs_of:
        if baseline is None:
            continue
        pairs = []
        for cells in of_task.values():
            scores = {cell.label: cell.values("final_return") for cell in cells}
            if min(len(scores.get(name, ())) for name in (label, baseline)) > 1:
                pairs.append((scores[label], scores[baseline]))
        if len(pairs) > 1:
            improvement = list(improvement_over_tasks(pairs))
            rows.append(
                {
                    "label": label,
                    "baseline": baseline,
                    "tasks": len(pairs),
                    "improvement": improvement,
                }
            )
    return rows


def _profiles(cells: Sequence[Cell]) -> dict[str, dict[str, list[float | None]]]:
    """Shares at each return seen on the task and just above it, where they change: lines drawn
    between the points are then the steps that a profile consists of."""
    seen = np.unique(np.concatenate([cell.values("final_return") for cell in cells]))
    returns = np.stack([seen, np.nextafter(seen, np.inf)], -1).ravel()
    profiles = {}
    for cell in cells:
        scores = cell.values("final_return")
        if len(scores):
            lines = (returns, *performance_profile(scores, returns))
            names = ("returns", "share", "low", "high")
            profiles[cell.label] = {n: _listed(x) for n, x in zip(names, lines, strict=True)}
    return profiles


def _curves(cell: Cell) -> dict[str, Any]:
    """Mean curves of the complete members, where each of them has values."""
    curves = [member["curve"] for member in cell.complete]
    env_steps = [np.array(curve["env_steps"], float) for curve in curves]
    grid = common_grid(env_steps, GRID)
    drawn: dict[str, Any] = {"env_steps": [int(x) for x in grid]}
    for name, bounds in QUANTITIES.items():
        values = np.array(
            [
                on_grid(x, np.array(curve.get(name) or [None] * len(x), float), grid)
                for x, curve in zip(env_steps, curves, strict=True)
            ]
        ).reshape(len(curves), len(grid))
        lines = mean_interval(values) if len(curves) else (np.zeros(0),) * 3
        mean, low, high = (_listed(np.clip(line, *bounds)) for line in lines)
        drawn[name] = {"mean": mean, "low": low, "high": high}
    return drawn


def _listed(values: np.ndarray) -> list[float | None]:
    return [float(x) if math.isfinite(x) else None for x in values]


def _verdicts(
    cells: Sequence[Cell], found: Mapping[str, Comparison], tasks: int
) -> list[dict[str, Any]]:
    of_label = {cell.label: cell for cell in cells}
    verdicts = []
    for label, comparison in found.items():
        cell = of_label[label]
        absent = Cell(cell.task, str(cell.baseline), "", None, [], 0, 0, 0)
        base = of_label.get(str(cell.baseline), absent)
        family = sum(other.baseline == cell.baseline for other in cells)
        verdicts.append(_verdict(cell, base, comparison, _family(family, "arms"), tasks))
    return verdicts


def _of_filtering(cells: Sequence[Cell], tasks: int) -> list[dict[str, Any]]:
    """Each arm that filters against those that differ from it in the choice of steps alone.

    These are the arm that trains the head and drops nothing, and the coin that drops as much. A
    verdict against the baseline says what head, filter and fewer updates do together; these say
    whether it is the filter. All of a task are one family of tests.
    """
    pairs = {
        f"{cell.label} - {other.label}": (cell, other)
        for cell in cells
        for other in cells
        if _settings(cell.arm).get("filter") == "sauna" and _is_control(other, cell)
    }
    found = compare(
        {
            name: (cell.values("final_return"), other.values("final_return"))
            for name, (cell, other) in pairs.items()
        }
    )
    family = _family(len(pairs), "comparisons")
    return [_verdict(*pairs[name], comparison, family, tasks) for name, comparison in found.items()]


def _is_control(other: Cell, cell: Cell) -> bool:
    """Whether `other` is the coin of `cell`, or trains the same head by the same rules alone.

    Without stored settings an arm's name says what its rules are.
    """
    if other.rates_of == cell.label:
        return True
    if other.arm != "vex-head" or cell.baseline is None or other.baseline != cell.baseline:
        return False
    if cell.config and other.config:
        names = (set(cell.config) | set(other.config)) - set(FILTERS_OWN)
        return all(cell.config.get(name) == other.config.get(name) for name in names)
    return all(
        getattr(Config(), name) == value
        for name, value in _settings(cell.arm).items()
        if name not in FILTERS_OWN
    )


def _verdict(
    cell: Cell, base: Cell, comparison: Comparison, family: str, tasks: int
) -> dict[str, Any]:
    """`family`: what the test is corrected for."""
    sentences = [
        _finding(cell, base, comparison, family),
        *_limits(cell, base, comparison, tasks),
        *_circumstances(cell, base),
    ]
    text = " ".join(filter(None, sentences))
    return {
        "task": cell.task,
        "label": cell.label,
        "against": base.label,
        "kind": comparison.kind,
        "chance": comparison.improvement.value,
        "text": text,
    }


def _family(number: int, what: str) -> str:
    """`4 arms`; empty where a test is alone and nothing is corrected."""
    return f"{number} {what}" if number > 1 else ""


def _finding(cell: Cell, base: Cell, comparison: Comparison, family: str) -> str:
    """The verdict as a sentence, with what it rests on."""
    kind, (chance, low, high) = comparison.kind, comparison.improvement
    n, m = (len(c.values("final_return")) for c in (cell, base))
    if kind == "too few" or chance is None or low is None or high is None:
        return _too_few(cell, base, comparison, family)
    said = f"{kind} than" if kind != "no evidence" else "no evidence of a difference from"
    correction = f" after Holm's correction for {family}" if family else ""
    shown = [_shown(x, 2, 0.5) for x in (chance, low, high)]
    p = "< 0.001" if comparison.p < 0.001 else f"= {_shown(comparison.p, 3, ALPHA)}"
    return (
        f"{cell.label}: {said} {base.label} on {cell.task} (P(better) = {shown[0]} "
        f"[{shown[1]}, {shown[2]}], exact p {p}{correction}, {n} against {m} seeds)."
    )


def _too_few(cell: Cell, base: Cell, comparison: Comparison, family: str) -> str:
    n, m = (len(c.values("final_return")) for c in (cell, base))
    text = (
        f"{cell.label}: too few seeds to say anything against {base.label} on {cell.task}: "
        f"{n} against {m} complete; at least {comparison.least} of each are needed"
    )
    if family:
        text += f" for {family}"
    if comparison.needed is not None:
        text += (
            f", and {_about(comparison.needed)} for a difference as large as the one seen, "
            f"were it the true one ({POWER:.0%} power)"
        )
    return text + "."


def _limits(cell: Cell, base: Cell, comparison: Comparison, tasks: int) -> list[str]:
    """What a reader could otherwise take the verdict for."""
    kind, (chance, low, high) = comparison.kind, comparison.improvement
    if kind == "too few" or chance is None or low is None or high is None:
        return []
    n, m = (len(c.values("final_return")) for c in (cell, base))
    if kind == "no evidence":
        said = []
        if not low <= 0.5 <= high:
            said.append("The interval leaves out 0.5, but the test, which decides, does not.")
        elif comparison.p < ALPHA:
            said.append("The test rejects, but the interval, which has to agree, holds 0.5.")
        if comparison.needed is not None and comparison.needed > min(n, m):
            said.append(
                f"Were the difference seen the true one, {_about(comparison.needed)} seeds of "
                f"each would be needed to find it ({POWER:.0%} power)."
            )
        return said
    said = [f"This is not corrected for the {tasks} tasks."] if tasks > 1 else []
    above = (cell.mean("final_return") or 0.0) - (base.mean("final_return") or 0.0)
    if above * (chance - 0.5) < 0:
        said.append(f"Its mean final return is {'higher' if above > 0 else 'lower'} all the same.")
    return said


def _circumstances(cell: Cell, base: Cell) -> list[str]:
    """What else the difference, or the lack of one, may come from."""
    filtering = _filtering(cell, "It") if _filters(cell) else _filtering(base, base.label)
    said = [filtering, _experience(cell, base)]
    for number, text in (
        ("failed", "Failed seeds are left out ({}), which flatters an arm whose training broke."),
        ("unfinished", "Not finished yet: {}; a verdict read early is wrong more often."),
        ("unscored", "Complete seeds without a final return are left out: {}."),
    ):
        counts = [(_missing(c)[number], c.label) for c in (cell, base)]
        parts = [f"{count} of {label}" for count, label in counts if count]
        said.append(text.format(", ".join(parts)) if parts else "")
    return said


def _missing(cell: Cell) -> dict[str, int]:
    return {
        "failed": cell.failed,
        "unfinished": cell.running + cell.waiting,
        "unscored": len(cell.complete) - len(cell.values("final_return")),
    }


def _filters(cell: Cell) -> bool:
    return _settings(cell.arm).get("filter") != "none"


def _filtering(cell: Cell, name: str) -> str:
    keep_rate = cell.mean("keep_rate")
    if not _filters(cell) or keep_rate is None or keep_rate < UNFILTERED:
        return ""
    dropped = "none" if keep_rate >= 1 else f"{100 * (1 - keep_rate):.2g}%"
    return f"{name} dropped {dropped} of its steps, so no difference can be credited to filtering."


def _experience(cell: Cell, base: Cell) -> str:
    own, other = cell.mean("env_steps"), base.mean("env_steps")
    if not own or not other or abs(own / other - 1) <= MORE_STEPS:
        return ""
    return f"It took {own / other:.2f} times the env steps of {base.label}."


def _shown(value: float, digits: int, edge: float) -> str:
    """As many digits as it takes to see on which side of `edge` the value lies."""
    while float(text := f"{value:.{digits}f}") == edge and value != edge:
        digits += 1
    return text


def _about(seeds: int) -> str:
    """Two significant digits, rounded up: the estimate carries no more."""
    if seeds > MANY_SEEDS:
        return f"more than {MANY_SEEDS}"
    unit = 10 ** max(len(str(seeds)) - 2, 0)
    return f"about {math.ceil(seeds / unit) * unit}"


def _settings(arm: str) -> dict[str, Any]:
    """The settings of an arm; none if this version does not know it."""
    try:
        return arm_settings(arm)
    except BadInput:
        return {}
