"""What a comparison of two arms supports, in a sentence that claims no more than its test."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from sauna.config.presets import RANDOM_CONTROL, arm_settings
from sauna.config.settings import Config
from sauna.experiments.statistics import ALPHA, POWER, Comparison, compare, least_seeds
from sauna.experiments.study.cells import MAX_FAILED, Cell, is_control_among
from sauna.system.errors import BadInput

# Settings that two arms may differ in and yet differ in the choice of steps alone.
FILTERS_OWN = (
    "arm",
    "seeds",
    "out",
    "processes",
    "filter",
    "filter_kwargs",
    "control",
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
# Settings that an arm and its control may differ in.
CONTROLS_OWN = ("arm", "seeds", "out", "processes", "control")
UNFILTERED = 0.99  # mean keep rate from which a difference is not credited to filtering
MORE_STEPS = 0.01  # relative difference in env steps from which it is mentioned
ABLATION = "Each arm that selects samples against those that differ from it in the rule alone: "
HEAD_ONLY = "the head-only ablation, which trains the head and drops nothing"
CONTROL = "the matched random control, which takes as many samples at random"
MANY_SEEDS = 1000  # no estimate of a number of seeds is worth more digits


def verdicts_of(
    cells: Sequence[Cell], found: Mapping[str, Comparison], tasks: int
) -> list[dict[str, Any]]:
    """Writes the verdict of each arm of a task against its baseline.

    Args:
      found: the comparison of each label that has a baseline.
      tasks: how many the study has.
    """
    of_label = {cell.label: cell for cell in cells}
    families, least = families_of(cells), least_of(cells)
    verdicts = []
    for label, comparison in found.items():
        cell = of_label[label]
        absent = Cell(cell.task, str(cell.baseline), "", None, [], 0, 0, 0)
        base = of_label.get(str(cell.baseline), absent)
        number = next(len(family) for family in families if cell in family)
        comparison = comparison._replace(least=least)
        verdicts.append(_verdict(cell, base, comparison, _family(number, "arms"), tasks))
    return verdicts


def ablations_of(cells: Sequence[Cell], tasks: int) -> list[dict[str, Any]]:
    """Compares each arm that selects steps with those that differ in the choice of steps alone.

    These are the head-only ablation and the matched random control. A verdict against the baseline
    says what head, selection and fewer updates do together; these say what the selection rule does.
    All of a task are one family of tests.
    """
    pairs = _ablations(cells)
    found = compare(
        {name: (cell.scores(), other.scores()) for name, (cell, other) in pairs.items()}
    )
    family, least = _family(len(pairs), "comparisons"), least_of(cells)
    return [
        _verdict(*pairs[name], comparison._replace(least=least), family, tasks)
        for name, comparison in found.items()
    ]


def _ablations(cells: Sequence[Cell]) -> dict[str, tuple[Cell, Cell]]:
    return {
        f"{cell.label} - {other.label}": (cell, other)
        for cell in cells
        for other in cells
        if is_random_control(other, cell) or _is_head_of(other, cell)
    }


def about_ablations(cells: Sequence[Cell]) -> str:
    """Says which ablations the arms of a study have; empty if there is none."""
    pairs = _ablations(cells).values()
    heads = [HEAD_ONLY] if any(_is_head_of(other, cell) for cell, other in pairs) else []
    controls = [CONTROL] if any(is_random_control(other, cell) for cell, other in pairs) else []
    return f"{ABLATION}{', and '.join(heads + controls)}." if pairs else ""


def families_of(cells: Sequence[Cell]) -> list[list[Cell]]:
    """Returns the arms of a task whose tests are corrected together.

    Controls are a family of their own: they take nothing from the rules' tests.
    """
    found = [
        [c for c in cells if c.baseline == baseline and is_control_among(c, cells) == is_control]
        for baseline in dict.fromkeys(cell.baseline for cell in cells if cell.baseline)
        for is_control in (False, True)
    ]
    return [family for family in found if family]


def least_of(cells: Sequence[Cell]) -> int:
    """Returns the seeds of each arm below which some comparison of a task can decide nothing."""
    numbers = [*map(len, families_of(cells)), len(_ablations(cells))]
    return max((least_seeds(number) for number in numbers if number), default=2)


def is_random_control(other: Cell, cell: Cell) -> bool:
    """Whether `other` is the matched random control of `cell`: the same settings but the control.

    One of 0.1.0 repeated the measured drop rates of the runs of `cell` instead.
    """
    if other.rates_of is not None:
        return other.rates_of == cell.label
    if other.arm != cell.arm + RANDOM_CONTROL:
        return False
    if cell.config and other.config:
        names = (set(cell.config) | set(other.config)) - set(CONTROLS_OWN)
        return all(cell.config.get(name) == other.config.get(name) for name in names)
    return _typed(cell.command) == _typed(other.command)


def _typed(command: str) -> list[str]:
    """The settings in a command, but for the arm and the seeds."""
    words = shlex.split(command, comments=True)
    return [
        word
        for before, word in zip(["", *words], words, strict=False)
        if not {before, word} & {"--arm", "--seeds"}
    ]


def _is_controlled(cell: Cell) -> bool:
    """Whether a control replaces what the arm's rule takes."""
    control = cell.config.get("control") or _settings(cell.arm).get("control", "none")
    return bool(control != "none")


def _is_head_of(other: Cell, cell: Cell) -> bool:
    """Whether `other` is the head-only ablation of `cell`, whose own filter drops."""
    filters = _settings(cell.arm).get("filter") == "sauna"
    return filters and not _is_controlled(cell) and _is_head_alone(other, cell)


def _is_head_alone(other: Cell, cell: Cell) -> bool:
    """Whether `other` is the head-only ablation of `cell`.

    Without stored settings an arm's name says what its rules are.
    """
    if other.arm != "vex-head" or cell.baseline is None or other.baseline != cell.baseline:
        return False
    if cell.config and other.config:
        return _same_rules(other, cell, FILTERS_OWN)
    return all(
        getattr(Config(), name) == value
        for name, value in _settings(cell.arm).items()
        if name not in FILTERS_OWN
    )


def _same_rules(other: Cell, cell: Cell, but: Sequence[str] = CONTROLS_OWN) -> bool:
    names = (set(cell.config) | set(other.config)) - set(but)
    return all(cell.config.get(name) == other.config.get(name) for name in names)


def _verdict(
    cell: Cell, base: Cell, comparison: Comparison, family: str, tasks: int
) -> dict[str, Any]:
    """`family`: what the test is corrected for."""
    failed = [c for c in (cell, base) if c.too_many_failed]
    if failed and comparison.kind != "underpowered":
        comparison = comparison._replace(kind="too many failed")
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
        "needed": _needed(cell, base, comparison),
        "text": text,
    }


def _needed(cell: Cell, base: Cell, comparison: Comparison) -> str | None:
    """How many seeds of each would decide a difference as large as the one seen, if more."""
    fewest = min(len(c.scores()) for c in (cell, base))
    few = comparison.needed is None or comparison.needed <= fewest
    return None if comparison.kind != "no evidence" or few else _about(int(comparison.needed or 0))


def seeds_needed(verdicts: Sequence[Mapping[str, Any]]) -> str:
    """Says once how many seeds would decide what is not decided; empty if nothing is known."""
    known = [verdict for verdict in verdicts if verdict.get("needed")]
    tasks = len({verdict["task"] for verdict in known}) > 1
    parts = [
        f"{v['label']} against {v['against']}{' on ' + v['task'] if tasks else ''} {v['needed']}"
        for v in known
    ]
    return (
        f"Seeds of each arm that would decide a difference as large as the one seen: "
        f"{', '.join(parts)}. These are rough orders of magnitude ({POWER:.0%} power)."
        if parts
        else ""
    )


def _family(number: int, what: str) -> str:
    """`4 arms`; empty where a test is alone and nothing is corrected."""
    return f"{number} {what}" if number > 1 else ""


def _finding(cell: Cell, base: Cell, comparison: Comparison, family: str) -> str:
    """The verdict as a sentence, with what it rests on."""
    kind, (chance, low, high) = comparison.kind, comparison.improvement
    n, m = (len(c.scores()) for c in (cell, base))
    if kind == "underpowered" or chance is None or low is None or high is None:
        return _underpowered(cell, base, comparison)
    if kind == "too many failed":
        return _no_verdict(cell, base)
    said = f"{kind} than" if kind != "no evidence" else "not decided against"
    correction = f" after Holm's correction for {family}" if family else ""
    shown = [_shown(x, 2, 0.5) for x in (chance, low, high)]
    p = "< 0.001" if comparison.p < 0.001 else f"= {_shown(comparison.p, 3, ALPHA)}"
    return (
        f"{cell.label}: {said} {base.label} on {cell.task} (probability of improvement {shown[0]} "
        f"[{shown[1]}, {shown[2]}], exact p {p}{correction}, {n} against {m} seeds)."
    )


def _no_verdict(cell: Cell, base: Cell) -> str:
    parts = ", ".join(
        f"{c.failed} of {c.failed + len(c.complete)} of {c.label}"
        for c in (cell, base)
        if c.too_many_failed
    )
    return (
        f"{cell.label}: no verdict against {base.label} on {cell.task}: too many seeds failed "
        f"({parts}; at most {MAX_FAILED:.0%} may fail)."
    )


def _underpowered(cell: Cell, base: Cell, comparison: Comparison) -> str:
    n, m = (len(c.scores()) for c in (cell, base))
    return (
        f"{cell.label}: too few seeds to decide against {base.label} on {cell.task}: {n} and {m} "
        f"seeds have ended; at least {comparison.least} of each are needed."
    )


def _limits(cell: Cell, base: Cell, comparison: Comparison, tasks: int) -> list[str]:
    """What a reader could otherwise take the verdict for."""
    kind, (chance, low, high) = comparison.kind, comparison.improvement
    if kind in ("underpowered", "too many failed") or chance is None or low is None or high is None:
        return []
    if kind == "no evidence":
        said = []
        if not low <= 0.5 <= high:
            said.append("The interval leaves out 0.5, but the test, which decides, does not.")
        elif comparison.p < ALPHA:
            said.append("The test rejects, but the interval, which has to agree, holds 0.5.")
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
        ("failed", "Failed seeds count as the worst outcome: {}."),
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


def _settings(arm: str) -> dict[str, Any]:
    """The settings of an arm; none if this version does not know it."""
    try:
        return arm_settings(arm)
    except BadInput:
        return {}


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
