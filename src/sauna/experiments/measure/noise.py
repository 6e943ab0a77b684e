"""Is what the filter drops noisier than random steps? Measured at one checkpoint.

Half of the fresh streams give the reference: the policy gradient of all their env steps. From each
stream of the other half, minibatches of training's size are drawn from four groups of its steps:

    kept     by the filter
    dropped  by the filter
    control  a random part of all steps, as many as are kept: the matched random control. What it
             drops is distributed alike, so it is the control of both, and stands for all steps
    shifted  dropped by the filter's own decisions moved in time by a random offset: as many, and
             as bunched, as the dropped, but not chosen by what the head says there

The filter looks at the state and not at the action taken there, so that the kept steps have the
policy gradient of another weighting of states: a bias, which `alignment` shows beside the noise.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.types import Array
from sauna.experiments.measure.estimates import Gradients, estimate
from sauna.experiments.measure.gradient import policy_gradient
from sauna.experiments.measure.streams import MemberSnapshot, Stream, fresh_streams

STREAMS = 64  # half of them are the reference
STEPS = 4096  # kept ones that the rollouts of a stream have room for, at least
MINIBATCHES = 64  # of each group and stream
MIN_STREAMS = 8  # with enough steps of every group, below which nothing is estimated
GROUPS = ("kept", "dropped", "control", "shifted")
PAIRS = (("dropped", "control"), ("kept", "control"), ("dropped", "shifted"))
RULES = {"standardized": True, "raw": False}


def compute(snapshot: MemberSnapshot, scale: None, file: Path) -> dict[str, Any]:
    """Measures the noise of minibatch gradients at a checkpoint; see `measure`."""
    return measure(snapshot)


def measure(snapshot: MemberSnapshot, streams: int = STREAMS) -> dict[str, Any]:
    """Measures the noise of minibatch gradients at a checkpoint, as JSON values.

    Under `rules`, `standardized` standardises the advantages of every minibatch (and once those of
    the whole reference), as training does by default; `raw` leaves them as they are. Where fewer
    than `MIN_STREAMS` streams have a minibatch of every group, `rules` is empty.
    """
    config = snapshot.config
    rollout = config.rollout_steps * config.envs
    size = rollout // config.minibatches
    fresh = fresh_streams(snapshot, streams, -(-STEPS // rollout))
    collected = fresh.streams
    reference, tested = collected[: streams // 2], collected[streams // 2 :]
    usable = [stream for stream in tested if _smallest(stream) >= size]
    keep = np.concatenate([stream.keep for stream in collected])
    found: dict[str, Any] = {
        "keep_rate": float(keep.mean()),
        **fresh.counts,
        "minibatch": size,
        "streams": {"reference": len(reference), "tested": len(tested), "usable": len(usable)},
        "as_trained": "standardized" if config.normalize_advantages else "raw",
        "rules": {},
    }
    if len(usable) >= MIN_STREAMS:
        random = np.random.default_rng([snapshot.member.seed, snapshot.iteration])
        drawn = [draw(stream, size, random) for stream in usable]
        for rule, standardized in RULES.items():
            gradients = gradients_of(snapshot, reference, usable, drawn, standardized)
            found["rules"][rule] = estimate(gradients, GROUPS, PAIRS)
    return found


def _smallest(stream: Stream) -> int:
    """Steps of its smallest group."""
    kept = int(stream.keep.sum())
    return min(kept, len(stream.keep) - kept)


def draw(stream: Stream, size: int, random: np.random.Generator) -> np.ndarray:
    """Returns rows `[groups, MINIBATCHES, size]` of a stream, each minibatch without
    replacement."""
    steps = len(stream.keep)
    control = random.permutation(steps)[: int(stream.keep.sum())]
    groups = (
        np.flatnonzero(stream.keep),
        np.flatnonzero(~stream.keep),
        control,
        np.flatnonzero(~stream.shifted),
    )
    return np.stack(
        [[random.choice(rows, size, replace=False) for _ in range(MINIBATCHES)] for rows in groups]
    )


def gradients_of(
    snapshot: MemberSnapshot,
    reference: list[Stream],
    tested: list[Stream],
    drawn: list[np.ndarray],
    standardized: bool,
) -> Gradients:
    """Returns the gradients of all reference streams, and of the minibatches `drawn` from the
    others."""
    gradient = partial(policy_gradient, policy=snapshot.program.policy)
    whole = jax.jit(partial(gradient, standardized=False))
    advantages = np.concatenate([stream.advantage for stream in reference])
    middle, std = (advantages.mean(), advantages.std() + 1e-8) if standardized else (0.0, 1.0)
    length = max(len(stream.keep) for stream in [*reference, *tested])
    of_reference = np.stack(
        [
            whole(
                snapshot.params,
                padded(s.observation, length),
                padded(s.action, length),
                padded((s.advantage - middle) / std, length),
                padded(np.ones(len(s.keep)), length),
            )
            for s in reference
        ]
    )
    batches = jax.jit(partial(_minibatches, partial(gradient, standardized=standardized)))
    direction = of_reference.mean(0) / np.linalg.norm(of_reference.mean(0))
    results = [
        batches(
            snapshot.params,
            direction,
            padded(s.observation, length),
            padded(s.action, length),
            padded(s.advantage, length),
            rows,
        )
        for s, rows in zip(tested, drawn, strict=True)
    ]
    mean, power, cosine = (np.stack(p).astype(np.float64) for p in zip(*results, strict=True))
    kept = np.array([stream.keep.mean() for stream in tested])
    rate = np.stack([kept, 1 - kept, np.ones(len(kept)), 1 - kept], 1)  # the control stands for all
    return Gradients(mean, power, cosine, of_reference.astype(np.float64), rate)


def padded(x: np.ndarray, length: int) -> np.ndarray:
    """Returns `x` `[n, ...]` with zeros behind, `[length, ...]` float32 (integers stay): one
    program."""
    x = x.astype(np.float32) if x.dtype == np.float64 else x
    return np.concatenate([x, np.zeros((length - len(x), *x.shape[1:]), x.dtype)])


def _minibatches(
    gradient: Any,
    params: Array,
    direction: Array,
    observation: Array,
    action: Array,
    advantage: Array,
    rows: Array,
) -> tuple[Array, Array, Array]:
    """Of one stream's minibatches `[X, K, size]`: mean gradient `[X, D]`, mean square, mean cosine.

    `direction` `[D]` is the reference's, of length 1.
    """

    def one(rows: Array) -> tuple[Array, Array, Array]:
        weight = jnp.ones(rows.shape, jnp.float32)
        h = gradient(params, observation[rows], action[rows], advantage[rows], weight)
        square = h @ h
        return h, square, h @ direction / jnp.sqrt(square)

    def group(rows: Array) -> tuple[Array, Array, Array]:
        h, square, cosine = jax.lax.map(one, rows)
        return h.mean(0), square.mean(), cosine.mean()

    return jax.lax.map(group, rows)
