"""Generalised state-dependent exploration (gSDE): noise that is a function of the features.

Raffin, Kober & Stulp (2021), "Smooth exploration for robotic reinforcement learning", as in
Stable-Baselines3's `StateDependentNoiseDistribution`. With the policy's last hidden layer
`h [H]`, and a matrix `E [H, A]` of independent normals of the learned standard deviations
`S [H, A]`, the action is `mean(s) + h E`. The matrix stays for several env steps, in which the same
state gives the same action. Of one step the action is normal with variance `h^2 @ S^2`: that is
the density that log-probabilities and entropies are of.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.policy.distributions import Distribution, gaussian
from sauna.algorithm.types import Array

SMALLEST = 1e-6  # added to the variance, as in Stable-Baselines3


def gsde(size: int, features: int) -> Distribution:
    """Diagonal normal whose noise is a matrix of standard normals, `[..., H * A]`.

    Its log-std depends on the state; `explore` turns the matrix into the noise of an action.

    Args:
      size: A; features: H.
    """
    width = features * size

    def draw(key: Array, shape: tuple[int, ...]) -> Array:
        return jax.random.normal(key, (*shape, width), jnp.float32)

    return gaussian(size)._replace(draw=draw)


def deviation(log_std: Array, expln: bool) -> Array:
    """Returns standard deviations: `exp(x)`; with `expln` it is `1 + log(1 + x)` above 0.

    The latter grows slowly and has a continuous slope at 0.
    """
    if not expln:
        return jnp.exp(log_std)
    slow = 1.0 + jnp.log1p(jnp.maximum(log_std, 0.0))
    return jnp.where(log_std > 0.0, slow, jnp.exp(jnp.minimum(log_std, 0.0)))


def state_log_std(hidden: Array, std: Array) -> Array:
    """Returns `log sqrt(h^2 @ S^2)`, the log-std `[..., A]` of an action in each state.

    Args:
      hidden: `[..., H]`; std: `[H, A]`.
    """
    return 0.5 * jnp.log(hidden**2 @ std**2 + SMALLEST)


def explore(mean: Array, hidden: Array, std: Array, noise: Array) -> Array:
    """Returns actions `[..., A]` of the matrices that `noise` `[..., H * A]` holds.

    Args:
      mean: `[..., A]`; hidden: `[..., H]`; std: `[H, A]`.
    """
    matrix = std * noise.reshape((*noise.shape[:-1], *std.shape))
    return mean + jnp.sum(hidden[..., None] * matrix, -2)
