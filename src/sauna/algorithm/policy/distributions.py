"""Action distributions as pure functions of the network's output and of noise drawn beforehand.

Sampling is split from drawing: `draw` gives a rollout's noise at once, `sample` turns one step's
noise and the distribution parameters into an action without any random numbers of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.types import Array


class Distribution(NamedTuple):
    """One kind of action distribution; `K` parameters and `A` action components.

    Attributes:
      num_outputs: outputs that the policy head must have.
      has_log_std: whether a log-std is appended to the head's output, which is the mean.
      draw: `(key, shape) -> noise [*shape, M]`.
      sample: `(parameters [..., K], noise [..., M]) -> action [..., A]`.
      log_prob: `(parameters [..., K], action [..., A]) -> [...]`.
      entropy: `parameters [..., K] -> [...]`.
      mode: `parameters [..., K] -> action [..., A]`.
      continuous: whether `log_prob` is that of a density.
      bounded: whether an action here is what a tanh bounds: see `policy/bounded.py`.
    """

    num_outputs: int
    has_log_std: bool
    draw: Callable[[Array, tuple[int, ...]], Array]
    sample: Callable[[Array, Array], Array]
    log_prob: Callable[[Array, Array], Array]
    entropy: Callable[[Array], Array]
    mode: Callable[[Array], Array]
    continuous: bool = False
    bounded: bool = False


def gaussian(size: int) -> Distribution:
    """Diagonal normal; parameters are the mean and the log standard deviation, `[..., 2 * size]`.

    `log p(a) = -0.5 * sum(((a - mean) / std)^2) - sum(log std) - 0.5 * size * log(2 pi)`.
    """

    def split(parameters: Array) -> tuple[Array, Array]:
        return parameters[..., :size], parameters[..., size:]

    def sample(parameters: Array, noise: Array) -> Array:
        mean, log_std = split(parameters)
        return mean + jnp.exp(log_std) * noise

    def log_prob(parameters: Array, action: Array) -> Array:
        mean, log_std = split(parameters)
        z = (action - mean) * jnp.exp(-log_std)
        constant = 0.5 * size * math.log(2.0 * math.pi)
        return -0.5 * jnp.sum(z**2, -1) - jnp.sum(log_std, -1) - constant

    def entropy(parameters: Array) -> Array:
        return jnp.sum(split(parameters)[1], -1) + 0.5 * size * (1.0 + math.log(2.0 * math.pi))

    def draw(key: Array, shape: tuple[int, ...]) -> Array:
        return jax.random.normal(key, (*shape, size), jnp.float32)

    return Distribution(
        size, True, draw, sample, log_prob, entropy, lambda p: split(p)[0], continuous=True
    )


def multi_categorical(sizes: tuple[int, ...]) -> Distribution:
    """Independent categoricals; parameters are all logits side by side, `[..., sum(sizes)]`.

    Sampling is the Gumbel-max trick; a single categorical is `sizes = (n,)`.
    """
    ends = [sum(sizes[: i + 1]) for i in range(len(sizes))]
    spans = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]

    def log_softmax(parameters: Array) -> list[Array]:
        return [jax.nn.log_softmax(parameters[..., span], -1) for span in spans]

    def mode(parameters: Array) -> Array:
        parts = [jnp.argmax(parameters[..., span], -1) for span in spans]
        return jnp.stack(parts, -1).astype(jnp.int32)

    def log_prob(parameters: Array, action: Array) -> Array:
        return sum(
            jnp.take_along_axis(log_p, action[..., i : i + 1].astype(jnp.int32), -1)[..., 0]
            for i, log_p in enumerate(log_softmax(parameters))
        )  # type: ignore[return-value]

    def entropy(parameters: Array) -> Array:
        return sum(-jnp.sum(jnp.exp(log_p) * log_p, -1) for log_p in log_softmax(parameters))  # type: ignore[return-value]

    def draw(key: Array, shape: tuple[int, ...]) -> Array:
        return jax.random.gumbel(key, (*shape, sum(sizes)), jnp.float32)

    return Distribution(
        sum(sizes), False, draw, lambda p, noise: mode(p + noise), log_prob, entropy, mode
    )


def bernoulli(size: int) -> Distribution:
    """Independent bits; parameters are the logits, `[..., size]`. Noise is logistic."""

    def log_prob(parameters: Array, action: Array) -> Array:
        bit = action.astype(parameters.dtype)
        log_p = bit * jax.nn.log_sigmoid(parameters) + (1.0 - bit) * jax.nn.log_sigmoid(-parameters)
        return jnp.sum(log_p, -1)

    def entropy(parameters: Array) -> Array:
        p = jax.nn.sigmoid(parameters)
        return -jnp.sum(
            p * jax.nn.log_sigmoid(parameters) + (1.0 - p) * jax.nn.log_sigmoid(-parameters), -1
        )

    def mode(parameters: Array) -> Array:
        return (parameters > 0).astype(jnp.int32)

    def draw(key: Array, shape: tuple[int, ...]) -> Array:
        return jax.random.logistic(key, (*shape, size), jnp.float32)

    return Distribution(size, False, draw, lambda p, n: mode(p + n), log_prob, entropy, mode)
