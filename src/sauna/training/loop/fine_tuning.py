"""A member that starts from the weights and the normaliser of a trained one."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.policy.normalize import LongMoments, Moments
from sauna.algorithm.policy.policy import Policy
from sauna.system.checkpoint import BadCheckpoint, under
from sauna.system.errors import BadInput
from sauna.training.loop.member_state import fitting, flat_params, named_params

FRESH = "auxiliary_head/"  # the one part of a network that an arm may have and another not


def initial_params(policy: Policy, fresh: jax.Array, own: Mapping[str, np.ndarray]) -> jax.Array:
    """Parameters `[D]` of a trained member, whose optimizer starts afresh.

    Args:
      fresh: the member's own first parameters, whose auxiliary head stays if the trained member has
        none.
      own: the trained member's arrays.

    Raises:
      BadInput: an array is missing, or of another shape or type.
    """
    stored = under("params/", own)
    here = named_params(policy, fresh)
    kept = {name: a for name, a in here.items() if name.startswith(FRESH) and name not in stored}
    try:
        return flat_params(policy, fresh, {**stored, **kept})
    except BadCheckpoint as error:
        raise BadInput(f"init_from: {error}") from error


def initial_moments(
    kind: str, own: Mapping[str, np.ndarray], shape: tuple[int, ...]
) -> Moments | None:
    """Kept running moments of `shape`, float64; None: they start afresh.

    Args:
      kind: `observation_moments` or `reward_moments`.

    Raises:
      BadInput: an array is missing, or of another shape or type.
    """
    stored = under(f"{kind}/", own)
    if not stored:
        return None
    shapes = {"mean": shape, "variance": shape, "count": (1,)}
    try:
        return Moments(**{n: fitting(stored, n, np.zeros(shapes[n])) for n in Moments._fields})
    except BadCheckpoint as error:
        raise BadInput(f"init_from: {error}") from error


def as_long_moments(moments: Moments, example: LongMoments) -> LongMoments:
    """The same in float32, with what that leaves out."""
    whole = [
        np.asarray(part, np.float64).reshape(e.shape)
        for part, e in zip(moments, example[:3], strict=True)
    ]
    first = [part.astype(np.float32) for part in whole]
    lost = [(a - b).astype(np.float32) for a, b in zip(whole, first, strict=True)]
    return LongMoments(*map(jnp.asarray, first), *map(jnp.asarray, lost))
