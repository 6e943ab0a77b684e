"""Filters against plain Python with `statistics.median`, and the stretch-wise decision."""

from __future__ import annotations

import statistics

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import configured
from sauna.selection.filters import (
    Filter,
    decide,
    empty_history,
    insert,
    make_filter,
    median,
    random_drop,
    sauna_joint,
    sauna_per_env,
)
from test_losses import hypers


def run(filter: Filter, vex: np.ndarray, threshold: float = 0.3, rate: float = 0.0) -> np.ndarray:
    """The filter's mask `[S, N]`, decided step by step."""
    state = filter.init(vex.shape[1], len(vex))
    h = jax.tree.map(np.float32, hypers(threshold=threshold, drop_rate=rate))
    masks, keep = [], jax.jit(filter.keep)
    for t, x in enumerate(vex):
        key = jax.random.fold_in(jax.random.key(5), t)
        state, mask = keep(state, jnp.zeros((vex.shape[1], 2)), jnp.asarray(x), key, h)
        masks.append(np.asarray(mask))
    return np.stack(masks)


def loop_per_env(vex: np.ndarray, threshold: float, kept_only: bool) -> np.ndarray:
    mask = np.zeros(vex.shape, bool)
    for n in range(vex.shape[1]):
        seen: list[float] = []
        for t in range(len(vex)):
            x = float(vex[t, n])
            keep = not seen or abs(x) / (abs(statistics.median(seen)) + 1e-8) >= threshold
            mask[t, n] = keep
            if keep or not kept_only:
                seen.append(x)
    return mask


def loop_joint(vex: np.ndarray, threshold: float, kept_only: bool) -> np.ndarray:
    mask, seen = np.zeros(vex.shape, bool), []
    for t in range(len(vex)):
        middle = abs(statistics.median(seen)) if seen else 0.0
        keep = not seen or abs(float(np.mean(vex[t]))) / (middle + 1e-8) >= threshold
        mask[t] = keep
        if keep or not kept_only:
            seen.extend(float(x) for x in vex[t])
    return mask


@pytest.mark.parametrize("history", ["all", "kept"])
@pytest.mark.parametrize("make, loop", [(sauna_per_env, loop_per_env), (sauna_joint, loop_joint)])
@pytest.mark.parametrize("threshold", [0.0, 0.3, 0.8, 1.5])
def test_equals_plain_python(make, loop, history: str, threshold: float) -> None:
    vex = np.random.default_rng(3).normal(0.6, 0.7, (60, 3)).astype(np.float32)
    expected = loop(vex, threshold, history == "kept")
    most = int(expected.sum(0).max())  # kept steps of one env: what a history of these must hold
    np.testing.assert_array_equal(run(make(history, most), vex, threshold), expected)
    if threshold == 0.8:
        assert 0.1 < expected.mean() < 0.95  # the comparison saw both decisions


def test_the_four_sauna_rules_differ() -> None:
    """A negative control for the test above: no two of the loops are the same rule."""
    vex = np.random.default_rng(3).normal(0.6, 0.7, (60, 3)).astype(np.float32)
    masks = [loop(vex, 0.8, kept).tobytes() for loop in (loop_per_env, loop_joint)
             for kept in (False, True)]  # fmt: skip
    assert len(set(masks)) == 4


def test_the_first_step_is_always_kept() -> None:
    vex = np.zeros((3, 2), np.float32)
    np.testing.assert_array_equal(run(sauna_per_env("all", 8), vex)[0], [True, True])
    assert not run(sauna_per_env("all", 8), vex)[1:].any()  # |0| / (0 + eps) < 0.3


def test_threshold_0_keeps_everything_even_nan() -> None:
    vex = np.array([[1.0], [np.nan], [0.0], [-3.0]], np.float32)
    assert run(sauna_per_env("all", 8), vex, 0.0).all()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6, width=32, allow_subnormal=False), min_size=1, max_size=30))
def test_running_median(values: list[float]) -> None:
    history = empty_history((), 30)
    assert float(median(history)) == 0.0
    for i, x in enumerate(values):
        history = insert(history, jnp.float32(x))
        expected = np.median(np.array(values[: i + 1], np.float32))
        np.testing.assert_allclose(float(median(history)), expected, rtol=1e-6)


def test_random_drop_drops_at_its_rate_whatever_the_head_says() -> None:
    vex = np.random.default_rng(0).normal(size=(400, 8)).astype(np.float32)
    kept = run(random_drop(), vex, rate=0.25)
    assert abs(kept.mean() - 0.75) < 0.03
    np.testing.assert_array_equal(kept, run(random_drop(), -vex * 0, rate=0.25))
    assert run(random_drop(), vex, rate=0.0).all()


@pytest.mark.parametrize("name", ["sauna", "random-drop"])
def test_deciding_in_stretches_is_deciding_step_by_step(name: str) -> None:
    """Whatever the stretches, whatever lies behind their length."""
    settings = {"drop_rate": 0.3} if name == "random-drop" else {"threshold": 0.8}
    config = configured(arm="random-drop" if name == "random-drop" else "sauna", **settings)
    filter = make_filter(config)
    assert filter is not None
    vex = np.random.default_rng(1).normal(0.5, 0.5, (50, 2)).astype(np.float32)
    h = jax.tree.map(np.float32, hypers(threshold=0.8, drop_rate=0.3))
    expected = run(filter, vex, 0.8, 0.3)
    state, t, got = filter.init(2, 50), 0, []
    for length in (1, 20, 3, 26):
        padded = np.full((30, 2), 99.0, np.float32)
        padded[:length] = vex[t : t + length]
        state, mask = decide(
            filter,
            state,
            jnp.zeros((30, 2, 4)),
            jnp.asarray(padded),
            t,
            length,
            jax.random.key(5),
            h,
        )
        assert not np.asarray(mask)[length:].any()
        got.append(np.asarray(mask)[:length])
        t += length
    np.testing.assert_array_equal(np.concatenate(got), expected)


def test_no_filter_is_none() -> None:
    assert make_filter(configured(arm="ppo")) is None
