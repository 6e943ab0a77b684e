"""Running normalisation on the host: observations step by step, rewards a rollout at a time.

The arithmetic is that of `policy/normalize.py`. Observations enter their moments before the policy
sees them, so those are updated at every vector step, in place, by a compiled loop. Rewards are
learned from only after the rollout, and are scaled then.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sauna.algorithm.policy.normalize import EPSILON, Moments, initial_moments
from sauna.system.compiled import compiled


class ObservationMoments:
    """Moments of the first D numbers of P members' observations `[P, N, >= D]`.

    They are updated in place.

    Attributes:
      mean, variance: `[P, D]` float64; count: `[P, 1]`.
    """

    def __init__(self, members: int, size: int, clip: float) -> None:
        self.mean, self.variance, self.count = initial_moments((members,), size)
        self._clip = clip

    def see(self, observation: np.ndarray, acting: np.ndarray) -> None:
        """Lets those rows of `observation` `[P, N, D]` enter that are acting (`[P, N]`)."""
        _see(observation, acting, self.mean, self.variance, self.count)

    def see_and_normalize(
        self, observation: np.ndarray, acting: np.ndarray, out: np.ndarray
    ) -> None:
        """`see`, then `normalize`, in one call."""
        _see_and_normalize(
            observation, acting, self.mean, self.variance, self.count, EPSILON, self._clip, out
        )

    def normalize(self, observation: np.ndarray, out: np.ndarray) -> None:
        """Writes the normalised and clipped `observation` `[P, N, D]` to `out`, float32."""
        _normalize(observation, self.mean, self.variance, EPSILON, self._clip, out)

    def of(self, member: int) -> Moments:
        """One member's moments of `[D]`, as views."""
        return Moments(self.mean[member], self.variance[member], self.count[member])


@compiled
def _see(observation: Any, acting: Any, mean: Any, variance: Any, count: Any) -> None:
    """`policy.normalize.update_moments`, in place."""
    members, envs, size = observation.shape[0], observation.shape[1], mean.shape[1]
    for p in range(members):
        number = acting[p].sum()
        if number == 0:
            continue
        total = count[p, 0] + number
        fraction, remains = number / total, count[p, 0] / total
        for d in range(size):
            batch_mean, batch_variance = 0.0, 0.0
            for n in range(envs):
                if acting[p, n]:
                    batch_mean += observation[p, n, d]
            batch_mean /= number
            for n in range(envs):
                if acting[p, n]:
                    batch_variance += (observation[p, n, d] - batch_mean) ** 2
            batch_variance /= number
            delta = batch_mean - mean[p, d]
            move = delta * fraction
            mean[p, d] += move
            variance[p, d] = (variance[p, d] + delta * move) * remains + batch_variance * fraction
        count[p, 0] = total


@compiled
def _normalize(
    observation: Any, mean: Any, variance: Any, epsilon: float, clip: float, out: Any
) -> None:
    """`policy.normalize.normalize`, written to `out`; what has no moments stays as it is."""
    members, envs, size = observation.shape[0], observation.shape[1], mean.shape[1]
    for p in range(members):
        for n in range(envs):
            for d in range(size):
                scaled = (observation[p, n, d] - mean[p, d]) / np.sqrt(variance[p, d] + epsilon)
                out[p, n, d] = min(max(scaled, -clip), clip)
            for d in range(size, observation.shape[2]):
                out[p, n, d] = observation[p, n, d]


@compiled
def _see_and_normalize(
    observation: Any,
    acting: Any,
    mean: Any,
    variance: Any,
    count: Any,
    epsilon: float,
    clip: float,
    out: Any,
) -> None:
    _see(observation, acting, mean, variance, count)
    _normalize(observation, mean, variance, epsilon, clip, out)


def discounted_returns(
    reward: np.ndarray, ended: np.ndarray, valid: np.ndarray, start: np.ndarray, gamma: float
) -> tuple[np.ndarray, np.ndarray]:
    """`G_t = gamma G_{t-1} + r_t`, begun anew after each episode.

    Args:
      reward, ended, valid: `[S, N]`; a row that is not valid is passed over.
      start: `[N]`, G before the first row.

    Returns:
      G `[S, N]` (0 where not valid), and what the next rollout starts from `[N]`.
    """
    sums, last = np.zeros(reward.shape), start.copy()
    for n in range(reward.shape[1]):  # plain floats: numpy would cost more per number
        now, column, on = float(start[n]), [], valid[:, n]
        pairs = zip(reward[on, n].tolist(), ended[on, n].tolist(), strict=True)
        for r, end in pairs:
            now = now * gamma + r
            column.append(now)
            if end:
                now = 0.0
        sums[on, n], last[n] = column, now
    return sums, last


def running_sum(start: float, values: np.ndarray) -> float:
    """`start + values[0] + values[1] + ...`, in this order, wherever the sum is interrupted."""
    total = float(start)
    for value in values.tolist():
        total += value
    return total
