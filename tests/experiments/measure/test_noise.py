"""Noise of minibatch gradients: the gradient, the estimators where the truth is known, streams."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arrays import VECTOR, hypers, losses_on, parts_of, random_batch
from helpers import configured
from sauna import train
from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import make_policy
from sauna.experiments import measure
from sauna.experiments.measure import estimates, noise
from sauna.experiments.measure.estimates import Gradients, estimate
from sauna.experiments.measure.gradient import policy_gradient
from sauna.experiments.measure.noise_report import over_members, report, text_table, verdicts
from sauna.experiments.measure.streams import (
    Fresh,
    MemberSnapshot,
    Stream,
    fresh_streams,
    load_snapshot,
    moved_in_time,
)
from sauna.experiments.study.spec import read_spec
from sauna.system.errors import BadInput

PAIRS = (("dropped", "control"),)
GROUPS = ("dropped", "control")
gradient_of = jax.jit(policy_gradient, static_argnames=("policy", "standardized"))


def test_the_gradient_is_that_of_the_training_loss_at_ratio_one() -> None:
    config = configured(hidden="8,8")
    policy = make_policy(config, VECTOR)
    with jax.enable_x64(True):
        params = jnp.asarray(policy.init(jax.random.key(0)), jnp.float64)
        batch = random_batch()
        output = jax.jit(policy.apply)(params, batch.observation)
        log_prob = policy.distribution.log_prob(output.policy, batch.action)
        batch = batch._replace(log_prob=log_prob)
        h = hypers(entropy_coef=0.0, value_coef=0.0, vex_coef=0.0)

        def loss(params: Any) -> Any:
            return losses_on(params, batch, h, parts_of(config, policy)).total

        got = gradient_of(
            params,
            batch.observation,
            batch.action,
            batch.advantage,
            batch.weight,
            policy=policy,
            standardized=True,
        )
        np.testing.assert_allclose(got, -jax.jit(jax.grad(loss))(params), atol=1e-12)
        assert np.abs(got).max() > 1e-3


def test_the_gradient_by_hand_where_it_is_simple() -> None:
    """Of the Gaussian's log-std it is the mean of `A (z^2 - 1)`, of the head's bias `A z / std`."""
    policy = make_policy(configured(hidden="8,8"), VECTOR)
    params, batch = policy.init(jax.random.key(1)), random_batch(6)
    observation, action = (x.astype(np.float32) for x in (batch.observation, batch.action))
    mean, log_std = np.split(np.asarray(jax.jit(policy.apply)(params, observation).policy), 2, -1)
    z, a, w = (action - mean) / np.exp(log_std), batch.advantage[:, None], batch.weight[:, None]
    gradient = gradient_of(
        params,
        observation,
        action,
        batch.advantage.astype(np.float32),
        w[:, 0],
        policy=policy,
        standardized=False,
    )
    got = policy.unravel(gradient)["params"]
    np.testing.assert_allclose(got["log_std"], (w * a * (z**2 - 1)).sum(0) / w.sum(), rtol=1e-4)
    bias = (w * a * z / np.exp(log_std)).sum(0) / w.sum()
    np.testing.assert_allclose(got["policy_head"]["bias"], bias, rtol=1e-4)
    assert not np.any(got["value_head"]["bias"])


@pytest.fixture
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimates, "RESAMPLES", 200)


def drawn(
    random: np.random.Generator, means: np.ndarray, spread: np.ndarray, streams: int = 32
) -> Gradients:
    """Streams of minibatch gradients `N(mean + the stream's own shift, spread^2)` of two groups."""
    minibatches, size = 8, means.shape[1]
    shift = 0.5 * random.normal(size=(streams, 1, 1, size))
    h = (
        means[:, None]
        + shift
        + spread[:, None, None] * random.normal(size=(streams, len(means), minibatches, size))
    )
    reference = means[1] + 0.3 * random.normal(size=(streams, size))
    direction = reference.mean(0) / np.linalg.norm(reference.mean(0))
    cosine = (h @ direction / np.linalg.norm(h, axis=-1)).mean(2)
    rate = np.ones((streams, len(means)))
    return Gradients(h.mean(2), (h**2).sum(-1).mean(2), cosine, reference, rate)


def test_estimates_are_unbiased_and_intervals_hold_the_truth(few_resamples: None) -> None:
    random, size = np.random.default_rng(0), 20
    means = np.stack([np.full(size, 0.3), np.r_[np.full(10, 0.6), np.zeros(10)]])
    spread = np.array([1.0, 0.5])
    signal = (means**2).sum(1)
    variance = size * (spread**2 + 0.25)  # of a minibatch: its own noise and its stream's
    truth = {
        "signal": signal,
        "variance": variance,
        "snr": signal / variance,
        "snr_per_env_step": signal / variance,
    }
    cosine = means[0] @ means[1] / np.sqrt(signal.prod())
    values: dict[str, list[np.ndarray]] = {name: [] for name in [*truth, "alignment"]}
    covered: dict[str, list[bool]] = {name: [] for name in [*truth, "alignment"]}
    for _ in range(100):
        found = estimate(drawn(random, means, spread), GROUPS, PAIRS)["groups"]
        for name in values:
            expected = [cosine, 1.0] if name == "alignment" else truth[name]
            for group, true in zip(GROUPS, expected, strict=True):
                value, low, high = found[group][name]
                values[name].append(np.array([value - true, true]))
                covered[name].append(low <= true <= high)
    for name, pairs in values.items():
        for place in range(2):
            errors = np.array(pairs[place::2])[:, 0]
            if name in ("signal", "variance"):  # others are ratios: unbiased for many streams only
                assert abs(errors.mean()) < 4 * errors.std() / np.sqrt(len(errors)), name
            assert np.mean(covered[name][place::2]) > 0.85, (name, place)


def test_a_random_control_finds_no_difference_and_a_real_one_is_found(few_resamples: None) -> None:
    random, size = np.random.default_rng(1), 20
    means = np.full((2, size), 0.3)
    equal, noisier = 0, 0
    for _ in range(60):
        for spread, names in ((1.0, "equal"), (2.0, "noisier")):
            found = estimate(drawn(random, means, np.array([spread, 1.0])), GROUPS, PAIRS)
            own = found["differences"]["dropped - control"]
            if names == "equal":
                equal += own["snr"][1] <= 0 <= own["snr"][2]
            else:
                noisier += own["snr"][2] < 0 and own["variance_ratio"][1] > 1
    assert equal >= 50 and noisier >= 54


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of two members that drop much."""
    return train(
        "InvertedPendulum-v5",
        arm="sauna",
        threshold=0.95,
        seeds=2,
        steps=2048,
        rollout_steps=256,
        minibatches=16,
        hidden=[8, 8],
        epochs=2,
        processes=1,
        checkpoint_every=2,
        keep_checkpoints=99,
        out=tmp_path_factory.mktemp("noise") / "run",
        quiet=True,
    ).path


@pytest.fixture(scope="module")
def snapshot(run: Path) -> MemberSnapshot:
    return load_snapshot(run, "sauna/1", 4)


@pytest.fixture(scope="module")
def fresh(snapshot: MemberSnapshot) -> Fresh:
    return fresh_streams(snapshot, 2 * noise.MIN_STREAMS, 2)


@pytest.fixture(scope="module")
def streams(fresh: Fresh) -> list[Stream]:
    return fresh.streams


def test_streams_are_the_members_next_rollouts(
    run: Path, snapshot: MemberSnapshot, streams: Any
) -> None:
    again = fresh_streams(snapshot, 2 * noise.MIN_STREAMS, 2).streams
    for one, other in zip(streams, again, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(one, other, strict=True))
    moments = Moments(
        *(snapshot.arrays[f"observation_moments/{name}"] for name in ("mean", "variance", "count"))
    )
    for stream in streams:
        kept, steps = int(stream.keep.sum()), len(stream.keep)
        assert kept == 2 * 256 or steps == 2 * 4 * 256  # two rollouts, full or at their bound
        assert kept < steps and stream.shifted.sum() == kept
        assert not np.array_equal(stream.shifted, stream.keep)
        near = normalize(moments, stream.seen, 10.0)
        assert np.corrcoef(near.ravel(), stream.observation.ravel())[0, 1] > 0.99
    starts = [stream.seen[0] for stream in streams]
    assert not any(np.array_equal(starts[0], other) for other in starts[1:])


def test_every_env_step_of_a_measurement_is_counted(
    snapshot: MemberSnapshot, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = []
    step = measure.streams._Recorded.step

    def counted(self: Any, action: np.ndarray, active: np.ndarray) -> Any:
        taken.append(int(active.sum()))
        return step(self, action, active)

    monkeypatch.setattr(measure.streams._Recorded, "step", counted)
    found = fresh_streams(snapshot, 3, 1).counts
    assert found["env_steps_used"] + found["env_steps_thrown_away"] == sum(taken)
    assert found["env_steps_thrown_away"] > 0


def test_a_moved_time_line_keeps_its_order_and_its_bunches() -> None:
    """Two envs, three rollouts of 2 and 1 env steps: moved round all of them, not within one."""
    lines = [np.array([1, 2, 3, 4, 5, 6]), np.array([-1, -2, -3])]
    rollouts = [[lines[0][2 * i : 2 * i + 2], lines[1][i : i + 1]] for i in range(3)]
    offsets = set()
    for seed in range(20):
        moved = moved_in_time(rollouts, np.random.default_rng(seed))
        first, second = moved.reshape(3, 3)[:, :2].ravel(), moved.reshape(3, 3)[:, 2]
        at = (int(np.flatnonzero(first == 1)[0]), int(np.flatnonzero(second == -1)[0]))
        np.testing.assert_array_equal(np.roll(lines[0], at[0]), first)
        np.testing.assert_array_equal(np.roll(lines[1], at[1]), second)
        offsets.add(at)
    assert len({first for first, _ in offsets}) > 3 and len({one for _, one in offsets}) == 3


def test_a_measurement_has_every_estimate(
    snapshot: MemberSnapshot, fresh: Fresh, streams: list[Stream], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(noise, "fresh_streams", lambda *given: fresh)
    found = noise.measure(snapshot, streams=len(streams))
    assert found["streams"] == {"reference": 8, "tested": 8, "usable": 8}
    assert found["minibatch"] == 16 and found["as_trained"] == "standardized"
    for rule in ("standardized", "raw"):
        groups = found["rules"][rule]["groups"]
        assert set(groups) == set(noise.GROUPS)
        for value, low, high in (groups[g][n] for g in groups for n in ("cosine", "variance")):
            assert low <= value <= high
    json.dumps(found, allow_nan=False)
    monkeypatch.setattr(noise, "MIN_STREAMS", 9)
    assert noise.measure(snapshot, streams=len(streams))["rules"] == {}  # nothing is claimed


def test_minibatches_come_from_their_groups(streams: list[Stream]) -> None:
    stream = streams[0]
    rows = noise.draw(stream, 16, np.random.default_rng(0))
    kept, dropped, control, shifted = rows
    assert rows.shape == (4, noise.MINIBATCHES, 16)
    assert stream.keep[kept].all() and not stream.keep[dropped].any()
    assert not stream.shifted[shifted].any()
    assert 0 < stream.keep[control].mean() < 1
    assert all(len(set(part)) == 16 for part in rows.reshape(-1, 16).tolist())


def point(at: float, snr: float, control: float = 0.010, raw: float = 1.0) -> dict[str, Any]:
    groups = {
        name: {
            "snr": [x, 0, 1],
            "cosine": [x, 0, 1],
            "alignment": [1.0, 0.9, 1.1],
            "variance": [20.0, 19, 21],
        }
        for name, x in (
            ("kept", 0.02),
            ("dropped", snr),
            ("control", control),
            ("shifted", control),
        )
    }
    difference = {
        "snr": [snr - control, 0, 0],
        "cosine": [snr - control, 0, 0],
        "snr_per_env_step": [0.001, 0, 0],
        "variance_ratio": [1.2, 1, 2],
    }
    pairs = ("dropped - control", "kept - control", "dropped - shifted")
    rules = {
        "standardized": {"groups": groups, "differences": dict.fromkeys(pairs, difference)},
        "raw": {
            "groups": groups,
            "differences": {key: {"variance_ratio": [raw, 0, 9]} for key in pairs},
        },
    }
    return {
        "point": at,
        "keep_rate": 0.7,
        "minibatch": 64,
        "as_trained": "standardized",
        "rules": rules,
    }


def measured(*members: list[dict[str, Any]]) -> dict[str, Any]:
    listed = [{"seed": seed, "points": points} for seed, points in enumerate(members)]
    cell = {
        "task": "A-v0",
        "label": "sauna",
        "arm": "sauna",
        "steps": 1000,
        "members": listed,
        "seeds": len(listed),
    }
    return {"name": "noise", "measure": "noise", "cells": [cell]}


@pytest.mark.parametrize(
    "snrs, said",
    [
        ((0.002, 0.003, 0.001), "by signal to noise it is noisier than that"),
        ((0.022, 0.023, 0.021), "by signal to noise it is less noisy than that"),
        ((0.002, 0.018, 0.010), "by signal to noise it shows no difference from that"),
        ((0.002,), "by signal to noise it is underpowered"),
    ],
)
def test_the_verdict_follows_the_interval_over_members(snrs: tuple, said: str) -> None:
    found = measured(*([point(0.5, snr), point(1.0, snr)] for snr in snrs))
    assert said in verdicts(found)[0]
    assert over_members(found["cells"][0], "groups", "control", "snr").value == pytest.approx(0.01)
    page = report(found)
    assert said in page.answers[0] and [len(plot.panels[0].lines) for plot in page.plots] == [
        4,
        4,
        4,
    ]
    assert len(text_table(found)[1]) == len(text_table(found)[0])


@pytest.mark.parametrize(
    "ratios, said",
    [
        (
            (1.5, 2.0, 2.5),
            "by variance what the filter drops is noisier than what a matched random",
        ),
        ((0.5, 0.6, 0.55), "by variance what the filter drops is less noisy than"),
        ((0.5, 2.0, 1.0), "by variance what the filter drops shows no difference from"),
    ],
)
def test_variance_is_told_of_advantages_as_they_are(ratios: tuple, said: str) -> None:
    """Geometric: half and twice are as far from 1. `point` has 1.2 where they are standardised."""
    found = measured(*([point(0.5, 0.01, raw=x), point(1.0, 0.01, raw=x)] for x in ratios))
    assert said in verdicts(found)[0]
    assert "have 1.200 [1.200, 1.200] times the variance" in verdicts(found)[0]
    path = ("differences", "dropped - control", "variance_ratio")
    mean = over_members(found["cells"][0], *path, raw=True).value
    assert mean == pytest.approx(np.prod(ratios) ** (1 / 3))


def test_an_alignment_says_how_many_checkpoints_it_is_known_at() -> None:
    unknown = point(1.0, 0.01)
    unknown["rules"]["standardized"]["groups"]["kept"]["alignment"] = [None, None, None]
    head, row = text_table(measured([point(0.5, 0.01), unknown], [point(0.5, 0.01)]))
    assert row[head.index("Alignment of kept, checkpoints")] == "1.0 [1.0, 1.0], 2 of 3"


def test_what_is_not_measured_yet_is_told() -> None:
    part = measured([], [])
    assert verdicts(part) == ["A-v0, sauna: not measured yet."]
    part = measured([point(0.5, 0.01)], [point(0.5, 0.02)], [])
    assert verdicts(part)[0].endswith("2 of 3 seeds so far.")
    assert text_table(part)[1][2] == "2 of 3"
    assert "so far" not in verdicts(measured([point(0.5, 0.01)]))[0]


def test_where_nothing_was_dropped_nothing_is_said() -> None:
    empty = {**point(0.5, 0.1), "rules": {}}
    assert "no answer, because the filter dropped too few" in verdicts(measured([empty]))[0]
    assert "At 1 of 2 checkpoints" in verdicts(measured([empty, point(1.0, 0.1)]))[0]
    assert report(measured([empty])).plots == []


SPEC = {
    "tasks": ["A-v0"],
    "arms": [{"label": "sauna"}],
    "checkpoint_every": 10,
    "keep_checkpoints": 1000,
}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"measure": "nois"}, "measure must be one of .*did you mean 'noise'"),
        ({"measure": "noise", "keep_checkpoints": 2}, "needs the checkpoints along training"),
        ({"measure": "noise", "backend": "device"}, "environments on the host"),
        ({"measure": "noise", "arms": [{"label": "ppo"}]}, "needs an arm that filters"),
    ],
)
def test_mistakes_in_what_to_measure_are_named(change: dict, message: str) -> None:
    assert read_spec({**SPEC, "measure": "noise"}).measure == "noise"
    with pytest.raises(BadInput, match=message):
        read_spec({**SPEC, **change})
