"""How each member of a run ended: `summary.json`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

WINDOW = 100  # episodes that the reported mean return covers, as in baselines and the paper
METRIC = f"return_mean: mean training return (sampled actions) of the last {WINDOW} episodes"
STOPS = ("", "stop_at", "stop_when_flat", "callback")  # what may stop a member early
KEPT = (
    "arm",
    "seed",
    "env_steps",
    "kept_steps",
    "episodes",
    "return_mean",
    "return_mean_reported",
    "explained_variance",
    "eval_return_mean",
    "eval_return_best",
    "eval_env_steps",
)


def with_evaluation(row: Mapping[str, Any], before: Mapping[str, Any] | None) -> dict[str, Any]:
    """A member's newest row with the numbers of its last evaluation, which `before` has."""
    kept = {name: value for name, value in (before or {}).items() if name.startswith("eval_")}
    return {**kept, **row}


def summarize(
    rows: Iterable[Mapping[str, Any]], arrays: Mapping[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Summarizes members by their last rows, their last evaluations and their final state.

    Args:
      arrays: of the last checkpoint, which say whether and why a member was stopped early.
    """
    last: dict[str, dict[str, Any]] = {}
    for row in rows:
        last[row["member"]] = with_evaluation(row, last.get(row["member"]))
    found = {name: {key: row[key] for key in KEPT if key in row} for name, row in last.items()}
    for name, row in found.items():
        stopped = arrays.get(f"{name}/counters/stopped", 0)
        if reason := dict(enumerate(STOPS)).get(int(stopped)):
            row["stopped_early"] = reason
    return found
