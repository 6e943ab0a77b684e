"""Networks of users: some that train, and some that cannot."""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import jax.numpy as jnp


class Wide(nn.Module):
    """`[..., obs]` -> `[..., width]`."""

    width: int = 5

    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.tanh(nn.Dense(self.width)(x))


class Normed(nn.Module):
    """Keeps the statistics of its batches."""

    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.BatchNorm(use_running_average=False)(nn.Dense(4)(x))


class Counting(nn.Module):
    """Keeps a number of its own."""

    @nn.compact
    def __call__(self, x: Any) -> Any:
        self.variable("calls", "number", lambda: jnp.zeros(()))
        return nn.Dense(4)(x)


class Dropping(nn.Module):
    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.Dropout(0.5, deterministic=False)(nn.Dense(4)(x))


class Summed(nn.Module):
    """Loses the features."""

    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.Dense(4)(x).sum(-1)


class Flattened(nn.Module):
    """Takes all axes but the first one for features."""

    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.Dense(4)(x.reshape((x.shape[0], -1)))


class Pair(nn.Module):
    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.Dense(4)(x), x


class Rounded(nn.Module):
    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.Dense(4)(x).astype(jnp.int32)


class Logarithm(nn.Module):
    """NaN for negative numbers."""

    @nn.compact
    def __call__(self, x: Any) -> Any:
        return nn.Dense(4)(jnp.log(x))


class Root(nn.Module):
    """Finite, but its gradient at 0 is not."""

    @nn.compact
    def __call__(self, x: Any) -> Any:
        return jnp.sqrt(nn.Dense(4, kernel_init=nn.initializers.zeros)(x))


class Embedded(nn.Module):
    """Boards of bytes below 4, as they are: an embedding of each field."""

    @nn.compact
    def __call__(self, x: Any) -> Any:
        fields = nn.Embed(4, 3)(x.astype(jnp.int32))
        return fields.reshape((*x.shape[:-3], -1))


def built() -> nn.Module:
    return nn.Sequential([nn.Dense(6), nn.tanh, Wide(7)])


sequence = nn.Sequential([nn.Dense(6), nn.tanh, Wide(7)])
instance = Wide(width=9)
filled = partial(Wide, width=3)
