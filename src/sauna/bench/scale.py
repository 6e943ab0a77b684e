"""How the rate changes with members, environments, width and processes: one at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sauna.bench.rates import WARM_UP, training_rate
from sauna.presets import resolve

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
    """What a point changes in the settings; the batch of one update stays the same."""
    if axis == "members":
        return {"seeds": value, "processes": 1}
    if axis == "envs":
        return {"seeds": 1, "processes": 1, "envs": value, "rollout_steps": 2048 // value}
    if axis == "width":
        return {"seeds": 3, "processes": 1, "hidden": [value, value]}
    return {"seeds": 3 * value, "processes": value}


def scale(
    given: Mapping[str, Any], say: Callable[[str], None]
) -> dict[str, list[dict[str, float]]]:
    """Env steps per second at every point of each axis: `{axis: [{"value", "rate"}, ...]}`."""
    found: dict[str, list[dict[str, float]]] = {}
    for axis, values in AXES.items():
        found[axis] = []
        for value in values:
            if axis == "processes" and value > (os.cpu_count() or 1):
                continue
            settings = {**given, **settings_at(axis, value)}
            config = resolve(settings)
            batch = config.rollout_steps * config.envs
            iterations = WARM_UP + max(3, -(-ENOUGH // (batch * len(config.seeds))))
            rate = training_rate({**settings, "steps": batch * iterations})
            found[axis].append({"value": value, "rate": rate})
            say(f"{value} {LABELS[axis]}: {rate:,.0f} env steps/s")
    return found


def draw(found: Mapping[str, list[dict[str, float]]], title: str, path: Path) -> None:
    """One panel per axis."""
    from sauna.style import applied, save

    with applied():
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, len(found), figsize=(3.1 * len(found), 3), sharey=True)
        for axis, (name, points) in zip(axes, found.items(), strict=True):
            values = [point["value"] for point in points]
            axis.plot(values, [point["rate"] / 1000 for point in points], "o-", color="#0072B2")
            axis.set_xscale("log", base=2)
            axis.set_xticks(values, [str(value) for value in values])
            axis.minorticks_off()
            axis.set_xlabel(LABELS[name].replace(", ", ",\n"))
            axis.set_ylim(bottom=0)
        axes[0].set_ylabel("1000 env steps/s, in sum")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.tight_layout()
        save(figure, path)
