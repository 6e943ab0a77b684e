"""How widely a member ranges at one checkpoint, and at random: the measurement `coverage`.

State coverage is the differential entropy of the observations that the policy of the checkpoint
visits, acting as in training, by its distances to the nearest neighbours (Kozachenko and Leonenko
1987; Singh et al. 2003):

    H = digamma(N) - digamma(K) + log(volume of the unit ball) + D mean(log distance to the K-th)

in nats, of observations scaled by one fixed mean and standard deviation that all arms share. Twice
the range in one of D directions is log 2 more. Observations of neighbouring steps are alike, which
lowers the estimate; every `EVERY`-th step is taken, in all arms alike. Compare differences, not
values.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from sauna.experiments.measure.streams import MemberSnapshot, fresh_streams

STREAMS = 8
STEPS = 2048  # env steps of each env in a stream, at least
EVERY = 8  # env steps between two observations that are counted
NEIGHBOUR = 5  # K


def compute(snapshot: MemberSnapshot, scale: MemberSnapshot, file: Path) -> dict[str, Any]:
    """Measures the state coverage at a checkpoint, in nats, as JSON values.

    Args:
      scale: the member whose normaliser, as it was there, scales the observations.
      file: not read.
    """
    steps = snapshot.config.rollout_steps
    fresh = fresh_streams(snapshot, STREAMS, -(-STEPS // steps), limit=steps)
    mean, variance = (scale.arrays[f"observation_moments/{n}"] for n in ("mean", "variance"))
    seen = np.concatenate([stream.seen[::EVERY] for stream in fresh.streams])
    return {
        "coverage": particle_entropy((seen - mean) / np.sqrt(variance + 1e-8)),
        **fresh.counts,
    }


def particle_entropy(points: np.ndarray) -> float:
    """Computes the entropy in nats of the density that `points` `[N, D]` are drawn from."""
    number, size = points.shape
    distance = scipy.spatial.cKDTree(points).query(points, NEIGHBOUR + 1)[0][:, -1]
    log_ball = 0.5 * size * math.log(math.pi) - scipy.special.gammaln(0.5 * size + 1)
    nearest = np.log(np.maximum(distance, 1e-12))
    digamma = scipy.special.digamma
    return float(digamma(number) - digamma(NEIGHBOUR) + log_ball + size * nearest.mean())
