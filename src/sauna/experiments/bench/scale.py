"""How the rate changes with members, environments, width and processes: one at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

from sauna.config.presets import resolve
from sauna.experiments.bench.rates import WARM_UP, training_rate

ENOUGH = 100_000  # env steps that a point is measured over, at least
AXES: dict[str, tuple[int, ...]] = {
    "members": (1, 2, 4, 8, 16, 32, 64),
    "envs": (1, 2, 4, 8, 16, 32),
    "width": (32, 64, 128, 256),
    "processes": (1, 2, 4, 8, 16, 32, 64),
}
LABELS = {
    "members": "members in one process",
    "envs": "environments of one member, in one process",
    "width": "width of both hidden layers, 3 members in one process",
    "processes": "processes, 3 members in each",
}


def settings_at(axis: str, value: int) -> dict[str, Any]:
    """Returns what a point changes in the settings; the batch of one update stays the same."""
    if axis == "members":
        return {"seeds": value, "processes": 1}
    if axis == "envs":
        return {"seeds": 1, "processes": 1, "envs": value, "rollout_steps": 2048 // value}
    if axis == "width":
        return {"seeds": 3, "processes": 1, "hidden": [value, value]}
    return {"seeds": 3 * value, "processes": value}


def scale(
    overrides: Mapping[str, Any], rounds: int, say: Callable[[str], None]
) -> dict[str, list[dict[str, Any]]]:
    """Returns env steps per second at every point of each axis, all of them once per round.

    Returns:
      `{axis: [{"value", "rate", "rates"}, ...]}`: the median of the rounds, and each of them.
    """
    cores = os.cpu_count() or 1
    points = {
        axis: [value for value in values if axis != "processes" or value <= cores]
        for axis, values in AXES.items()
    }
    rates: dict[tuple[str, int], list[float]] = {}
    for number in range(rounds):
        for axis, values in points.items():
            for value in values:
                rate = _rate({**overrides, **settings_at(axis, value)})
                rates.setdefault((axis, value), []).append(rate)
                text = f"round {number + 1} of {rounds}: {value} {LABELS[axis]}"
                say(f"{text}: {rate:,.0f} env steps/s")
    return {
        axis: [
            {"value": value, "rate": median(rates[axis, value]), "rates": rates[axis, value]}
            for value in values
        ]
        for axis, values in points.items()
    }


def _rate(settings: Mapping[str, Any]) -> float:
    config = resolve(settings)
    batch = config.rollout_steps * config.envs
    iterations = WARM_UP + max(3, -(-ENOUGH // (batch * len(config.seeds))))
    if config.filter != "none" and config.dropped == "replace":
        iterations *= config.max_env_steps_factor  # one may take so many times the env steps
    return training_rate({**settings, "steps": batch * iterations})


def draw(found: Mapping[str, list[dict[str, Any]]], title: str, path: Path) -> None:
    """Draws one panel per axis."""
    from sauna.experiments.report.style import applied, save

    with applied():
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, len(found), figsize=(3.1 * len(found), 3), sharey=True)
        for axis, (name, points) in zip(axes, found.items(), strict=True):
            values = [point["value"] for point in points]
            axis.plot(values, [point["rate"] / 1000 for point in points], "-", color="#0072B2")
            for point in points:
                each = [rate / 1000 for rate in point["rates"]]
                axis.plot([point["value"]] * len(each), each, "o", color="#0072B2", markersize=3)
            axis.set_xscale("log", base=2)
            axis.set_xticks(values, [str(value) for value in values])
            axis.minorticks_off()
            axis.set_xlabel(LABELS[name].replace(", ", ",\n"))
        highest = max(max(point["rates"]) for points in found.values() for point in points)
        axes[0].set_ylim(0, 1.05 * highest / 1000)  # of all panels: they share the axis
        axes[0].set_ylabel("1000 env steps/s, in sum")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.tight_layout()
        save(figure, path)
