"""Cells of a study of selection rules as a result file stores them, made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

BASE = np.array([100.0, 101.0, 99.0, 100.5, 99.5])


def cell(
    label: str,
    returns: np.ndarray,
    samples: float = 1000.0,
    failed: int = 0,
    task: str = "A-v5",
    **numbers: Any,
) -> dict[str, Any]:
    """An arm whose curves rise linearly from 0 to each seed's final return.

    Args:
      failed: how many seeds of it failed, besides those of `returns`.
      numbers: further numbers of each member.
    """
    share = np.linspace(0, 1, 11)
    members = [
        {
            "seed": seed,
            "status": "complete",
            "final_return": final,
            "auc": final / 2,
            "keep_rate": 1.0,
            "env_steps": 1000,
            "kept_steps": 1000,
            "samples_backward": samples,
            "curve": {
                "env_steps": (1000 * share).tolist(),
                "return_mean": (final * share).tolist(),
                "samples_backward": (samples * share).tolist(),
            },
            **numbers,
        }
        for seed, final in enumerate(returns.tolist())
    ]
    broken = {"status": "failed", "final_return": 1e6, "auc": 1e6, "env_steps": 9}
    curve = {"env_steps": [9], "return_mean": [1e6], "samples_backward": [1.0]}
    members += [{"seed": len(members) + i, **broken, "curve": curve} for i in range(failed)]
    return {
        "task": task,
        "label": label,
        "arm": label,
        "baseline": None if label == "ppo" else "ppo",
        "preset": "mujoco",
        "members": members,
    }


def study(*cells: dict[str, Any]) -> dict[str, Any]:
    """A result file of these cells."""
    return {
        "format": 1,
        "name": "selection-screen-cartpole",
        "command": "sauna study selection-screen-cartpole",
        "baseline": "ppo",
        "cells": list(cells),
        "settings": {},
    }
