"""A small tuning, in threads of the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from helpers import SMALL, Silent
from sauna.experiments.tune.command import tune

ENV = "small_envs:MatchingAction"
GIVEN = {"env": ENV, **{k: v for k, v in SMALL.items() if k != "seeds"}, "preset": "discrete"}
SPACE = """
learning_rate = {low = 1e-4, high = 1e-1, log = true}
gamma = [0.9, 0.99]
epochs = [2]
activation = ["tanh"]
"""


def tuned(folder: Path, **options: Any) -> tuple[dict[str, Any], Path]:
    """A small tuning; the number of its trials, and how many are in lockstep, are given."""
    file = folder / "space.toml"
    file.write_text(options.pop("space", SPACE))
    options = {"space": str(file), "finalists": 1, "fresh_seeds": 0, "pruner": "none", **options}
    given = {**GIVEN, **options.pop("given", {})}
    return tune(given, folder, display=Silent, say=lambda text: None, jobs=1, **options)


def answers(found: dict[str, Any]) -> list[Any]:
    return [(t["state"], t["return"], t["searched"], t["curve"]) for t in found["trials"]]
