"""The measurement `coverage`: does the threshold trade exploration for exploitation?

Three things are compared with the threshold in a sweep of it: the policy's entropy (mean over
training), its state coverage (mean over the checkpoints) and the final return, each one number per
member. Whether one of them follows a constant threshold is tested by rank correlation over members;
its p value is that of permuting the members' thresholds, corrected by Holm's method for the three
quantities of a task. A filter that drops more also updates less often in the same env steps: a
matched random control, which drops as much, shows how much of an effect that is. Members of one
seed begin alike, so these are compared pair by pair, by Student's t.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from sauna.config.presets import RANDOM_CONTROL
from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.experiments.measure.measurement import Measurement
from sauna.experiments.measure.noise_report import shown
from sauna.experiments.report import style
from sauna.experiments.report.figures import Line, Panel, Plot, Section
from sauna.experiments.statistics import ALPHA, SEED, Estimate, holm, mean_interval
from sauna.system.errors import BadInput

TITLE = "Does the threshold trade exploration for exploitation?"
PERMUTATIONS = 10_000
# key of a member's number, what it is called, title, caption
QUANTITIES = (
    ("keep_rate", "keep rate", "Keep rate", "Share of all env steps that updates learned from."),
    ("entropy", "entropy", "Policy entropy", "In nats, mean over training."),
    (
        "coverage",
        "coverage",
        "State coverage",
        "Entropy of the visited observations in nats, by "
        "nearest neighbours, in one scale for all arms; mean over the checkpoints.",
    ),
    ("final_return", "return", "Final return", "Training return, mean of the last 100 episodes."),
)
ASKED = ("entropy", "coverage", "final_return")
ABOUT = (
    "Against the threshold: keep rate, entropy of the policy, coverage of states, return. Of arms "
    "whose threshold moves its median over training is shown. Rank correlations are over members "
    "of arms with a constant threshold, p by permuting their thresholds, after Holm's correction "
    "for the three quantities of a task. Fewer kept steps are also fewer updates in the "
    "same env steps: matched random controls show what that alone does. Differences from a "
    "control are means over pairs of members of the same seed; in brackets 95%, not "
    "corrected for their number."
)
LOOKS = {
    "constant": "sauna",
    "scheduled": "vex-head",
    "target keep rate": "ppo",
    "matched random control": "random-drop",
}


class Mark(NamedTuple):
    """One arm on one task: its threshold, and its members' numbers."""

    kind: str  # of `LOOKS`
    label: str
    threshold: float  # of a control, that of the arm whose control it is
    seeds: int  # that the arm has, trained and measured or not
    members: dict[str, list[tuple[int, float]]]  # quantity -> (seed, value)
    drops_like: str | None = None  # of a control, the arm whose control it is


def report(measured: Mapping[str, Any], folder: Path | None = None) -> Section:
    """Reports on all results in a section of the study's page; `folder` is not read."""
    return Section(
        TITLE,
        verdicts(measured),
        ABOUT,
        text_table(measured),
        "Threshold, exploration and return",
        plots(measured),
        looks(),
        answer=" ".join(
            _verdict(task, found).split(" With a ")[0]
            for task in tasks_of(measured)
            if (found := marks(measured, task))
        ),
    )


def check(configs: Sequence[Config]) -> None:
    """Refuses arms without a threshold or without a normaliser of observations.

    Raises:
      BadInput
    """
    for config in configs:
        if config.filter != "sauna":
            raise BadInput(
                'study: measure = "coverage" is of arms that have a threshold, and of their '
                f"controls, not of {', '.join(config.arm)}"
            )
        if not config.normalize_observations:
            raise BadInput("normalize_observations: coverage takes its scale from the normaliser")


def check_spaces(config: Config, spaces: Spaces) -> None:
    """Refuses an environment whose observations have no normaliser.

    Raises:
      BadInput
    """
    if not config.normalize_observations:
        raise BadInput(
            "measure: coverage takes its scale from the normaliser of observations, which "
            f"{config.env} does not have"
        )


def looks() -> dict[str, style.Look]:
    return dict(zip(LOOKS, style.looks({a: a for a in LOOKS.values()}).values(), strict=True))


def marks(measured: Mapping[str, Any], task: str) -> list[Mark]:
    """Returns every arm of a task whose threshold is known, in the order of the study.

    Of members that are measured: all of an arm's numbers are of the same ones.
    """
    cells = [cell for cell in measured["cells"] if cell["task"] == task]
    arms = {_settings(cell): cell["label"] for cell in cells}
    thresholds = {cell["label"]: _threshold(cell) for cell in cells}
    found = []
    for cell in cells:
        numbers = {
            key: [
                (m["seed"], float(value))
                for m in cell["members"]
                if m["points"] and (value := _number(m, key)) is not None
            ]
            for key, *_ in QUANTITIES
        }
        kind, drops_like = _kind(cell), None
        if kind == "matched random control":
            arm = cell["arm"].removesuffix(RANDOM_CONTROL)
            drops_like = cell.get("rates_of") or arms.get((arm, *_settings(cell)[1:]))
        threshold = thresholds.get(drops_like or cell["label"])
        if threshold is not None:
            found.append(Mark(kind, cell["label"], threshold, cell["seeds"], numbers, drops_like))
    return found


def _settings(cell: Mapping[str, Any]) -> tuple[Any, ...]:
    """The arm and the settings that tell a study's arms apart."""
    return (cell["arm"], *(cell["config"][name] for name in sorted(cell["config"])))


def _threshold(cell: Mapping[str, Any]) -> float | None:
    """An arm's own: where it moves, the mean over members of its median over training."""
    if (
        cell["config"]["threshold_schedule"] == "constant"
        and not cell["config"]["keep_rate_target"]
    ):
        return float(cell["config"]["threshold"])
    moved = [m["threshold"] for m in cell["members"] if m.get("threshold") is not None]
    return float(np.mean(moved)) if moved else None


def _kind(cell: Mapping[str, Any]) -> str:
    config = cell["config"]
    if cell["arm"] == "random-drop" or cell["arm"].endswith(RANDOM_CONTROL):
        return "matched random control"
    if config["keep_rate_target"]:
        return "target keep rate"
    return "constant" if config["threshold_schedule"] == "constant" else "scheduled"


def _number(member: Mapping[str, Any], key: str) -> float | None:
    if key == "coverage":
        values = [point["coverage"] for point in member["points"]]
        return float(np.mean(values)) if values else None
    return member.get(key)


def tasks_of(measured: Mapping[str, Any]) -> list[str]:
    return list(dict.fromkeys(cell["task"] for cell in measured["cells"]))


def over_members(mark: Mark, key: str) -> Estimate:
    """Computes the mean over members, and Student's t interval."""
    values = np.array([value for _, value in mark.members[key]])
    if len(values) < 2:
        return Estimate(float(values[0]) if len(values) else None, None, None)
    return Estimate(*(float(x[0]) for x in mean_interval(values[:, None])))


def text_table(measured: Mapping[str, Any]) -> list[list[str]]:
    """Returns the head, and a row for each task and arm."""
    names = [title for _, _, title, _ in QUANTITIES]
    rows = [["Task", "Arm", "Members", "Threshold", *names]]
    for task in tasks_of(measured):
        for mark in marks(measured, task):
            number = f"{len(mark.members['coverage'])} of {mark.seeds}"
            values = [shown(over_members(mark, key)) for key, *_ in QUANTITIES]
            rows.append([task, mark.label, number, f"{mark.threshold:.3g}", *values])
    return rows


def correlation(found: Sequence[Mark], key: str) -> tuple[float, float, int] | None:
    """Computes the rank correlation with a constant threshold, its p value, and the number of
    members.

    None where there are fewer than three thresholds. What is the same for all follows nothing.
    """
    pairs = [
        (m.threshold, value) for m in found if m.kind == "constant" for _, value in m.members[key]
    ]
    if len({threshold for threshold, _ in pairs}) < 3:
        return None
    if len({value for _, value in pairs}) < 2:
        return 0.0, 1.0, len(pairs)
    x, y = (scipy.stats.rankdata(column) for column in zip(*pairs, strict=True))
    x, y = x - x.mean(), y - y.mean()
    rho = float(x @ y / np.sqrt((x @ x) * (y @ y)))
    random = np.random.default_rng(SEED)
    permuted = np.abs(random.permuted(np.tile(x, (PERMUTATIONS, 1)), axis=1) @ y)
    p = (1 + int((permuted >= abs(x @ y) * (1 - 1e-12)).sum())) / (1 + PERMUTATIONS)
    return rho, p, len(pairs)


def verdicts(measured: Mapping[str, Any]) -> list[str]:
    """Answers for each task in sentences that claim no more than their tests."""
    return [
        said
        for task in tasks_of(measured)
        if (found := marks(measured, task))
        for said in (_verdict(task, found), *_beside_controls(task, found))
    ]


def beside_control(arm: Mark, control: Mark, key: str) -> Estimate:
    """Estimates the mean of arm minus control over the seeds that both have, and its interval."""
    own, other = dict(arm.members[key]), dict(control.members[key])
    pairs = [(seed, own[seed] - other[seed]) for seed in own if seed in other]
    return over_members(arm._replace(members={key: pairs}), key)


def _beside_controls(task: str, found: Sequence[Mark]) -> Iterator[str]:
    """Compares each arm with its matched random control: a sentence for each control."""
    arms = {mark.label: mark for mark in found}
    for control in found:
        if control.drops_like not in arms:
            continue
        pairs = len(
            {seed for seed, _ in arms[control.drops_like].members["coverage"]}
            & {seed for seed, _ in control.members["coverage"]}
        )
        if pairs < 2:
            yield (
                f"{task}: threshold {control.drops_like} and its matched random control have too "
                f"few pairs yet."
            )
            continue
        said, apart = [], []
        for key, name, *_ in QUANTITIES:
            if key in ASKED:
                value, low, high = beside_control(arms[control.drops_like], control, key)
                said.append(f"{name} {shown(Estimate(value, low, high))}")
                if low is not None and high is not None and not low <= 0 <= high:
                    apart.append(name)
        kind = f"differ in {' and '.join(apart)}" if apart else "show no difference"
        yield (
            f"{task}: threshold {control.drops_like} and its matched random control {kind} "
            f"(threshold minus control: {', '.join(said)}; {pairs} pairs)."
        )


def _verdict(task: str, found: Sequence[Mark]) -> str:
    results = {key: correlation(found, key) for key in ASKED}
    known = {key: result for key, result in results.items() if result is not None}
    if set(known) != set(ASKED):
        return f"{task}: no answer yet; too few members of different thresholds are measured."
    corrected = dict(zip(ASKED, holm([known[key][1] for key in ASKED]), strict=True))
    follows = {key: np.sign(known[key][0]) if corrected[key] < ALPHA else 0 for key in ASKED}
    said = []
    for key, name, *_ in QUANTITIES:
        if key in known:
            word = {1: "rises", -1: "falls", 0: "does not follow"}[int(follows[key])]
            p = "< 0.001" if corrected[key] < 0.001 else f"= {corrected[key]:.3f}"
            said.append(f"{name} {word} (rank correlation {known[key][0]:.2f}, p {p})")
    explores = {follows["entropy"], follows["coverage"]}
    if explores in ({1}, {-1}):
        answer = "the threshold moves exploration"
        if follows["final_return"] == -follows["entropy"]:
            answer += " against return: it trades one for the other"
        elif follows["final_return"]:
            answer += " and return the same way"
        else:
            answer += ", with no evidence that return follows"
    else:
        answer = (
            "no evidence that the threshold moves exploration: entropy and coverage do not both "
            "follow it one way"
        )
    if explores in ({1}, {-1}) and any(mark.drops_like for mark in found):
        answer += " (the matched random controls show what fewer updates alone do)"
    number, wanted = known["coverage"][2], sum(m.seeds for m in found if m.kind == "constant")
    so_far = "" if number == wanted else f" of {wanted} so far"
    return f"{task}: {answer}. With a rising threshold {'; '.join(said)}; {number} members{so_far}."


def plots(measured: Mapping[str, Any]) -> list[Plot]:
    """Returns each quantity against the threshold, a panel for each task."""
    found = {task: marks(measured, task) for task in tasks_of(measured)}
    drawn = []
    for key, name, title, caption in QUANTITIES:
        panels = [Panel(task, _lines(own, key)) for task, own in found.items()]
        limits = (0.0, 1.0) if key == "keep_rate" else None
        text = f"{caption} Point: mean of the members; band: 95% interval."
        plot = Plot(f"sweep_{key}", title, text, "threshold", name, limits, panels)
        if any(panel.lines for panel in panels):
            drawn.append(plot)
    return drawn


def _lines(found: Sequence[Mark], key: str) -> list[Line]:
    """A line for each kind of arm, its arms in the order of their thresholds."""
    lines = []
    for kind in LOOKS:
        own = sorted(
            (m for m in found if m.kind == kind and m.members[key]), key=lambda m: m.threshold
        )
        if not own:
            continue
        x: list[float | None] = [mark.threshold for mark in own]
        y, low, high = map(list, zip(*(over_members(mark, key) for mark in own), strict=True))
        seeds = sorted({seed for mark in own for seed, _ in mark.members[key]})
        each = [(seed, x, [dict(mark.members[key]).get(seed) for mark in own]) for seed in seeds]
        lines.append(Line(kind, x, y, low, high, each))
    return lines


MEASUREMENT = Measurement(
    "coverage",
    "sauna.experiments.measure.coverage:compute",
    report,
    check=check,
    check_spaces=check_spaces,
    scaled=True,
)
