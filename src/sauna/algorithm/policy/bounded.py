"""Action distributions on a bounded box: a Gaussian under a tanh, and the Beta distribution.

Both are distributions of an action in [-1, 1], which is stretched to the bounds of the environment
(`envs/spaces.py`). A rollout holds `u`, the action before a tanh: `action = tanh(u)`, for Beta with
`u = logit(x) / 2` of `x` in [0, 1]. So no inverse of tanh is needed, an action at the bound is a
number like any other, and log-probabilities stay finite. They are densities of the action, not of
`u`.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betaln, digamma

from sauna.algorithm.policy.distributions import Distribution, gaussian
from sauna.algorithm.types import Array

NODES = 32  # of the Gauss-Hermite rule for the squashed Gaussian's entropy
INSIDE = 0.999  # the largest action that a recorded one stands for
TRIES = 6  # proposals of one gamma variate: 5% of them fail at most, so 2e-8 of the variates do


def to_env(distribution: Distribution, action: Any) -> Any:
    """Returns what the environment's border takes of a stored action: in [-1, 1] if bounded.

    Args:
      action: `[..., A]`, numpy or JAX.
    """
    if not distribution.bounded:
        return action
    return np.tanh(action) if isinstance(action, np.ndarray) else jnp.tanh(action)


def from_env(distribution: Distribution, action: np.ndarray) -> np.ndarray:
    """Returns how a rollout holds an action `[..., A]` of the environment's border.

    It is the inverse of `to_env`. An action at a bound, which no `u` has, counts as one inside it
    (`INSIDE`).
    """
    if not distribution.bounded:
        return action
    return np.arctanh(np.clip(action, -INSIDE, INSIDE))


def log_slope(u: Array) -> Array:
    """Returns `log(d tanh(u) / du) = log(1 - tanh(u)^2)`, which does not overflow.

    It is `2 (log 2 - u - softplus(-2 u))`.
    """
    return 2.0 * (math.log(2.0) - u - jax.nn.softplus(-2.0 * u))


def squashed(size: int) -> Distribution:
    """Diagonal normal of `u`, and `action = tanh(u)`; parameters are those of the normal.

    `log p(a) = log N(u) - sum log(1 - tanh(u)^2)` (Haarnoja et al. 2018, appendix C). The entropy
    `H(u) + E[sum log(1 - tanh(u)^2)]` has no closed form: its expectation is a Gauss-Hermite rule
    of `NODES` points for each component, a function of the parameters with a gradient. The mode is
    that of `u`, whose tanh is the action's median.
    """
    normal = gaussian(size)
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    points = np.asarray(nodes, np.float32)
    shares = np.asarray(weights / weights.sum(), np.float32)

    def log_prob(parameters: Array, action: Array) -> Array:
        return normal.log_prob(parameters, action) - jnp.sum(log_slope(action), -1)

    def entropy(parameters: Array) -> Array:
        mean, std = parameters[..., :size], jnp.exp(parameters[..., size:])
        slopes = log_slope(mean[..., None] + std[..., None] * points)
        return normal.entropy(parameters) + jnp.sum(slopes @ shares, -1)

    return normal._replace(log_prob=log_prob, entropy=entropy, bounded=True)


def beta(size: int) -> Distribution:
    """Independent Beta distributions; parameters are what `1 + softplus` makes alpha and beta of.

    Both are above 1, so that the density is finite and has one top (Chou, Maturana & Scherer 2017,
    "Improving stochastic policy gradients in continuous control with deep reinforcement learning
    using the Beta distribution"). Parameters are `[..., 2 * size]`: those of alpha, then of beta.
    The mode here is the mean: the top of a density that is nearly flat means little.

    A sample is a ratio of two gamma variates by Marsaglia & Tsang (2000), whose proposals are drawn
    beforehand: `TRIES` pairs of a normal and an exponential number for each variate.
    """

    def shapes(parameters: Array) -> tuple[Array, Array]:
        both = 1.0 + jax.nn.softplus(parameters)
        return both[..., :size], both[..., size:]

    def sample(parameters: Array, noise: Array) -> Array:
        logs = log_gamma_variate(1.0 + jax.nn.softplus(parameters), _proposals(noise))
        return 0.5 * (logs[..., :size] - logs[..., size:])

    def log_prob(parameters: Array, action: Array) -> Array:
        a, b = shapes(parameters)
        log_x, log_rest = -jax.nn.softplus(-2.0 * action), -jax.nn.softplus(2.0 * action)
        density = (a - 1.0) * log_x + (b - 1.0) * log_rest - betaln(a, b)
        return jnp.sum(density, -1) - size * math.log(2.0)

    def entropy(parameters: Array) -> Array:
        a, b = shapes(parameters)
        of_both = (a + b - 2.0) * digamma(a + b)
        each = betaln(a, b) - (a - 1.0) * digamma(a) - (b - 1.0) * digamma(b) + of_both
        return jnp.sum(each, -1) + size * math.log(2.0)

    def mode(parameters: Array) -> Array:
        a, b = shapes(parameters)
        return 0.5 * (jnp.log(a) - jnp.log(b))

    def draw(key: Array, shape: tuple[int, ...]) -> Array:
        normal, exponential = jax.random.split(key)
        pool = (*shape, 2 * size * TRIES)
        z = jax.random.normal(normal, pool, jnp.float32)
        return jnp.concatenate([z, jax.random.exponential(exponential, pool, jnp.float32)], -1)

    return Distribution(
        2 * size, False, draw, sample, log_prob, entropy, mode, continuous=True, bounded=True
    )


def _proposals(noise: Array) -> tuple[Array, Array]:
    """Normal and exponential numbers, `[..., V, TRIES]` each, of `V` gamma variates."""
    normal, exponential = jnp.split(noise, 2, -1)
    shape = (*noise.shape[:-1], -1, TRIES)
    return normal.reshape(shape), exponential.reshape(shape)


def log_gamma_variate(shape: Array, proposals: tuple[Array, Array]) -> Array:
    """Returns the logarithm of gamma variates of the shapes `[..., V]`, which are at least 1.

    With `d = shape - 1/3`, `c = 1 / sqrt(9 d)` and `v = (1 + c z)^3`, the first `d v` is taken for
    which `-e < z^2 / 2 + d - d v + d log v` (Marsaglia & Tsang 2000, ACM TOMS 26, p. 363).

    Args:
      proposals: standard normal `z` and exponential `e` `[..., V, TRIES]`.
    """
    z, e = proposals
    d = shape[..., None] - 1.0 / 3.0
    root = 1.0 + z / jnp.sqrt(9.0 * d)
    log_v = 3.0 * jnp.log(jnp.maximum(root, 1e-3))
    fits = (root > 1e-3) & (-e < 0.5 * z**2 + d * (1.0 - root**3 + log_v))
    first = jnp.argmax(fits, -1)[..., None]
    return (jnp.log(d) + jnp.take_along_axis(log_v, first, -1))[..., 0]
