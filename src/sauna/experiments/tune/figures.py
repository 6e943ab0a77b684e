"""The figures of a tuning's page, as SVG: curves, parallel coordinates, importance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sauna.experiments.report import style
from sauna.experiments.tune.space import Range, read_space, shown

BEST, OTHER, PRUNED = "#D55E00", "#0072B2", "#999999"
MAP = "cividis"  # which the colour-blind can read
TICKS = 5  # labels of an axis that has a range


def curves(found: Mapping[str, Any]) -> bytes | None:
    """Draws the score of each trial over its budget; the best one is on top."""
    trials = [trial for trial in found["trials"] if trial["curve"]]
    if not trials:
        return None
    best = found["best"]["number"] if found["best"] else None
    steps = found["steps"]
    figure = _figure(7, 4)
    with style.applied():
        axes = figure.subplots()
        for trial in sorted(trials, key=lambda trial: trial["number"] == best):
            x, y = zip(*trial["curve"], strict=True)
            is_best, ended = trial["number"] == best, trial["state"] != "pruned"
            colour = BEST if is_best else OTHER if ended else PRUNED
            width, alpha = (2.2, 1.0) if is_best else (0.9, 0.6)
            axes.plot(np.array(x) * steps, y, color=colour, linewidth=width, alpha=alpha)
            if not ended:
                axes.plot(x[-1] * steps, y[-1], "x", color=colour, markersize=4)
        style.count_steps(axes)
        axes.set_ylabel("return")
        return style.as_svg(figure)


def coordinates(found: Mapping[str, Any]) -> bytes | None:
    """Draws each trial as a line over the settings that were searched, coloured by its return."""
    trials = [trial for trial in found["trials"] if trial["return"] is not None]
    space = read_space(found["tune"]["values"])
    if len(trials) < 2:
        return None
    import matplotlib

    scores = np.array([trial["return"] for trial in trials])
    low, high = scores.min(), scores.max()
    spread = (high - low) or 1.0
    figure = _figure(1.0 + 1.05 * (len(space) + 1), 4.4)
    with style.applied():
        axes = figure.subplots()
        axes.grid(False)
        axes.set_yticks([])
        for side in ("left", "bottom"):
            axes.spines[side].set_visible(False)
        names = [*space, "return"]
        for place, name in enumerate(names):
            axes.axvline(place, color="#C9CCD0", linewidth=0.8, zorder=0)
            ends = [(0.0, f"{low:.4g}"), (1.0, f"{high:.4g}")]
            for height, text in _marks(space[name]) if name in space else ends:
                axes.text(place + 0.04, height, text, fontsize=7, va="center")
        for index in np.argsort(scores, kind="stable").tolist():
            trial = trials[index]
            heights = [_height(space[n], trial["searched"].get(n)) for n in space]
            share = (scores[index] - low) / spread
            colour = matplotlib.colormaps[MAP](share)
            axes.plot(range(len(names)), [*heights, share], color=colour, linewidth=1.2, alpha=0.8)
        axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
        axes.set_xlim(-0.1, len(names) - 0.5)
        return style.as_svg(figure)


def importance(found: Mapping[str, Any]) -> bytes | None:
    """Draws the share of each setting in what makes a trial good, the largest on top."""
    shares = found["importance"]
    if not shares:
        return None
    names = sorted(shares, key=lambda name: shares[name])
    figure = _figure(7, 1.2 + 0.28 * len(names))
    with style.applied():
        axes = figure.subplots()
        axes.barh(names, [shares[name] for name in names], color=OTHER)
        axes.set_xlabel("importance")
        axes.grid(axis="y", visible=False)
        return style.as_svg(figure)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="tight")


def _height(one: Range, value: Any) -> float:
    """Where a value lies on its axis, from 0 to 1; NaN if there is none."""
    if value is None:
        return math.nan
    if one.choices:
        return one.choices.index(value) / max(len(one.choices) - 1, 1)
    ends = one.low, one.high, value
    low, high, at = map(math.log, ends) if one.log else ends
    return (at - low) / (high - low)


def _marks(one: Range) -> Sequence[tuple[float, str]]:
    """The labels of an axis, and their heights."""
    if one.choices:
        return [(_height(one, choice), shown(choice)) for choice in one.choices]
    heights = np.linspace(0, 1, TICKS).tolist()
    if one.log:
        return [(h, f"{one.low ** (1 - h) * one.high**h:.2g}") for h in heights]
    return [(h, f"{one.low + h * (one.high - one.low):.2g}") for h in heights]
