"""Sequences: where rows go, which count, and by how much. Numbers by hand and identities."""

from __future__ import annotations

import functools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arrays import hypers, parts_of, random_rollout
from helpers import configured
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.sequence_choice import (
    choice_of_sequences,
    minibatches_of_sequences,
    rows_of_sequences,
)
from sauna.algorithm.learner.sequences import (
    as_rows,
    cut,
    in_sequences,
    joined,
    put_back,
    row_outputs,
)
from sauna.algorithm.learner.update import minibatch_losses
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.selection.registry import Rules
from sauna.algorithm.types import Batch, Choice, Draw, Memory, Rollout, Sampler
from sauna.envs.spaces import Spaces

LENGTH, STEPS, ENVS = 4, 8, 2
SPACES = Spaces("vector", (2,), "continuous", (1,), "", "")
SETTINGS = {"recurrent": "gru", "recurrent_width": 3, "sequence_length": LENGTH, "hidden": "3"}
SHAPE = {"rollout_steps": STEPS, "envs": ENVS, "minibatches": 2}


@functools.cache
def setup(arm: str = "ppo", keep_rate: float = 1.0, **settings: Any) -> Any:
    config = configured(arm=arm, **SETTINGS, **SHAPE, **settings)
    policy = make_policy(config, SPACES)
    parts = parts_of(config, policy)
    rollout = random_rollout(3, STEPS, ENVS, keep_rate)
    ended = rollout.terminated | rollout.truncated
    start = np.concatenate([np.zeros((1, ENVS), bool), ended[:-1]])
    state = np.random.default_rng(5).normal(size=(STEPS // LENGTH, ENVS, policy.state_size))
    rollout = rollout._replace(memory=Memory(start, state))
    rollout = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32 if x.dtype == float else None), rollout
    )
    make = jax.jit(partial(make_batch, config=config, target=parts.target))
    batch = make(rollout, hypers(), jax.random.key(0))
    return parts, rollout, batch, jax.jit(policy.init)(jax.random.key(1))


def test_a_sequence_is_consecutive_rows_of_one_env() -> None:
    row = np.arange(STEPS * ENVS).reshape(STEPS, ENVS)  # t * N + n
    assert np.asarray(cut(row, LENGTH)).tolist() == [
        [0, 2, 4, 6],
        [1, 3, 5, 7],
        [8, 10, 12, 14],
        [9, 11, 13, 15],
    ]
    np.testing.assert_array_equal(joined(cut(row, LENGTH), ENVS), row)
    back = put_back(jnp.array([7.0, 8.0]), jnp.array([4, 1]), row)
    assert np.argwhere(back).tolist() == [[0, 1], [2, 0]]


def test_samples_go_back_to_their_rows() -> None:
    """A dropped step has weight 0 at its own place; the network sees it all the same."""
    _, rollout, batch, _ = setup("sauna", 0.5)
    sequences = in_sequences(batch, rollout, LENGTH)
    np.testing.assert_array_equal(joined(sequences.weight, ENVS), rollout.keep)
    np.testing.assert_array_equal(joined(sequences.observation, ENVS), rollout.observation)
    kept = np.asarray(rollout.keep)
    np.testing.assert_allclose(joined(sequences.value, ENVS)[kept], rollout.value[kept])
    assert 0 < kept.sum() < kept.size
    state = sequences.memory.state
    np.testing.assert_array_equal(state[2 * 1 + 0], rollout.memory.state[1, 0])
    rows = as_rows(sequences)
    assert rows.weight.shape == (STEPS * ENVS,) and rows.memory.state.shape == (4, 6)


def test_the_outputs_of_samples_are_those_of_their_rows() -> None:
    parts, rollout, batch, params = setup("sauna", 0.5)
    found = jax.jit(partial(row_outputs, parts.policy, length=LENGTH))(params, batch, rollout)
    seen, start, state = rollout.observation, rollout.memory.start, rollout.memory.state
    unroll = jax.jit(parts.policy.unroll)
    for c in range(STEPS // LENGTH):
        rows = slice(c * LENGTH, c * LENGTH + LENGTH)
        direct = unroll(params, seen[rows], start[rows], state[c])
        for i, row in enumerate(np.asarray(batch.row)):
            t, n = divmod(int(row), ENVS)
            if c * LENGTH <= t < (c + 1) * LENGTH:
                np.testing.assert_allclose(found.value[i], direct.value[t % LENGTH, n], rtol=1e-5)


def everything(number: int = 4) -> Draw:
    rows = jnp.arange(number, dtype=jnp.int32)
    return Draw(rows, rows, jnp.int32(number))


ALL = (jnp.arange(4), jnp.ones(4, bool))


def test_a_dropped_row_counts_for_nothing_but_the_memory() -> None:
    parts, rollout, batch, params = setup()
    keep = np.arange(STEPS * ENVS) % 3 != 0
    choice = Choice(keep=jnp.asarray(keep))

    @jax.jit
    def total(rollout: Rollout, batch: Batch) -> Any:
        make = minibatches_of_sequences(batch, choice, everything(), rollout, None, parts=parts)
        return minibatch_losses(params, make(*ALL), hypers(), parts=parts).total

    plain = float(total(rollout, batch))
    dropped = jnp.asarray(~keep)
    other = batch._replace(advantage=jnp.where(dropped, 50.0, batch.advantage))
    other = other._replace(return_=jnp.where(dropped, -9.0, batch.return_))
    assert float(total(rollout, other)) == pytest.approx(plain, rel=1e-6)
    t, n = divmod(int(np.flatnonzero(~keep)[1]), ENVS)
    assert t % LENGTH < LENGTH - 1 and not bool(rollout.memory.start[t + 1, n])
    seen = rollout.observation.at[t, n].add(1.0)
    assert float(total(rollout._replace(observation=seen), batch)) != pytest.approx(plain, rel=1e-6)
    kept = batch._replace(advantage=jnp.where(dropped, batch.advantage, 50.0))
    assert float(total(rollout, kept)) != pytest.approx(plain, rel=1e-3)


@pytest.mark.parametrize("on_mean", [True, False])
def test_a_choice_for_the_mean_masks_no_row_of_a_sequence(on_mean: bool) -> None:
    """Each kept row's gradient of the mean is multiplied by rows / kept rows, the others' by 0."""
    parts, rollout, batch, _ = setup(arm="kondo")
    nothing: Any = None
    parts = parts._replace(rules=Rules(Sampler(nothing, nothing, on_mean=on_mean)))
    keep = np.arange(STEPS * ENVS) % 4 == 0
    choice = Choice(keep=jnp.asarray(keep))
    make = minibatches_of_sequences(batch, choice, everything(), rollout, None, parts=parts)
    part = make(*ALL)
    rows = cut(np.arange(STEPS * ENVS).reshape(STEPS, ENVS), LENGTH).ravel()
    kept = np.zeros(STEPS * ENVS)
    kept[np.asarray(batch.row)[keep]] = 1.0
    np.testing.assert_array_equal(part.policy_mask, 1.0 if on_mean else kept[rows])
    if on_mean:
        np.testing.assert_allclose(part.mean_scale, 4.0 * kept[rows])
    else:
        assert part.mean_scale is None


def test_a_sequence_without_a_kept_row_is_left_out() -> None:
    _, rollout, batch, _ = setup()
    keep = jnp.zeros(STEPS * ENVS, bool).at[jnp.array([3, 5])].set(True)
    found = choice_of_sequences(Choice(keep=keep), batch, rollout, LENGTH)
    assert found.keep.tolist() == [False, True, False, False]
    spread = rows_of_sequences(found.keep, batch, rollout, LENGTH)
    assert np.flatnonzero(spread).tolist() == [1, 3, 5, 7]


def test_drawn_sequences_have_the_mean_of_drawn_rows() -> None:
    """`sum_k P_k sum_j (p_j / P_k) l_j = sum_j p_j l_j`, of policy and of value rows."""
    parts, rollout, batch, _ = setup(arm="gradient-norm")
    p, q = (jax.random.dirichlet(jax.random.key(i), jnp.ones(16)) for i in range(2))
    scale = jnp.linspace(0.5, 2.0, 16)
    choice = Choice(probability=p, weight=scale, value_probability=q, value_weight=1.0 / scale)
    drawn = choice_of_sequences(choice, batch, rollout, LENGTH)
    np.testing.assert_allclose(jnp.sum(drawn.probability), 1.0, rtol=1e-5)
    make = minibatches_of_sequences(batch, choice, everything(), rollout, q, parts=parts)
    terms = np.random.default_rng(0).normal(size=16)
    by_row = {int(row): i for i, row in enumerate(np.asarray(batch.row))}
    make = jax.jit(make)
    for name, of_row, of_sequence in (
        ("policy", p, drawn.probability),
        ("value", q, drawn.value_probability),
    ):
        expected = 0.0
        for k in range(4):
            part = make(jnp.array([k]), jnp.ones(1, bool))
            mask, weight = getattr(part, f"{name}_mask"), getattr(part, f"{name}_scale")
            assert float(jnp.sum(mask)) == pytest.approx(1.0, rel=1e-5)
            own = [by_row[int(r)] for r in cut(np.arange(16).reshape(STEPS, ENVS), LENGTH)[k]]
            expected += float(of_sequence[k]) * float(np.sum(mask * weight * terms[own]))
        weights = scale if name == "policy" else 1.0 / scale
        assert expected == pytest.approx(float(jnp.sum(of_row * weights * terms)), rel=1e-4)
