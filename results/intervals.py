"""How often the intervals of `experiments/statistics.py` hold the truth: `results/intervals.json`.

    python results/intervals.py     (two minutes)

Scores are drawn from distributions whose truth is known. The share of trials, each with new scores,
in which the 95% interval covers the truth is stored.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from sauna.experiments.statistics import (
    bootstrap_improvement,
    improvement_estimate,
    iqm_estimate,
    mean_interval,
)

TRIALS = 1000
PATH = Path(__file__).parent / "intervals.json"
ONE_IN_FIVE, FAR = 0.2, 10.0  # two modes: how many lie in the far one, and where (in std)


def coverage(trial: Callable[[np.random.Generator], bool]) -> float:
    random = np.random.default_rng(0)
    return sum(trial(random) for _ in range(TRIALS)) / TRIALS


def iqm_of_normals(seeds: int) -> float:
    def trial(random: np.random.Generator) -> bool:
        _, low, high = iqm_estimate([random.normal(size=seeds)])
        return low is not None and high is not None and low <= 0 <= high

    return coverage(trial)


def mean_of_two_modes(seeds: int) -> float:
    def trial(random: np.random.Generator) -> bool:
        values = random.normal(size=seeds) + FAR * (random.random(seeds) < ONE_IN_FIVE)
        _, low, high = (float(end[0]) for end in mean_interval(values[:, None]))
        return low <= FAR * ONE_IN_FIVE <= high

    return coverage(trial)


def improvement_of_normals(seeds: int, apart: float, bootstrap: bool) -> float:
    true = float(scipy.special.ndtr(apart / math.sqrt(2)))

    def trial(random: np.random.Generator) -> bool:
        x, y = random.normal(size=seeds) + apart, random.normal(size=seeds)
        low, high = bootstrap_improvement([(x, y)]) if bootstrap else improvement_estimate(x, y)[1:]
        return low is not None and high is not None and low <= true <= high

    return coverage(trial)


def main() -> None:
    result: dict[str, Any] = {
        "command": "python results/intervals.py",
        "trials": TRIALS,
        "iqm_of_normals": {n: iqm_of_normals(n) for n in (3, 6, 10, 30)},
        "mean_of_two_modes": {n: mean_of_two_modes(n) for n in (3, 6, 10)},
        **{
            f"improvement_of_normals{'_bootstrap' * bootstrap}": {
                n: {apart: improvement_of_normals(n, apart, bootstrap) for apart in (0.0, 1.0, 2.0)}
                for n in (3, 6)
            }
            for bootstrap in (False, True)
        },
    }
    PATH.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
