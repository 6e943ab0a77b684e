"""Running normalisation on the host: observations step by step, rewards a rollout at a time.

The arithmetic is `core.normalize`'s. Observations enter their moments before the policy sees
them, so those are updated at every vector step, in place; with one env per member, nine small
numpy calls do it. Rewards are learned from only after the rollout, and are scaled then.
"""

from __future__ import annotations

import numpy as np

from sauna.core.normalize import EPSILON, Moments, initial_moments, update_moments


class ObservationMoments:
    """Moments of P members' observations `[P, N, D]`, updated in place.

    Attributes:
      mean, variance: `[P, 1, D]` float64; count: `[P, 1, 1]`.
    """

    def __init__(self, members: int, envs: int, size: int, clip: float) -> None:
        first = initial_moments((members, 1), size)
        self.mean, self.variance, self.count = first
        self._envs, self._clip = envs, clip
        self._acting = np.ones((members, envs), bool)
        self._fractions = self._remains = np.zeros((0, members, 1, 1))
        self._work = np.zeros((2, members, envs, size))

    def plan(self, acting: np.ndarray, steps: int) -> None:
        """Says who acts `[P, N]` in the coming `steps` calls of `see`; their counts follow now."""
        self._acting = acting
        if self._envs == 1:
            number = acting[:, :, None].astype(np.float64)
            added = np.concatenate([self.count[None], np.repeat(number[None], steps, 0)])
            counts = np.add.accumulate(added)
            self._fractions, self._remains = number / counts[1:], counts[:-1] / counts[1:]
            self.count[:] = counts[-1]

    def see(self, observation: np.ndarray, step: int) -> None:
        """Lets `observation` `[P, N, D]` enter, as the `step`-th of the plan."""
        if self._envs > 1:
            moments = Moments(self.mean[:, 0], self.variance[:, 0], self.count[:, 0])
            moments = update_moments(moments, observation, self._acting)
            self.mean[:, 0], self.variance[:, 0], self.count[:, 0] = moments
            return
        delta, move = self._work
        np.subtract(observation, self.mean, out=delta)
        np.multiply(delta, self._fractions[step], out=move)
        np.add(self.mean, move, out=self.mean)
        np.multiply(delta, move, out=move)
        np.add(self.variance, move, out=self.variance)
        np.multiply(self.variance, self._remains[step], out=self.variance)

    def normalize(self, observation: np.ndarray, out: np.ndarray) -> None:
        """Writes the normalised and clipped `observation` `[P, N, D]` to `out`, float32."""
        centred, scaled = self._work
        np.subtract(observation, self.mean, out=centred)
        deviation = np.sqrt(self.variance + EPSILON)
        np.divide(centred, deviation, out=scaled)
        np.minimum(scaled, self._clip, out=scaled)
        np.maximum(scaled, -self._clip, out=scaled)
        out[...] = scaled

    def of(self, member: int) -> Moments:
        """One member's moments of `[D]`, as views."""
        return Moments(self.mean[member, 0], self.variance[member, 0], self.count[member, 0])


def discounted_returns(
    reward: np.ndarray, ended: np.ndarray, valid: np.ndarray, start: np.ndarray, gamma: float
) -> tuple[np.ndarray, np.ndarray]:
    """`G_t = gamma G_{t-1} + r_t`, begun anew after each episode.

    Args:
      reward, ended, valid: `[S, N]`; only the first rows of a column are valid.
      start: `[N]`, G before the first row.

    Returns:
      G `[S, N]` (0 where not valid), and what the next rollout starts from `[N]`.
    """
    sums, last, steps = np.zeros(reward.shape), start.copy(), valid.sum(0).tolist()
    for n, number in enumerate(steps):  # plain floats: numpy would cost more per number
        now, column = float(start[n]), []
        pairs = zip(reward[:number, n].tolist(), ended[:number, n].tolist(), strict=True)
        for r, end in pairs:
            now = now * gamma + r
            column.append(now)
            if end:
                now = 0.0
        sums[:number, n], last[n] = column, now
    return sums, last


def moments_after_each(moments: Moments, values: np.ndarray, valid: np.ndarray) -> Moments:
    """Moments after each row of `values` `[S, N]` has entered where `valid`; fields `[S]`.

    The sums are taken about the mean so far: `var = (n0 var0 + sum d^2) / n - (sum d / n)^2`.
    """
    deviation = np.where(valid, values - moments.mean, 0.0)
    count = moments.count + np.cumsum(valid.sum(1))
    shift = np.cumsum(deviation.sum(1)) / count
    square = moments.count * moments.variance + np.cumsum((deviation**2).sum(1))
    return Moments(moments.mean + shift, np.maximum(square / count - shift**2, 0.0), count)


def scale_rewards(moments: Moments, reward: np.ndarray, clip: float) -> np.ndarray:
    """`clip(r / sqrt(var + eps), +-clip)` of `[S, N]`, by the moments after each row."""
    return (reward / np.sqrt(moments.variance + EPSILON)[:, None]).clip(-clip, clip)
