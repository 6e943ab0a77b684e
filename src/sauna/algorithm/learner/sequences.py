"""Sequences of env steps, which are what a recurrent policy's minibatches are made of.

A rollout `[S, N]` is cut into `K = C * N` sequences of L env steps, each with the state that the
policy had before it while acting: sequence `c * N + n` holds rows `c * L` to `c * L + L` of
environment n. The network runs through all rows of a sequence. A row that a filter or a rule drops
has weight 0 in the losses; a sequence without any row that counts is left out.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from sauna.algorithm.learner.replay import pool_rows
from sauna.algorithm.learner.samples import next_observations
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.types import Array, Batch, Memory, PolicyOutput, Rollout
from sauna.config.settings import Config


def units(config: Config) -> int:
    """What is shuffled in an epoch: M rows, or all sequences of a recurrent policy's rollout."""
    if config.recurrent == "none":
        return pool_rows(config)
    return capacity(config) // config.sequence_length * config.envs


def cut(x: Array, length: int) -> Array:
    """`[S, N, ...]` -> sequences `[K, L, ...]`."""
    envs, rest = x.shape[1], x.shape[2:]
    parts = x.reshape(-1, length, envs, *rest)
    return parts.swapaxes(1, 2).reshape(-1, length, *rest)


def joined(x: Array, envs: int) -> Array:
    """Sequences `[K, L, ...]` -> `[S, N, ...]`: the inverse of `cut`."""
    length, rest = x.shape[1], x.shape[2:]
    parts = x.reshape(-1, envs, length, *rest)
    return parts.swapaxes(1, 2).reshape(-1, envs, *rest)


def put_back(x: Array, row: Array, like: Array) -> Array:
    """Samples `[T * N]` at their rows of the rollout, shaped as `like` `[S, N]`; 0 elsewhere."""
    return jnp.zeros(like.size, x.dtype).at[row].set(x).reshape(like.shape)


def in_sequences(batch: Batch, rollout: Rollout, length: int) -> Batch:
    """The samples `[T * N]` of a rollout among all its rows, as sequences `[K, L, ...]`."""
    sequence_of = to_sequences(batch, rollout, length)
    following = weight = None
    if batch.next_weight is not None:
        following = cut(next_observations(rollout)[0], length)
        weight = sequence_of(batch.next_weight)
    return Batch(
        cut(rollout.observation, length),
        cut(rollout.action, length),
        cut(rollout.log_prob, length),
        sequence_of(batch.advantage),
        sequence_of(batch.return_),
        sequence_of(batch.value),
        sequence_of(batch.vex_target),
        sequence_of(batch.weight),
        next_observation=following,
        next_weight=weight,
        memory=_memory(rollout, length),
    )


def to_sequences(batch: Batch, rollout: Rollout, length: int) -> Callable[[Array], Array]:
    """A function from samples `[T * N]` to sequences `[K, L]`; a row that is no sample gets 0."""
    return lambda x: cut(put_back(x, batch.row, rollout.reward), length)


def _memory(rollout: Rollout, length: int) -> Memory:
    """What sequences begin with: `start` `[K, L]`, `state` `[K, H]`."""
    start, state = rollout.memory
    return Memory(cut(start, length), state.reshape(-1, state.shape[-1]))


def as_rows(batch: Batch) -> Batch:
    """Sequences `[B, L, ...]` as rows `[B * L, ...]`; `memory` stays that of the sequences."""
    rows = jax.tree.map(flat, batch._replace(memory=None))
    return rows._replace(memory=batch.memory)


def flat(x: Array) -> Array:
    """`[B, L, ...]` -> `[B * L, ...]`."""
    return x.reshape(-1, *x.shape[2:])


def outputs(
    policy: Policy, params: Array, observation: Array, memory: Memory | None
) -> PolicyOutput:
    """What the network gives for rows `[B, ...]`.

    Args:
      memory: of a recurrent policy, whose rows are those of sequences, one after the other: `start`
        `[B / L, L]` and `state` `[B / L, H]`.
    """
    if memory is None or policy.unroll is None:
        return policy.apply(params, observation)
    seen = observation.reshape(*memory.start.shape, *observation.shape[1:])
    found = policy.unroll(params, seen.swapaxes(0, 1), memory.start.T, memory.state)
    found = found._replace(state=())
    return jax.tree.map(lambda x: flat(x.swapaxes(0, 1)), found)


def rollout_outputs(policy: Policy, params: Array, rollout: Rollout, length: int) -> PolicyOutput:
    """What today's network gives `[S, N, ...]`, from the states of collection at each chunk."""
    if rollout.memory is None:
        return policy.apply(params, rollout.observation)
    seen, memory = cut(rollout.observation, length), _memory(rollout, length)
    found, envs = outputs(policy, params, flat(seen), memory), rollout.reward.shape[1]
    return jax.tree.map(lambda x: joined(x.reshape(-1, length, *x.shape[1:]), envs), found)


def row_outputs(
    policy: Policy, params: Array, batch: Batch, rollout: Rollout, length: int
) -> PolicyOutput:
    """What today's network gives for the samples `[T * N, ...]` of a rollout."""
    if rollout.memory is None:
        return policy.apply(params, batch.observation)
    found = rollout_outputs(policy, params, rollout, length)
    return jax.tree.map(lambda x: flat(x)[batch.row], found)
