"""Matched controls: as many rows as the rule, chosen as numpy says; weights given to other rows."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithm.selection import oracle
from sauna.algorithm.selection.control import (
    controlled,
    controlled_filter,
    controlled_weight,
    matched,
)
from sauna.algorithm.selection.delight import delight
from sauna.algorithm.selection.gigaflow import gigaflow
from sauna.algorithm.selection.gradient_norm import gradient_norm
from sauna.algorithm.selection.prioritized import prioritized
from sauna.algorithm.selection.sample_dropout import sample_dropout
from sauna.algorithm.selection.top_advantage import top_advantage
from sauna.algorithm.types import Choice, LossTerms, Sampler
from sauna.system.errors import BadInput
from selections import SETUP, chosen, of_present, random_samples, spread

KINDS = ("random", "stride", "low-advantage", "reversed")


@pytest.mark.parametrize("kind", KINDS)
def test_a_control_takes_as_many_rows_as_its_rule_in_each_rollout(kind: str) -> None:
    """The rule's own count differs from rollout to rollout; its state goes on as without it."""
    rule = gigaflow(SETUP, threshold=0.1)
    control, counts = controlled(kind, rule), []
    plain_state = state = rule.init()
    for seed in range(4):
        s, key = random_samples(seed), jax.random.key(seed)
        plain_state, plain = rule.choose(plain_state, s, key)
        state, choice = control.choose(state, s, key)
        assert state == plain_state
        counts.append(int(plain.keep.sum()))
        assert int(choice.keep.sum()) == counts[-1]
        assert not np.any(choice.keep & ~s.present) and not np.array_equal(choice.keep, plain.keep)
    assert len(set(counts)) > 1
    assert control._replace(choose=rule.choose) == rule, "share and flags stay the rule's"


@pytest.mark.parametrize("seed", range(3))
def test_what_a_control_takes_is_what_numpy_says(seed: int) -> None:
    s = random_samples(seed)
    rule = top_advantage(SETUP, share=0.3)
    keep = chosen(rule, s).keep
    count = int(keep.sum())
    advantage = of_present(s, "advantage")[0]
    expected = {
        "stride": oracle.stride_keep(count, len(advantage)),
        "low-advantage": oracle.low_advantage_keep(advantage, count),
        "reversed": oracle.reversed_keep(np.abs(advantage), count),
    }
    for kind, rows in expected.items():
        got = chosen(controlled(kind, rule), s).keep
        np.testing.assert_array_equal(got, spread(s, rows), err_msg=kind)
        fewer = oracle.stride_keep(count - 1, len(advantage)) if kind == "stride" else ~rows
        assert not np.array_equal(got, spread(s, fewer))


def test_a_stride_is_even_for_every_count() -> None:
    eligible = np.ones(50, bool)
    eligible[::7] = False
    on = np.flatnonzero(eligible)
    stride = jax.jit(lambda keep: matched("stride", keep, ZERO, ZERO, jnp.asarray(eligible), ZERO))
    for count in range(len(on) + 1):
        keep = np.zeros(50, bool)
        keep[on[:count]] = True
        expected = np.zeros(50, bool)
        expected[on[oracle.stride_keep(count, len(on))]] = True
        np.testing.assert_array_equal(stride(jnp.asarray(keep)), expected)


ZERO = jnp.zeros(50)


def test_random_rows_depend_on_the_key_and_not_on_the_advantage() -> None:
    s = random_samples(0)
    control = controlled("random", top_advantage(SETUP, share=0.5))
    one = chosen(control, s).keep
    assert not np.array_equal(one, chosen(control, s, seed=1).keep)
    flipped = s._replace(advantage=jnp.roll(s.advantage, 5))
    np.testing.assert_array_equal(one, chosen(control, flipped).keep)
    taken = np.mean([chosen(control, s, seed=i).keep for i in range(60)], 0)
    on = np.asarray(s.present)
    share = one.sum() / on.sum()
    assert np.abs(taken[on] - share).max() < 5 * np.sqrt(share * (1 - share) / 60)


def test_reversed_takes_equal_scores_at_random() -> None:
    same = Sampler(lambda: (), lambda state, s, key: ((), Choice(keep=HALF, score=jnp.ones(60))))
    taken = [
        chosen(controlled("reversed", same), random_samples(0, absent=0), seed=i).keep
        for i in range(2)
    ]
    assert [x.sum() for x in taken] == [30, 30] and not np.array_equal(*taken)


HALF = jnp.arange(60) < 30


def test_reversed_needs_a_score() -> None:
    scoreless = Sampler(lambda: (), lambda state, s, key: ((), Choice(keep=s.present)))
    with pytest.raises(BadInput, match="reversed needs a sampler whose choice has a score"):
        chosen(controlled("reversed", scoreless), random_samples(0))


def test_controls_of_draws_by_probability() -> None:
    s = random_samples(2)
    on = np.asarray(s.present)
    rule = gradient_norm(SETUP)
    plain = chosen(rule, s)
    even = chosen(controlled("random", rule), s)
    np.testing.assert_allclose(even.probability, on / on.sum(), rtol=1e-6)
    assert even.weight is None and even.value_probability is None
    turned = chosen(controlled("reversed", rule), s)
    for p, weight in (("probability", "weight"), ("value_probability", "value_weight")):
        before, after = getattr(plain, p)[on], getattr(turned, p)[on]
        np.testing.assert_allclose(np.sort(after), np.sort(before), rtol=1e-6)
        order = np.argsort(before)
        np.testing.assert_allclose(after[order], np.sort(before)[::-1], rtol=1e-6)
        pair = np.argsort(after)
        np.testing.assert_allclose(
            getattr(turned, weight)[on][pair], getattr(plain, weight)[on][order], rtol=1e-5
        )
    half = prioritized(SETUP, share=0.5)
    for kind in ("stride", "low-advantage"):
        choice = chosen(controlled(kind, half), s)
        assert choice.probability is None and choice.keep.sum() == np.ceil(0.5 * on.sum())


@pytest.mark.parametrize("kind", ["random", "reversed"])
@pytest.mark.parametrize("rule", [delight(), sample_dropout(0.4)])
def test_a_weights_control_deals_the_same_weights_to_other_rows(kind: str, rule: Any) -> None:
    """Also where rows are absent: an absent row neither takes a weight nor gives one."""
    rng = np.random.default_rng(0)
    for absent in (0.0, 0.3):
        draw = [jnp.asarray(rng.normal(size=40), jnp.float32) for _ in range(4)]
        present = jnp.asarray(rng.random(40) >= absent, jnp.float32)
        terms = LossTerms(*draw, present, True)
        on = np.asarray(present) > 0
        mask, scale = (np.asarray(x) for x in rule.weight(terms))
        new_mask, new_scale = map(np.asarray, controlled_weight(kind, rule).weight(terms))
        before, after = (mask * scale)[on], (new_mask * new_scale)[on]
        np.testing.assert_allclose(np.sort(after), np.sort(before), rtol=1e-6)
        assert not new_mask[~on].any()
        if kind == "random":
            np.testing.assert_allclose(after, np.roll(before, 1), rtol=1e-6)
        else:
            order = np.argsort(-before, kind="stable")
            np.testing.assert_allclose(after[order], np.sort(before), rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_filters_control_keeps_the_first_step_and_as_many_per_env(kind: str) -> None:
    rng = np.random.default_rng(1)
    valid = np.arange(30)[:, None] < np.array([30, 20, 25])
    keep = (rng.random((30, 3)) < 0.4) & valid
    keep[0] = True
    advantage = rng.normal(size=(30, 3)).astype(np.float32)
    given = map(jnp.asarray, (keep, advantage, valid))
    got = np.asarray(controlled_filter(kind, *given, jax.random.key(0)))
    np.testing.assert_array_equal(got.sum(0), keep.sum(0))
    assert got[0].all() and not got[~valid].any() and not np.array_equal(got, keep)
    for n in range(3):
        rest = np.flatnonzero(valid[:, n])[1:]
        count = keep[1:, n].sum()
        expected = {
            "stride": oracle.stride_keep(count, len(rest)),
            "low-advantage": oracle.low_advantage_keep(advantage[rest, n], count),
        }
        if kind in expected:
            np.testing.assert_array_equal(got[rest, n], expected[kind])
        if kind == "reversed":
            dropped = rest[~keep[rest, n]]
            assert got[dropped, n].sum() == min(count, len(dropped))
