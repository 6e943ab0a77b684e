"""The measurement `noise`: is what the filter drops noisier than random steps?

Noise has two measures here. Signal to noise is with advantages as in training. Variance is with
advantages as they are: to standardise those of a minibatch of dropped steps would divide out what
makes them noisy, and training never has such a minibatch.

Every number is of one member first: the mean over its checkpoints (of ratios of variances the
geometric mean). Intervals are Student's t over members, because checkpoints and minibatches of one
training are not independent of each other. The bootstrap intervals of single checkpoints are in the
result file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.settings import Config
from sauna.envs.spaces import Spaces
from sauna.experiments.measure.measurement import Measurement
from sauna.experiments.report import style
from sauna.experiments.report.figures import Line, Panel, Plot, Section
from sauna.experiments.report.numbers import interval
from sauna.experiments.statistics import Estimate, mean_interval
from sauna.system.errors import BadInput

GROUPS = ("kept", "dropped", "control", "shifted")
# Words in results of 0.1.0.
FORMER_KEYS = {
    "control": "coin",
    "dropped - control": "dropped - coin",
    "kept - control": "kept - coin",
}
TITLE = "Is what the filter drops noisier than random steps?"
NOISIER, LESS_NOISY = "is noisier than", "is less noisy than"
ABOUT = (
    "At checkpoints along training, with policy, head and normaliser as in the checkpoint: the "
    "policy gradient of minibatches of kept steps, of dropped ones, of steps that a matched random "
    "control kept (as many, at random), and of steps dropped by the filter's decisions moved in "
    "time (shifted: as many, and as bunched). "
    "Signal to noise is the squared length of a group's mean gradient over the trace of its "
    "covariance, for one minibatch; variance is that trace, in the table one group's over "
    "another's. Advantages are standardised in each minibatch as in training, except where raw is "
    "said: of steps with large advantages both signal and variance are large then, and the one can "
    "rise without the other. Cosine is that of a minibatch's gradient and of a large independent "
    "batch of all steps. Alignment is the cosine with endless minibatches: below 1 if the "
    "group's gradient is biased, not only noisy; it is known only at checkpoints whose signal "
    "differs from none (their number follows it), and its estimates go above 1. In "
    "brackets: 95% over members, each the mean of its checkpoints; not corrected for the number of "
    "comparisons."
)
# key in the figures, title, caption, y axis, its limits
_PLOTS: tuple[tuple[str, str, str, str, tuple[float, float] | None], ...] = (
    (
        "snr",
        "Signal to noise of a minibatch",
        "Squared length of the group's mean gradient over the trace of its covariance.",
        "signal to noise",
        None,
    ),
    (
        "cosine",
        "Cosine to the gradient of a large batch",
        "Mean cosine of a minibatch's gradient "
        "and that of all steps of an independent large batch.",
        "cosine",
        (-1.0, 1.0),
    ),
    (
        "variance",
        "Variance of a minibatch's gradient, control = 1",
        "Trace of the group's covariance over that of what the matched random control keeps, "
        "advantages raw; means are geometric.",
        "variance, control = 1",
        None,
    ),
)
HEAD = (
    "Task",
    "Arm",
    "Members",
    "Keep rate",
    "SNR kept",
    "SNR control",
    "SNR dropped",
    "SNR dropped - control",
    "SNR dropped - shifted",
    "SNR per env step, kept - control",
    "Cosine dropped - control",
    "Alignment of kept, checkpoints",
    "Variance, kept / control",
    "Raw variance, kept / control",
    "Raw variance, dropped / control",
    "Raw variance, dropped / shifted",
)


def report(measured: Mapping[str, Any], folder: Path | None = None) -> Section:
    """Reports on all results in a section of the study's page; `folder` is not read."""
    return Section(
        TITLE,
        verdicts(measured),
        ABOUT,
        text_table(measured),
        "Noise of minibatch gradients",
        plots(measured),
        looks(),
        answer=_answer(measured),
    )


def check(configs: Sequence[Config]) -> None:
    """Refuses a study in which no arm drops steps whose advantages are known.

    Raises:
      BadInput
    """
    if not any(map(drops_steps, configs)):
        raise BadInput('study: measure = "noise" needs an arm that filters, with gae_over=all')
    if any(config.recurrent != "none" for config in configs):
        raise BadInput("recurrent: measure = noise draws single steps, which have no past")


def drops_steps(config: Config) -> bool:
    """Returns whether steps are dropped, and the advantages of dropped ones are known."""
    return config.filter != "none" and config.gae_over != "kept"


def check_spaces(config: Config, spaces: Spaces) -> None:
    """Refuses observations that are too large to keep.

    Raises:
      BadInput
    """
    if spaces.picture_shapes:
        raise BadInput(
            "measure: noise keeps rollouts of observations in memory, which images are too large "
            "for"
        )


def looks() -> dict[str, style.Look]:
    """Returns a colour for each group of steps."""
    arms = {"kept": "sauna", "dropped": "vex-head", "control": "random-drop", "shifted": "ppo"}
    return dict(zip(arms, style.looks({arm: arm for arm in arms.values()}).values(), strict=True))


def rule(point: Mapping[str, Any], raw: bool = False) -> Mapping[str, Any] | None:
    """Returns a checkpoint's estimates, advantages as in training or `raw`.

    None where too little was dropped.
    """
    return point["rules"].get("raw" if raw else point["as_trained"])


def over_members(cell: Mapping[str, Any], *path: str, raw: bool = False) -> Estimate:
    """Computes the mean over members of their means over checkpoints, and its interval; geometric
    of ratios.

    Args:
      path: of the value in a checkpoint's estimates.
    """
    ratio = path[-1] == "variance_ratio"
    means: list[float] = []
    for member in cell["members"]:
        found = (_value(point, path, raw) for point in member["points"])
        values = [value for value in found if value is not None]
        if values:
            means.append(_mean(values, geometric=ratio)[0])
    if not means:
        return Estimate(None, None, None)
    mean, low, high = _mean(means, geometric=ratio)
    return Estimate(mean, None, None) if len(means) < 2 else Estimate(mean, low, high)


def _value(point: Mapping[str, Any], path: Sequence[str], raw: bool = False) -> float | None:
    found: Any = rule(point, raw)
    for key in path:
        if found is not None:
            found = found[key] if key in found else found[FORMER_KEYS[key]]
    return None if found is None else found[0]


def text_table(measured: Mapping[str, Any]) -> list[list[str]]:
    """Returns the head, and a row for each task and arm."""
    rows = [list(HEAD)]
    for cell in measured["cells"]:
        rates = [point["keep_rate"] for point in _points(cell)]
        used = sum(any(rule(p) for p in m["points"]) for m in cell["members"])
        values = [
            *(over_members(cell, "groups", name, "snr") for name in ("kept", "control", "dropped")),
            over_members(cell, "differences", "dropped - control", "snr"),
            over_members(cell, "differences", "dropped - shifted", "snr"),
            over_members(cell, "differences", "kept - control", "snr_per_env_step"),
            over_members(cell, "differences", "dropped - control", "cosine"),
        ]
        ratios = [
            _ratio(cell, "kept - control"),
            *(
                _ratio(cell, pair, raw=True)
                for pair in ("kept - control", "dropped - control", "dropped - shifted")
            ),
        ]
        rate = f"{np.mean(rates):.2f}" if rates else "-"
        rows.append(
            [
                cell["task"],
                cell["label"],
                f"{used} of {cell['seeds']}",
                rate,
                *map(shown, values),
                _alignment(cell),
                *map(shown_ratio, ratios),
            ]
        )
    return rows


def _ratio(cell: Mapping[str, Any], pair: str, raw: bool = False) -> Estimate:
    return over_members(cell, "differences", pair, "variance_ratio", raw=raw)


def _alignment(cell: Mapping[str, Any]) -> str:
    """That of the kept, and at how many of the measured checkpoints it is known."""
    path = ("groups", "kept", "alignment")
    values = [_value(point, path) for point in _points(cell) if rule(point)]
    known = sum(value is not None for value in values)
    return f"{shown(over_members(cell, *path))}, {known} of {len(values)}"


def shown_ratio(estimate: Estimate) -> str:
    """Returns three decimals where it is about 1, else as `shown`."""
    near = estimate.high is not None and 0.5 < estimate.high < 2
    return interval(estimate, 3) if near else shown(estimate)


def shown(estimate: Estimate) -> str:
    """Returns two significant digits of the value, and its interval to the same place."""
    value, low, high = estimate
    if value is None:
        return "-"
    largest = max(abs(x) for x in estimate if x is not None)
    digits = max(0, 1 - int(np.floor(np.log10(largest)))) if largest else 0
    if low is None or high is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def verdicts(measured: Mapping[str, Any]) -> list[str]:
    """Answers for each task and arm in a sentence that claims no more than its interval."""
    return [_verdict(cell) for cell in measured["cells"]]


def _answer(measured: Mapping[str, Any]) -> str:
    """Counts the arms and tasks by what is found of them; empty before anything is."""
    cells = [cell for cell in measured["cells"] if any(map(rule, _points(cell)))]
    if not cells:
        return ""
    by_variance = [_kind(_ratio(c, "dropped - control", raw=True), 1.0, noisier=1) for c in cells]
    by_signal = [
        _kind(over_members(c, "differences", "dropped - control", "snr"), 0.0, noisier=-1)
        for c in cells
    ]
    said = [
        f"by {name} noisier in {kinds.count(NOISIER)}, less noisy in {kinds.count(LESS_NOISY)} of "
        f"{len(cells)} pairs of a task and an arm"
        for name, kinds in (("variance", by_variance), ("signal to noise", by_signal))
    ]
    return f"What the filter drops is {said[0]}, {said[1]}."


def _verdict(cell: Mapping[str, Any]) -> str:
    points = [*_points(cell)]
    measured = [point for point in points if rule(point)]
    where = f"{cell['task']}, {cell['label']}"
    if not points:
        return f"{where}: not measured yet."
    if not measured:
        return (
            f"{where}: no answer, because the filter dropped too few steps at each of "
            f"{len(points)} checkpoints."
        )
    difference = over_members(cell, "differences", "dropped - control", "snr")
    dropped, control = (
        over_members(cell, "groups", name, "snr") for name in ("dropped", "control")
    )
    ratio, kept = _ratio(cell, "dropped - control", raw=True), _ratio(cell, "kept - control")
    means = [shown(Estimate(found.value, None, None)) for found in (dropped, control)]
    text = (
        f"{where}: by variance what the filter drops {_kind(ratio, 1.0, noisier=1)} what a matched "
        f"random control drops ({shown_ratio(ratio)} times the control's, advantages raw); by "
        f"signal to noise it {_kind(difference, 0.0, noisier=-1)} that ({means[0]} against "
        f"{means[1]} per minibatch "
        f"of {measured[0]['minibatch']}, difference {shown(difference)}). As trained, minibatches "
        f"of what it keeps have {shown_ratio(kept)} times the variance of the control's."
    )
    if len(measured) < len(points):
        text += (
            f" At {len(points) - len(measured)} of {len(points)} checkpoints it dropped too few."
        )
    number = sum(bool(member["points"]) for member in cell["members"])
    return text if number == cell["seeds"] else f"{text} {number} of {cell['seeds']} seeds so far."


def _kind(estimate: Estimate, equal: float, noisier: int) -> str:
    """Puts into words where the interval lies; `noisier` is the side of `equal` that means it."""
    if estimate.low is None or estimate.high is None:
        return "is underpowered to be compared with"
    if estimate.low <= equal <= estimate.high:
        return "shows no difference from"
    return NOISIER if (estimate.low > equal) == (noisier > 0) else LESS_NOISY


def plots(measured: Mapping[str, Any]) -> list[Plot]:
    """Returns each group along training, a panel for each task and arm."""
    cells = [cell for cell in measured["cells"] if any(map(rule, _points(cell)))]
    found = []
    for key, title, caption, label, limits in _PLOTS:
        panels = [
            Panel(f"{cell['task']}, {cell['label']}", [_line(cell, g, key) for g in GROUPS])
            for cell in cells
        ]
        text = f"{caption} Line: mean of the members; band: 95% interval."
        found.append(Plot(f"noise_{key}", title, text, "env steps", label, limits, panels))
    return found if cells else []


def _points(cell: Mapping[str, Any]) -> Iterable[Mapping[str, Any]]:
    return (point for member in cell["members"] for point in member["points"])


def _line(cell: Mapping[str, Any], group: str, key: str) -> Line:
    """One group's line through the points along training."""
    seeds = []
    at: dict[float, list[float]] = {}
    for member in cell["members"]:
        values = {point["point"]: _drawn(point, group, key) for point in member["points"]}
        seeds.append((member["seed"], [x * cell["steps"] for x in values], [*values.values()]))
        for x, value in values.items():
            if value is not None:
                at.setdefault(x, []).append(value)
    x = sorted(at)
    lines = [_mean(at[point], geometric=key == "variance") for point in x]
    y, low, high = (
        [None if np.isnan(value) else value for value in column]
        for column in zip(*lines, strict=True)
    )
    return Line(group, [point * cell["steps"] for point in x], y, low, high, seeds)


def _drawn(point: Mapping[str, Any], group: str, key: str) -> float | None:
    """What a figure shows of a group at a checkpoint; its variance is over the control's."""
    if key != "variance":
        return _value(point, ("groups", group, key))
    own, control = (_value(point, ("groups", name, key), raw=True) for name in (group, "control"))
    return None if own is None or control is None else own / control


def _mean(values: Sequence[float], geometric: bool) -> list[float]:
    """The mean and its interval, NaN where there is none."""
    x = np.log(values) if geometric else np.asarray(values)
    ends = [float(end[0]) for end in mean_interval(x[:, None])]
    return [float(np.exp(end)) for end in ends] if geometric else ends


MEASUREMENT = Measurement(
    "noise",
    "sauna.experiments.measure.noise:compute",
    report,
    check=check,
    check_spaces=check_spaces,
    applies=drops_steps,
)
