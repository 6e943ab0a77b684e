"""Is what the filter drops noisier than what a coin drops? What `sauna study noise` says of it.

Every number is of one member first: the mean over its checkpoints. Intervals are Student's t over
members, because checkpoints and minibatches of one training are not independent of each other. The
bootstrap intervals of single checkpoints are in the result file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from sauna import style
from sauna.study.figures import Extra, Line, Panel, Plot
from sauna.study.numbers import interval
from sauna.study.statistics import Estimate, mean_interval
from sauna.study.tables import table

GROUPS = ("kept", "dropped", "coin", "shifted")
TITLE = "Is what the filter drops noisier than what a coin drops?"
ABOUT = (
    "At checkpoints along training, with policy, head and normaliser as they stood: the "
    "policy gradient of minibatches of kept steps, of dropped ones, of steps that a coin kept, and "
    "of steps dropped by the filter's decisions moved in time (shifted: as many, and as bunched). "
    "Signal to noise is the squared length of a group's mean gradient over the trace of its "
    "covariance, for one minibatch; variance is that trace, in the table one group's over "
    "another's. Cosine is that of a minibatch's gradient and of a large independent batch of all "
    "steps. Alignment is the cosine with endless minibatches: below 1 where the group's gradient "
    "is biased, not only noisy. In brackets: 95% over members, each the mean of its checkpoints; "
    "not corrected for the number of comparisons."
)
# key in the figures, title, caption, y axis, its limits
_PLOTS: tuple[tuple[str, str, str, str, tuple[float, float] | None], ...] = (
    ("snr", "Signal to noise of a minibatch", "Squared length of the group's mean gradient over "
     "the trace of its covariance.", "signal to noise", None),
    ("cosine", "Cosine to the gradient of a large batch", "Mean cosine of a minibatch's gradient "
     "and that of all steps of an independent large batch.", "cosine", (-1.0, 1.0)),
    ("variance", "Variance of a minibatch's gradient", "Trace of the group's covariance.",
     "variance", None),
)  # fmt: skip
HEAD = ("Task", "Arm", "Members", "Keep rate", "SNR kept", "SNR coin", "SNR dropped",
        "SNR dropped - coin", "SNR dropped - shifted", "SNR per env step, kept - coin",
        "Cosine dropped - coin", "Alignment of kept", "Variance, dropped / coin",
        "Variance, kept / coin")  # fmt: skip


def extra(measured: Mapping[str, Any]) -> Extra:
    """The section and the figures that the study's page gets."""
    head, *rows = text_table(measured)
    html = "".join(f"<p>{escape(text)}</p>" for text in [*verdicts(measured), ABOUT])
    html += table(head, [(escape(row[0]), [escape(x) for x in row[1:]]) for row in rows],
                  name="Noise of minibatch gradients")  # fmt: skip
    return Extra(TITLE, html, plots(measured), looks())


def looks() -> dict[str, style.Look]:
    """A colour for each group of steps."""
    arms = {"kept": "sauna", "dropped": "vex-head", "coin": "random-drop", "shifted": "ppo"}
    return dict(zip(arms, style.looks({arm: arm for arm in arms.values()}).values(), strict=True))


def rule(point: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """A checkpoint's estimates, advantages as in training; None where too little was dropped."""
    return point["rules"].get(point["as_trained"])


def over_members(cell: Mapping[str, Any], *path: str) -> Estimate:
    """Mean over members of their means over checkpoints, and its interval.

    Args:
      path: of the value in a checkpoint's estimates.
    """
    means = []
    for member in cell["members"]:
        values = [value for point in member["points"] if (value := _value(point, path)) is not None]
        if values:
            means.append(np.mean(values))
    if not means:
        return Estimate(None, None, None)
    mean, low, high = (float(x[0]) for x in mean_interval(np.array(means)[:, None]))
    return Estimate(mean, None, None) if len(means) < 2 else Estimate(mean, low, high)


def _value(point: Mapping[str, Any], path: Sequence[str]) -> float | None:
    found: Any = rule(point)
    for key in path:
        found = None if found is None else found[key]
    return None if found is None else found[0]


def text_table(measured: Mapping[str, Any]) -> list[list[str]]:
    """The head, and a row for each task and arm."""
    rows = [list(HEAD)]
    for cell in measured["cells"]:
        rates = [point["keep_rate"] for m in cell["members"] for point in m["points"]]
        used = sum(any(rule(p) for p in m["points"]) for m in cell["members"])
        values = [
            *(over_members(cell, "groups", name, "snr") for name in ("kept", "coin", "dropped")),
            over_members(cell, "differences", "dropped - coin", "snr"),
            over_members(cell, "differences", "dropped - shifted", "snr"),
            over_members(cell, "differences", "kept - coin", "snr_per_env_step"),
            over_members(cell, "differences", "dropped - coin", "cosine"),
            over_members(cell, "groups", "kept", "alignment"),
        ]
        ratios = [
            interval(over_members(cell, "differences", pair, "variance_ratio"), 3)
            for pair in ("dropped - coin", "kept - coin")
        ]
        rate = f"{np.mean(rates):.2f}" if rates else "-"
        rows.append([cell["task"], cell["label"], f"{used} of {len(cell['members'])}", rate,
                     *map(shown, values), *ratios])  # fmt: skip
    return rows


def shown(estimate: Estimate) -> str:
    """Two significant digits of the value, and its interval to the same place."""
    value, low, high = estimate
    if value is None:
        return "-"
    largest = max(abs(x) for x in estimate if x is not None)
    digits = max(0, 1 - int(np.floor(np.log10(largest)))) if largest else 0
    if low is None or high is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def verdicts(measured: Mapping[str, Any]) -> list[str]:
    """The answer for each task and arm, in a sentence that claims no more than its interval."""
    return [_verdict(cell) for cell in measured["cells"]]


def _verdict(cell: Mapping[str, Any]) -> str:
    points = [point for member in cell["members"] for point in member["points"]]
    measured = [point for point in points if rule(point)]
    where = f"{cell['task']}, {cell['label']}"
    if not measured:
        return (f"{where}: no answer, because the filter dropped too few steps at each of "
                f"{len(points)} checkpoints.")  # fmt: skip
    difference = over_members(cell, "differences", "dropped - coin", "snr")
    dropped, coin = (over_members(cell, "groups", name, "snr") for name in ("dropped", "coin"))
    if difference.low is None or difference.high is None:
        kind = "too few members to say whether what is dropped is noisier than what a coin drops"
    elif difference.high < 0:
        kind = "what the filter drops is noisier than what a coin drops"
    elif difference.low > 0:
        kind = "what the filter drops is less noisy than what a coin drops"
    else:
        kind = "no evidence that what the filter drops is noisier than what a coin drops"
    means = [shown(Estimate(found.value, None, None)) for found in (dropped, coin)]
    text = (
        f"{where}: {kind} (signal to noise {means[0]} against {means[1]} per minibatch of "
        f"{measured[0]['minibatch']}; difference {shown(difference)})."
    )
    if len(measured) < len(points):
        text += (
            f" At {len(points) - len(measured)} of {len(points)} checkpoints it dropped too few."
        )
    return text


def plots(measured: Mapping[str, Any]) -> list[Plot]:
    """Each group along training, a panel for each task and arm."""
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
        values = {p["point"]: _value(p, ("groups", group, key)) for p in member["points"]}
        seeds.append((member["seed"], [x * cell["steps"] for x in values], [*values.values()]))
        for point, value in values.items():
            if value is not None:
                at.setdefault(point, []).append(value)
    x = sorted(at)
    lines = [[float(v[0]) for v in mean_interval(np.array(at[point])[:, None])] for point in x]
    y, low, high = (
        [None if np.isnan(value) else value for value in column]
        for column in zip(*lines, strict=True)
    )
    return Line(group, [point * cell["steps"] for point in x], y, low, high, seeds)
