"""Networks of a user's own. Importable by name."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp


class Sine(nn.Module):
    """A trunk for vectors."""

    width: int = 7

    @nn.compact
    def __call__(self, observation):
        return jnp.sin(nn.Dense(self.width, name="inner")(observation))


class Coarse(nn.Module):
    """A trunk for images that compiles fast."""

    @nn.compact
    def __call__(self, observation):
        assert observation.dtype == jnp.uint8
        seen = observation[..., ::12, ::12, :].astype(jnp.float32) / 255.0
        return nn.tanh(nn.Dense(8)(seen.reshape(*observation.shape[:-3], -1)))
