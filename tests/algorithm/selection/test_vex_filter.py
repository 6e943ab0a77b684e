"""Filters against plain Python with `statistics.median`, and the segment-wise decision."""

from __future__ import annotations

import math
import statistics

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arrays import hypers, unscored
from helpers import configured, equal, make_job, own, resumed, train_here
from sauna.algorithm.rollout.program import decide
from sauna.algorithm.selection import vex_filter
from sauna.algorithm.selection.history import empty_history, insert, median
from sauna.algorithm.selection.random_drop import random_drop
from sauna.algorithm.selection.registry import make_filter
from sauna.algorithm.selection.vex_filter import (
    moved_threshold,
    sauna_at_rate,
    sauna_joint,
    sauna_per_env,
    threshold_for_rate,
)
from sauna.algorithm.types import StepFilter
from sauna.system.errors import BadInput
from sauna.training.loop.budget import hypers_now
from sauna.training.loop.member_state import Counters
from sauna.training.loop.schedules import shaped


def run(
    filter: StepFilter, vex: np.ndarray, threshold: float = 0.3, rate: float = 0.0
) -> np.ndarray:
    """The filter's mask `[S, N]`, decided step by step."""
    state = filter.init(vex.shape[1], len(vex))
    h = jax.tree.map(np.float32, hypers(threshold=threshold, drop_rate=rate))
    masks, keep = [], jax.jit(filter.keep)
    for t, x in enumerate(vex):
        key = jax.random.fold_in(jax.random.key(5), t)
        state, mask = keep(state, unscored(jnp.zeros((vex.shape[1], 2)), jnp.asarray(x)), key, h)
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
    masks = [
        loop(vex, 0.8, kept).tobytes()
        for loop in (loop_per_env, loop_joint)
        for kept in (False, True)
    ]
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
def test_deciding_in_segments_is_deciding_step_by_step(name: str) -> None:
    """Whatever the segments, whatever lies behind their length."""
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
            unscored(jnp.zeros((30, 2, 4)), jnp.asarray(padded)),
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


def loop_at_rate(vex: np.ndarray, rate: float, settle: int) -> np.ndarray:
    mask = np.zeros(vex.shape, bool)
    for n in range(vex.shape[1]):
        seen: list[float] = []
        kept = 0
        for t in range(len(vex)):
            size = abs(float(vex[t, n]))
            level = (1 - rate) + (kept - rate * t) / settle
            rank = math.floor(level * (t + 1))
            least = -math.inf if rank < 1 else math.inf if rank > t else sorted(seen)[rank - 1]
            mask[t, n] = size >= least
            kept += bool(mask[t, n])
            seen.append(size)
    return mask


@pytest.mark.parametrize("rate", [0.25, 0.7, 1.0])
def test_a_held_keep_rate_equals_plain_python(rate: float) -> None:
    vex = np.random.default_rng(4).normal(0.5, 0.7, (90, 2)).astype(np.float32)
    got = run(sauna_at_rate(rate), vex)
    expected = loop_at_rate(vex, rate, vex_filter.SETTLE)
    assert (got != expected).mean() < 0.02  # float32 may round a level to the other rank
    assert got.all() == (rate == 1.0)


@pytest.mark.parametrize("kind", ["near 1", "wide", "rising", "falling", "negative"])
@pytest.mark.parametrize("rate", [0.3, 0.8])
def test_a_keep_rate_is_held_whatever_the_predictions(kind: str, rate: float) -> None:
    """Also where they differ by a thousandth, or drift all the time; a fixed ratio does not."""
    random, steps = np.random.default_rng(0), 1000
    vex = {
        "near 1": 1 + 1e-3 * random.normal(size=steps),
        "wide": random.normal(0.3, 1.0, steps),
        "rising": np.linspace(0.1, 1, steps) + 0.1 * random.normal(size=steps),
        "falling": np.linspace(1, 0.1, steps) + 0.1 * random.normal(size=steps),
        "negative": -np.exp(random.normal(size=steps)),
    }[kind]
    vex = np.stack([vex, vex[::-1]], 1).astype(np.float32)
    got = run_quickly(sauna_at_rate(rate), vex)
    assert np.abs(got.mean(0) - rate).max() < 0.06
    if kind == "near 1":
        assert run_quickly(sauna_per_env("all", steps), vex, 0.8).all()


def run_quickly(filter: StepFilter, vex: np.ndarray, threshold: float = 0.3) -> np.ndarray:
    h = jax.tree.map(np.float32, hypers(threshold=threshold))
    state = filter.init(vex.shape[1], len(vex))
    none = jnp.zeros((len(vex), vex.shape[1], 1))
    call = jax.jit(lambda *a: decide(filter, *a, h))
    mask = call(state, unscored(none, jnp.asarray(vex)), 0, len(vex), jax.random.key(0))[1]
    return np.asarray(mask)


def test_threshold_0_switches_a_held_rate_off() -> None:
    vex = np.random.default_rng(4).normal(size=(50, 2)).astype(np.float32)
    assert not run(sauna_at_rate(0.3), vex).all() and run(sauna_at_rate(0.3), vex, 0.0).all()


def test_the_threshold_that_is_told_would_keep_the_rate() -> None:
    vex = np.random.default_rng(5).normal(0.5, 0.3, (200, 2)).astype(np.float32)
    valid = np.ones(vex.shape, bool)
    valid[150:, 1] = False
    threshold = float(threshold_for_rate(jnp.asarray(vex), jnp.asarray(valid), 0.6))
    ratio = np.abs(vex[valid]) / abs(np.median(vex[valid]))
    assert abs((ratio >= threshold).mean() - 0.6) < 0.01


def test_a_schedule_is_linear_in_what_is_left() -> None:
    assert [shaped(0.8, "constant", left) for left in (1.0, 0.25)] == [0.8, 0.8]
    np.testing.assert_allclose([shaped(0.8, "rising", x) for x in (1, 0.25, 0)], [0, 0.6, 0.8])
    np.testing.assert_allclose([shaped(0.8, "falling", x) for x in (1, 0.25)], [0.8, 0.2])


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"keep_rate_target": 0.5, "threshold": 0.8}, "threshold: not read"),
        ({"keep_rate_target": 0.5, "threshold_schedule": "rising"}, "threshold_schedule: not read"),
        ({"keep_rate_target": 0.5, "history": "kept"}, "needs history=all"),
        ({"keep_rate_target": 1.5}, "at most 1"),
        ({"keep_rate_target": 0.5, "arm": "sauna-reference"}, "needs history=all"),
        ({"keep_rate_target": 0.5, "arm": "ppo"}, "keep_rate_target: not read"),
        ({"threshold_schedule": "rising", "arm": "vex-head"}, "threshold_schedule: not read"),
        ({"threshold_schedule": "linear"}, "unknown value 'linear'"),
    ],
)
def test_settings_of_the_threshold_that_contradict_are_refused(settings, message) -> None:
    with pytest.raises(BadInput, match=message):
        configured(**{"arm": "sauna", **settings})


def test_a_schedule_follows_the_env_steps() -> None:
    for schedule, expected in (("constant", 0.8), ("rising", 0.2), ("falling", 0.6)):
        config = configured(arm="sauna", threshold=0.8, threshold_schedule=schedule, steps=10_000)
        now = hypers_now(config, Counters(env_steps=2_500, kept_steps=9))
        np.testing.assert_allclose(now.threshold, expected, rtol=1e-6)
        moved = moved_threshold(None, now, config)  # type: ignore[arg-type] # no rollout is read
        np.testing.assert_allclose(moved, np.nan if schedule == "constant" else expected, rtol=1e-6)
        assert float(now.learning_rate) == np.float32(3e-4 * 0.75)


def test_a_held_rate_is_held_resumed_exactly_and_leaves_ppo_beside_it_alone() -> None:
    common = {"env": "small_envs:Scripted", "steps": 512, "rollout_steps": 64, "envs": 2}
    job = make_job(arm="ppo,sauna", keep_rate_target=0.5, **common)
    whole, first = train_here(job), train_here(job, 2)
    rest = train_here(resumed(job, first))
    assert equal(whole.final, rest.final) and whole.rows == first.rows + rest.rows
    rows = [row for row in whole.rows if row["arm"] == "sauna"]
    assert all(abs(row["keep_rate"] - 0.5) < 0.1 and row["threshold"] > 0 for row in rows)
    alone = train_here(make_job(arm="ppo", **common))
    assert equal(own(whole.final, "ppo/0"), own(alone.final, "ppo/0"))
    assert [row for row in whole.rows if row["arm"] == "ppo"] == alone.rows
