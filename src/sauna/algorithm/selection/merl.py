"""MERL: a head that predicts the next observation is trained along."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.types import Array

MIN_SQUARE = 1e-12  # of a norm: a vector of zeros has no direction, and no NaN


def cosine_distance(prediction: Array, target: Array) -> Array:
    """`1 - cos(prediction, target)` of `[B, O]`, `[B]`; a target `[B, *obs]` is made flat.

    A target's unit does not count, so that bytes stay what they are.
    """
    target = target.reshape((len(target), -1)).astype(prediction.dtype)
    squares = [jnp.maximum(jnp.sum(x**2, -1), MIN_SQUARE) for x in (prediction, target)]
    return 1.0 - jnp.sum(prediction * target, -1) / jnp.sqrt(squares[0] * squares[1])


def next_observation(
    prediction: Array, observation: Array, following: Array, weight: Array
) -> Array:
    """The mean cosine distance between the prediction and the next observation.

    Rows whose successor is of another episode have weight 0. Source: Flet-Berliac & Preux 2019,
    arXiv 1909.11939, which trains this head beside one for explained variance.

    Args:
      prediction: `[B, O]`; observation, following: `[B, *obs]` of O numbers; weight: `[B]`.
    """
    distance = cosine_distance(prediction, following)
    return jnp.sum(distance * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def shuffled_observation(
    prediction: Array, observation: Array, following: Array, weight: Array
) -> Array:
    """As the released code has it: the target of row i is row i + 1 of the shuffled minibatch.

    So the head is fitted to the observation of some other row. The last row has no target.
    """
    return jnp.mean(cosine_distance(prediction[:-1], observation[1:]))
