"""Learning again from earlier rollouts: V-trace by hand, on-policy identity, counts, resume."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

from arrays import hypers, no_key, parts_of, random_rollout
from helpers import configured, equal, make_job, train_here
from sauna.algorithm.learner.learn import learn
from sauna.algorithm.learner.replay import as_if_now, empty_replay, pool_rows, remember
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.update import init_state, minibatch_order
from sauna.algorithm.learner.vex_targets import TARGETS
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.types import Rollout
from sauna.config.checks import check_consistent
from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput

STEPS, ENVS = 12, 2
SPACES = Spaces("vector", (2,), "continuous", (1,), "", "")
CONFIG = configured(
    arm="ppo",
    rollout_steps=STEPS,
    envs=ENVS,
    minibatches=3,
    epochs=2,
    hidden="4,4",
    replay_rollouts=2,
)
POLICY = make_policy(CONFIG, SPACES)
PARAMS = POLICY.init(jax.random.key(1))
H = jax.tree.map(np.float32, hypers())
HOW: Any = {"config": CONFIG, "policy": POLICY, "target": TARGETS["sample"]}


def rollout_of(params: Any, seed: int) -> Rollout:
    """Random steps with the log-probabilities and values of a policy with these parameters."""
    rollout = jax.tree.map(
        lambda x: x.astype(np.float32) if x.dtype == float else x, random_rollout(seed, STEPS, ENVS)
    )
    output = POLICY.apply(params, rollout.observation)
    value = np.asarray(output.value)
    ended = rollout.terminated | rollout.truncated
    last = np.arange(STEPS)[:, None] == STEPS - 1
    following = np.where(ended | last, rollout.next_value, np.roll(value, -1, 0))
    return rollout._replace(
        log_prob=np.asarray(POLICY.distribution.log_prob(output.policy, rollout.action)),
        value=value,
        next_value=following,
        vex=np.asarray(output.vex),
    )


def test_the_policy_that_acted_gets_what_gae_gives() -> None:
    rollout = rollout_of(PARAMS, 0)
    again = as_if_now(rollout, PARAMS, H, **HOW)
    batch = make_batch(rollout, H, no_key(), config=CONFIG, target=TARGETS["sample"])
    assert np.all(again.importance == 1)
    for name in ("advantage", "return_", "value", "log_prob", "vex_target"):
        np.testing.assert_allclose(getattr(again, name), getattr(batch, name), atol=1e-5)


def by_hand(rollout: Rollout, params: Any, lambda_: float = 0.8) -> dict[str, np.ndarray]:
    """V-trace in float64, env by env and backwards in time."""
    output = POLICY.apply(params, rollout.observation)
    v = np.asarray(output.value, np.float64)
    log_prob = np.asarray(POLICY.distribution.log_prob(output.policy, rollout.action), np.float64)
    rho = np.minimum(1.0, np.exp(log_prob - rollout.log_prob))
    advantage = np.zeros((STEPS, ENVS))
    for n in range(ENVS):
        later = 0.0
        for t in reversed(range(STEPS)):
            if rollout.terminated[t, n]:
                following, later = 0.0, 0.0
            elif rollout.truncated[t, n] or t == STEPS - 1:
                following, later = rollout.next_value[t, n], 0.0
            else:
                following = v[t + 1, n]
            delta = rollout.reward[t, n] + 0.9 * following - v[t, n]
            advantage[t, n] = delta + 0.9 * lambda_ * later
            later = rho[t, n] * advantage[t, n]
    return {
        "advantage": advantage.ravel(),
        "return_": (v + rho * advantage).ravel(),
        "importance": rho.ravel(),
        "log_prob": log_prob.ravel(),
    }


def test_another_policy_is_corrected_as_by_hand() -> None:
    rollout, now = rollout_of(PARAMS, 0), POLICY.init(jax.random.key(2)) * 1.5
    again, expected = as_if_now(rollout, now, H, **HOW), by_hand(rollout, now)
    assert 0.05 < np.mean(expected["importance"] < 1) < 0.95
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(again, name), values, rtol=1e-4, atol=1e-5)
    wrong = by_hand(rollout, now, lambda_=0.9)["advantage"]
    assert np.max(np.abs(wrong - again.advantage)) > 0.01


def test_the_oldest_rollout_is_forgotten() -> None:
    replay = empty_replay(CONFIG, SPACES)
    rollouts = [rollout_of(PARAMS, seed) for seed in range(3)]
    for i, rollout in enumerate(rollouts):
        assert replay.number == min(i, 2)
        replay = remember(replay, rollout)
    for kept, expected in zip(range(2), (rollouts[2], rollouts[1]), strict=True):
        assert equal_trees(jax.tree.map(lambda x: x[kept], replay.rollouts), expected)  # noqa: B023


def equal_trees(a: Any, b: Any) -> bool:
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, a, b)))


def test_samples_of_rollouts_that_are_there_are_learned_from() -> None:
    """1, 2, 3 and again 3 rollouts of 24 samples, two epochs; the earlier two are scored anew."""
    parts = parts_of(CONFIG, POLICY)._replace(replay=partial(empty_replay, CONFIG, SPACES))
    state = init_state(parts, jax.random.key(1))
    run = jax.jit(partial(learn, parts=parts))
    for i, rollouts in enumerate((1, 2, 3, 3)):
        rollout = rollout_of(state.params, i)
        batch = make_batch(rollout, H, no_key(), config=CONFIG, target=TARGETS["sample"])
        state, metrics = run(
            state, rollout, batch, H, minibatch_order(CONFIG, 0, i), jax.random.key(i)
        )
        rows = rollouts * STEPS * ENVS * 2
        assert metrics.work.samples_backward == rows
        assert metrics.work.gradient_steps == rows / 8
        assert metrics.work.samples_forward == rows + 2 * STEPS * ENVS
        assert metrics.finite


def test_a_sampler_chooses_from_the_pool() -> None:
    assert pool_rows(CONFIG) == 72
    assert minibatch_order(CONFIG, 0, 0).shape == (2, 72)


@pytest.mark.parametrize(
    "arm",
    ["ppo", *(pytest.param(arm, marks=pytest.mark.slow) for arm in ("sauna", "prioritized"))],
)
@pytest.mark.parametrize(
    "where",
    [
        {"env": "small_envs:Scripted"},
        pytest.param(
            {"env": "jax_envs:walk", "backend": "device", "devices": 1}, marks=pytest.mark.slow
        ),
    ],
)
def test_resumes_to_the_byte(where: dict[str, Any], arm: str) -> None:
    job = make_job(arm=arm, envs=2, steps=512, replay_rollouts=2, checkpoint_every=3, **where)
    whole = train_here(job)
    second = train_here(job._replace(restored=whole.states[3], start=3))
    assert equal(second.final, whole.final)
    assert second.rows == whole.rows[3:]
    without = {k: v for k, v in whole.states[3].items() if "replay/reward" not in k}
    assert len(without) < len(whole.states[3])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"recompute_advantages": True}, "replay_rollouts: not read with recompute_advantages"),
        ({"critic": "avec"}, "replay_rollouts: not read with critic avec"),
        ({"sampler": "pods"}, "replay_rollouts: pods takes segments"),
    ],
)
def test_what_cannot_learn_from_earlier_rollouts_is_refused(settings: Any, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        check_consistent(dataclasses.replace(CONFIG, env="Hopper-v5", steps=10**6, **settings))
