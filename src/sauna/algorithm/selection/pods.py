"""PODS: the segments whose outcomes differ most."""

from __future__ import annotations

import jax.numpy as jnp

from sauna.algorithm.selection.scores import check_range, check_share, count_of
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def pods(setup: SamplerSetup, length: int = 64, share: float = 0.5) -> Sampler:
    """Keeps the segments that give their scores the largest variance.

    A segment is `length` steps of one env, or its whole rollout if that is shorter. Its score is
    the sum of A. The j highest and `m - j` lowest scores are kept, with the best j, which is the
    best subset of m (the smallest j where several are as good).
    Source: Xu et al. 2025, arXiv 2504.13818, there on whole answers of a language model.
    """
    check_share(share)
    check_range("length", length, 1)
    if length != int(length):
        raise ValueError(f"length must be a whole number of steps, not {length}")
    steps, envs = setup.rollout_steps, setup.envs
    length = min(int(length), steps)
    pieces = -(-steps // length)
    count = count_of(share, pieces * envs)

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        advantage = (samples.advantage * samples.present).reshape(steps, envs)
        padded = jnp.pad(advantage, [(0, pieces * length - steps), (0, 0)])
        score = padded.reshape(pieces, length, envs).sum(1)
        chosen = widest(score.ravel(), count).reshape(score.shape)

        def per_row(x: Array) -> Array:
            return jnp.repeat(x, length, 0)[:steps].ravel()

        keep = per_row(chosen) & samples.present
        return state, Choice(keep=keep, score=per_row(jnp.abs(score - jnp.mean(score))))

    return Sampler(lambda: (), choose, share=min(1.0, count * length / setup.rows))


def widest(score: Array, count: int) -> Array:
    """Marks the `count` of `[G]` scores that have the largest variance."""
    order = jnp.argsort(-score, stable=True)
    centred = score[order] - jnp.mean(score)
    zero = jnp.zeros(1)
    sums, squares = (jnp.concatenate([zero, jnp.cumsum(x)]) for x in (centred, centred**2))
    high = jnp.arange(count + 1)  # how many of the highest
    low = len(score) - (count - high)  # where the lowest begin

    def total(x: Array) -> Array:
        return x[high] + x[-1] - x[low]

    variance = total(squares) / count - (total(sums) / count) ** 2
    best = jnp.argmax(variance)
    place = jnp.arange(len(score))
    chosen = (place < best) | (place >= len(score) - (count - best))
    return jnp.zeros(len(score), bool).at[order].set(chosen)
