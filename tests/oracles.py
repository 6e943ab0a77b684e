"""Independent implementations that tests compare with."""

from __future__ import annotations

import numpy as np


class RunningNormalizer:
    """baselines' RunningMeanStd and VecNormalize, one number at a time."""

    def __init__(self, size: int) -> None:
        self.mean, self.var, self.count = np.zeros(size), np.ones(size), 1e-4

    def update(self, batch: np.ndarray) -> None:
        mean, var, number = batch.mean(0), batch.var(0), len(batch)
        delta, total = mean - self.mean, self.count + number
        m2 = self.var * self.count + var * number + delta**2 * self.count * number / total
        self.mean = self.mean + delta * number / total
        self.var, self.count = m2 / total, total
