"""Recurrent policies: numpy as the oracle, episodes apart, and steps equal to sequences."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import configured
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.envs.spaces import Spaces

VECTOR = Spaces("vector", (3,), "continuous", (2,), "", "")
WIDTH, STEPS, ENVS = 5, 7, 2
TRUNKS = {"lstm": "separate", "gru": "shared"}
SIZES = {"lstm": 2 * WIDTH, "gru": WIDTH}
both = pytest.mark.parametrize("cell", SIZES)


@functools.cache
def made(cell: str) -> tuple[Policy, Any]:
    """An LSTM behind separate trunks, or a GRU behind a shared one; compiled."""
    trunk = TRUNKS[cell]
    settings = {"recurrent": cell, "recurrent_width": WIDTH, "hidden": "4", "trunk": trunk}
    policy = make_policy(configured(**settings), VECTOR)
    params = np.asarray(jax.jit(policy.init)(jax.random.key(0)))
    policy = policy._replace(unroll=jax.jit(policy.unroll))  # type: ignore[arg-type]
    rng = np.random.default_rng(1)
    return policy, params + 0.3 * rng.normal(size=params.shape).astype(np.float32)


def stream(policy: Policy, seed: int = 0) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(seed)
    seen = rng.normal(size=(STEPS, ENVS, 3)).astype(np.float32)
    state = rng.normal(size=(ENVS, policy.state_size)).astype(np.float32)
    start = np.zeros((STEPS, ENVS), bool)
    start[3, 0] = start[5, 1] = start[6, 1] = True
    return seen, start, state


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def by_hand(cell: str, of: Any, x: np.ndarray, state: np.ndarray) -> np.ndarray:
    """The state after one step, in numpy; h is its last part."""
    inputs = x @ of["input"]["kernel"] + of["input"]["bias"]
    u, w = np.asarray(of["recurrent_kernel"]), WIDTH
    if cell == "lstm":
        c, h = state[:, :w], state[:, w:]
        i, f, g, o = (inputs[:, k * w : k * w + w] + h @ u[:, k * w : k * w + w] for k in range(4))
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        return np.concatenate([c, sigmoid(o) * np.tanh(c)], 1)
    r = sigmoid(inputs[:, :w] + state @ u[:, :w])
    z = sigmoid(inputs[:, w : 2 * w] + state @ u[:, w : 2 * w])
    n = np.tanh(inputs[:, 2 * w :] + r * (state @ u[:, 2 * w :] + of["recurrent_bias"]))
    return (1 - z) * n + z * state


@both
def test_the_network_is_what_it_says(cell: str) -> None:
    """Step by step in numpy: trunk, cell, heads; the state is zero where an episode starts."""
    policy, params = made(cell)
    seen, start, state = stream(policy)
    output = policy.unroll(params, seen, start, state)
    tree = jax.tree.map(np.asarray, policy.unravel(params)["params"])
    names = [("trunk", "cell")]
    if cell == "lstm":
        names = [("policy_trunk", "policy_cell"), ("value_trunk", "value_cell")]
    assert policy.state_size == SIZES[cell] * len(names)
    states = np.split(state, len(names), 1)
    for t in range(STEPS):
        features = []
        for k, (of_trunk, of_cell) in enumerate(names):
            layer = tree[of_trunk]["layer_0"]
            x = np.tanh(seen[t] @ layer["kernel"] + layer["bias"])
            before = np.where(start[t][:, None], 0, states[k])
            states[k] = by_hand(cell, tree[of_cell], x, before)
            features.append(states[k][:, -WIDTH:])
        heads = {"policy_head": output.policy[t][:, :2], "value_head": output.value[t][:, None]}
        heads["vex_head"] = output.vex[t][:, None]
        for name, got in heads.items():
            x = features[0 if name == "policy_head" else -1]
            wanted = x @ tree[name]["kernel"] + tree[name]["bias"]
            np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(output.hidden[t], features[0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(output.state, np.concatenate(states, 1), rtol=1e-4, atol=1e-5)


@both
def test_steps_give_what_sequences_from_stored_states_give(cell: str) -> None:
    policy, params = made(cell)
    seen, start, state = stream(policy)
    whole = policy.unroll(params, seen, start, state)
    stored: list[Any] = []
    values = []
    for t in range(STEPS):
        state = np.where(start[t][:, None], 0, state)
        stored.append(state)
        output, state = policy.step(params, seen[t], state)
        values.append(output.value)
    np.testing.assert_allclose(whole.value, values, rtol=1e-4, atol=1e-5)
    later = policy.unroll(params, seen[4:], start[4:], stored[4])
    np.testing.assert_allclose(whole.policy[4:], later.policy, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(state, whole.state, rtol=1e-4, atol=1e-5)


def test_an_episode_knows_nothing_of_the_one_before() -> None:
    """Its gradient reaches every step of its own, and none before its start."""
    policy, params = made("lstm")
    seen, start, state = stream(policy)

    def value(seen: Any, state: Any) -> Any:
        return policy.unroll(params, seen, start, state).value[5, 0]  # begun at row 3

    of_seen, of_state = jax.jit(jax.grad(value, (0, 1)))(jnp.asarray(seen), jnp.asarray(state))
    reaches = np.abs(of_seen[:, 0]).sum(-1) > 0
    assert reaches.tolist() == [False] * 3 + [True] * 3 + [False]
    assert not np.abs(of_seen[:, 1]).any() and not np.abs(of_state).any()


def test_the_first_parameters_are_those_that_the_page_names() -> None:
    policy = make_policy(configured(recurrent="lstm", recurrent_width=WIDTH, hidden="4"), VECTOR)
    tree = policy.unravel(jax.jit(policy.init)(jax.random.key(0)))["params"]
    cell = tree["policy_cell"]
    forget = [0.0] * WIDTH + [1.0] * WIDTH + [0.0] * 2 * WIDTH
    assert np.asarray(cell["input"]["bias"]).tolist() == forget
    kernel = np.asarray(cell["recurrent_kernel"])
    np.testing.assert_allclose(kernel @ kernel.T, np.eye(WIDTH), atol=1e-5)
    assert not np.array_equal(kernel, tree["value_cell"]["recurrent_kernel"])


def test_a_policy_without_a_memory_has_an_empty_state() -> None:
    policy = make_policy(configured(hidden="4"), VECTOR)
    params, seen = jax.jit(policy.init)(jax.random.key(0)), np.ones((2, 3), np.float32)
    output, state = policy.step(params, seen, policy.initial_state(2))
    assert state == () and policy.state_size == 0 and output.state == ()
    np.testing.assert_array_equal(output.value, policy.apply(params, seen).value)
    with pytest.raises(TypeError, match="takes a state"):
        recurrent, params = made("gru")
        recurrent.apply(params, seen)
