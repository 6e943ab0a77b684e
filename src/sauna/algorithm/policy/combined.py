"""The trunk for observations of pictures and numbers together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import flax.linen as nn
import jax.numpy as jnp

from sauna.algorithm.policy.observation import Parts
from sauna.algorithm.types import Array

MakeTrunk = Callable[[str, nn.Module | None], nn.Module]


class Combined(nn.Module):
    """A network for each picture; what they give stands beside the numbers in front of an MLP.

    So does `CombinedExtractor` of Stable-Baselines3.

    Attributes:
      make_pictures: builds each picture's network under a given name, as a part of a given module.
      make_mlp: builds the MLP.
    """

    make_pictures: Sequence[MakeTrunk]
    make_mlp: MakeTrunk

    @nn.compact
    def __call__(self, seen: Parts) -> Array:
        """Numbers `[..., D]` and pictures `[..., H, W, C]` -> `[..., hidden[-1]]`."""
        found = [seen.numbers]
        for i, (make, picture) in enumerate(zip(self.make_pictures, seen.pictures, strict=True)):
            found.append(make(f"picture_{i}", self)(picture))
        return self.make_mlp(str(self.name), self)(jnp.concatenate(found, -1))
