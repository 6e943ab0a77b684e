"""Delight: rare and good counts more, rare and bad less."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_choice, check_range
from sauna.algorithm.types import Array, LossTerms, LossWeight

BOUND = 10.0  # of the surprisal


def surprisal(log_prob: Array, entropy: Array | None) -> Array:
    """`-log_prob`, clipped to +-10.

    A density's can be negative: the policy's entropy is subtracted first if it is given.
    """
    centre = 0.0 if entropy is None else entropy
    return jnp.clip(-log_prob - centre, -BOUND, BOUND)


def delight(temperature: float = 1.0, centred: bool = True, on: str = "mean") -> LossWeight:
    """Multiplies the policy term by `2 sigmoid(chi / temperature)`, `chi = A^ surprisal`.

    No gradient goes through the weight. The surprisal is that of today's policy. `centred`
    subtracts the entropy of a continuous policy. Weighting everything keeps widening a Gaussian
    whose log-std is free (measured on Hopper-v5: entropy 4 -> 47 nats), so that `on="mean"`
    weights the gradient of the mean alone; `on="all"` is the rule as published. Discrete policies
    have no log-std and are weighted whole. Source: Osband 2026, arXiv 2603.14608, whose gate has
    no factor 2; here a row without delight weighs 1.
    """
    check_range("temperature", temperature, 1e-6)
    check_choice("on", on, ("mean", "all"))

    def weight(terms: LossTerms) -> tuple[Array, Array]:
        centre = terms.entropy if centred and terms.continuous else None
        chi = terms.advantage * surprisal(terms.log_prob, centre)
        scale = 2.0 * jax.nn.sigmoid(chi / temperature)
        return terms.present, jax.lax.stop_gradient(scale)

    return LossWeight(weight, on_mean=on == "mean")
