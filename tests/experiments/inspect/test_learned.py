"""What `sauna inspect` says a learner's rules take is what numpy says they take."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sauna
from algorithm.selection import oracle, oracle_loss
from arrays import hypers, random_rollout
from helpers import SMALL, configured
from sauna.algorithm.learner.program import Learner, make_learner, make_parts
from sauna.algorithm.learner.update import Parts
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.algorithm.types import Hypers, Rollout, ScoredStep, TrainState
from sauna.envs.spaces import Spaces
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.inspect.decisions import Span, decide
from sauna.experiments.inspect.inspection import Inspection, examine
from sauna.experiments.inspect.learned import Learned, draws_of, learned, reads_rollouts
from sauna.experiments.inspect.page import notes, page_data
from sauna.training.artifact import load_artifact
from threads import trained_here

STEPS, ENVS, ROLLOUTS, SEED, ITERATION = 12, 2, 2, 5, 3
ROWS = STEPS * ENVS
SPACES = Spaces("vector", (2,), "continuous", (1,), "", "")
slow = pytest.mark.slow


class Asked(NamedTuple):
    """Two rollouts of one member, and what the page would show of them."""

    parts: Parts
    policy: Policy
    learner: Learner
    state: TrainState
    hypers: Hypers
    streams: Rollout
    found: Learned


def floats(tree: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x, np.float32 if x.dtype == float else None), tree)


def asked(arm: str, envs: int = ENVS, **settings: Any) -> Asked:
    """The rules of an arm about random steps that its own policy has taken."""
    shape = {"rollout_steps": STEPS, "envs": envs, "minibatches": 3, "epochs": 2, "hidden": "4"}
    config = configured(arm=arm, steps=5 * STEPS * envs, **shape, **settings)
    policy = make_policy(config, SPACES)
    learner = make_learner(config, policy, SPACES)
    state, h = learner.init(jax.random.key(1)), floats(hypers(learning_rate=0.05))
    streams = floats(random_rollout(3, ROLLOUTS * STEPS, envs))
    output = jax.jit(policy.apply)(state.params, streams.observation)
    log_prob = policy.distribution.log_prob(output.policy, streams.action)
    streams = streams._replace(log_prob=np.asarray(log_prob))
    scored = ScoredStep(*(getattr(streams, name) for name in ScoredStep._fields))
    spans = decide(config, scored, jax.random.key(0), h).spans
    assert len(spans) == ROLLOUTS and all(span.keep.all() for span in spans)
    given = config, policy, SPACES, state, streams, spans, h, SEED, ITERATION
    parts = make_parts(config, policy, SPACES)
    return Asked(parts, policy, learner, state, h, streams, learned(*given))


def rollouts(made: Asked) -> list[Rollout]:
    return [jax.tree.map(lambda x: x[i : i + STEPS], made.streams) for i in (0, STEPS)]  # noqa: B023


def advantages(rollout: Rollout) -> tuple[np.ndarray, np.ndarray]:
    """Advantages and returns `[T * N]`, float64."""
    r: Any = rollout
    ended = r.terminated | r.truncated
    found = oracle_loss.gae(r.reward, r.value, r.next_value, r.terminated, ended, 0.9, 0.8)
    return found[0].ravel(), found[1].ravel()


def of_env_0(columns: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.asarray(x).reshape(STEPS, -1)[:, 0] for x in columns])


def heads(made: Asked, rollout: Rollout) -> Any:
    """The network at a rollout's steps, flat, and the policy's entropy there."""
    flat: Any = np.asarray(rollout.observation).reshape(-1, 2)
    output = jax.jit(made.policy.apply)(made.state.params, flat)
    return output, np.asarray(made.policy.distribution.entropy(output.policy))


def test_gigaflow_goes_on_with_its_running_maximum() -> None:
    made, maximum, keep = asked("gigaflow", sampler_kwargs='{"threshold": 0.3}'), None, []
    for rollout in rollouts(made):
        mask, maximum = oracle.gigaflow_keep(advantages(rollout)[0], maximum, 0.3)
        keep.append(mask)
    np.testing.assert_array_equal(made.found.taken, of_env_0(keep))
    assert 0 < made.found.taken.sum() < len(made.found.taken)
    fresh = [
        oracle.gigaflow_keep(advantages(rollout)[0], None, 0.3)[0] for rollout in rollouts(made)
    ]
    assert not np.array_equal(made.found.taken, of_env_0(fresh)), "a maximum of its own would show"
    sizes = [np.abs(advantages(rollout)[0]) for rollout in rollouts(made)]
    np.testing.assert_allclose(made.found.score, of_env_0(sizes), rtol=1e-4, atol=1e-5)
    assert made.found.draws is None and made.found.weight is None


def mask_of(sampler: str, made: Asked, rollout: Rollout) -> np.ndarray:
    """The rows `[T * N]` that a sampler keeps, with its defaults."""
    a, returns = advantages(rollout)
    if sampler == "top-advantage":
        return oracle.top_advantage_keep(a, 0.5)
    if sampler == "positive":
        return oracle.positive_keep(a)
    if sampler == "pods":
        score = oracle.segment_scores(a.reshape(STEPS, -1), 4)
        return oracle.segments_to_rows(oracle.pods_keep(score), STEPS, 4).ravel()
    if sampler == "vex-oracle":
        columns = [np.asarray(x).reshape(STEPS, -1).T for x in (a, returns)]
        share = np.stack([oracle.vex_share(*column) for column in zip(*columns, strict=True)], 1)
        return oracle.informative_keep(np.maximum(share, -5.0)).ravel()
    entropy = heads(made, rollout)[1]
    old = np.asarray(rollout.log_prob).ravel()
    return oracle.kondo_keep(oracle.standardise(a), old, 0.3, entropy)


@pytest.mark.parametrize(
    "arm, sampler",
    [
        pytest.param("kondo", "kondo", marks=slow),
        pytest.param("top-advantage", "top-advantage", marks=slow),
        pytest.param("pods", "pods", marks=slow),
        pytest.param("vex-oracle", "vex-oracle", marks=slow),
        pytest.param("ppo", "positive", marks=slow),
    ],
)
def test_a_sampler_takes_the_rows_of_numpy(arm: str, sampler: str) -> None:
    more = {"sampler_kwargs": '{"length": 4}'} if sampler == "pods" else {}
    made = asked(arm, **({"sampler": sampler} if arm == "ppo" else {}), **more)
    keep = [mask_of(sampler, made, rollout) for rollout in rollouts(made)]
    np.testing.assert_array_equal(made.found.taken, of_env_0(keep))
    assert 0 < made.found.taken.sum() < len(made.found.taken) and made.found.score is not None


def probabilities(sampler: str, made: Asked, rollout: Rollout, i: int) -> Any:
    """Probabilities and weights `[T * N]` in rollout i of the two."""
    a = advantages(rollout)[0]
    if sampler == "prioritized":
        p = oracle.prioritized_probabilities(a)
        return p, oracle.prioritized_weights(p, 0.2 + 0.8 * i / 4)
    output = heads(made, rollout)[0]
    mean, log_std = np.split(np.asarray(output.policy), 2, -1)
    action = np.asarray(rollout.action).reshape(-1, 1)
    score = oracle.gaussian_gradient_norm(
        oracle.standardise(a), action, mean, np.exp(log_std), output.hidden
    )
    p = oracle.mixed_probabilities(score)
    return p, oracle.importance_weights(p)


@pytest.mark.parametrize("sampler", ["prioritized", pytest.param("gradient-norm", marks=slow)])
def test_rows_are_drawn_by_numpys_probabilities(sampler: str) -> None:
    """Those of the first epoch, by the inverse of numpy's distribution function."""
    made = asked(sampler)
    draws, weights, taken = [], [], []
    for i, rollout in enumerate(rollouts(made)):
        p, weight = probabilities(sampler, made, rollout, i)
        key, *_ = draws_of(made.parts, SEED, ITERATION + i)
        uniform = np.asarray(jax.random.uniform(jax.random.fold_in(key, 1), (ROWS,)), float)
        rows = np.searchsorted(np.cumsum(p), uniform, side="right")
        taken.append(np.isin(np.arange(ROWS), rows))
        draws.append(ROWS * p)
        weights.append(weight)
    np.testing.assert_allclose(made.found.draws, of_env_0(draws), rtol=2e-3)
    np.testing.assert_allclose(made.found.weight, of_env_0(weights), rtol=2e-3)
    np.testing.assert_array_equal(made.found.taken, of_env_0(taken))
    assert not np.array_equal(made.found.taken[:STEPS], made.found.taken[STEPS:])


@slow
def test_a_control_takes_as_many_other_steps() -> None:
    rule, control = asked("top-advantage", envs=1), asked("top-advantage+random", envs=1)
    for one, other in zip(
        np.split(rule.found.taken, ROLLOUTS), np.split(control.found.taken, ROLLOUTS), strict=True
    ):
        assert one.sum() == other.sum() == STEPS / 2 and not np.array_equal(one, other)


def test_the_control_of_a_filter_takes_as_many_steps_as_it_keeps() -> None:
    config = configured(arm="sauna+random", rollout_steps=STEPS, dropped="mask", minibatches=3)
    policy = make_policy(config, SPACES)
    streams, h = floats(random_rollout(3, STEPS, 1)), floats(hypers(threshold=0.9))
    scored = ScoredStep(*(getattr(streams, name) for name in ScoredStep._fields))
    spans = decide(config, scored, jax.random.key(0), h).spans
    state = make_learner(config, policy, SPACES).init(jax.random.key(1))
    found = learned(config, policy, SPACES, state, streams, spans, h, SEED, ITERATION)
    kept = spans[0].keep[:, 0]
    assert 1 < kept.sum() < STEPS and found.taken.sum() == kept.sum()
    assert found.taken[0] and not np.array_equal(found.taken, kept)


@slow
def test_delight_weighs_by_advantage_times_surprisal() -> None:
    made, first = asked("delight"), []
    for rollout in rollouts(made):
        log_prob, entropy = np.asarray(rollout.log_prob).ravel(), heads(made, rollout)[1]
        a = oracle.standardise(advantages(rollout)[0])
        first.append(oracle.delight_weight(a, log_prob, entropy))
    np.testing.assert_allclose(made.found.first_weight, of_env_0(first), rtol=1e-3)
    assert not np.allclose(made.found.last_weight, made.found.first_weight, rtol=1e-2)
    assert made.found.taken.all() and made.found.score is None


def test_sample_dropout_leaves_out_what_has_gone_far_by_the_end_of_the_update() -> None:
    made = asked("sample-dropout", loss_weight_kwargs='{"deviation": 0.1}')
    assert (made.found.first_weight == 1).all()
    keep = []
    for i, rollout in enumerate(rollouts(made)):
        key, order, _ = draws_of(made.parts, SEED, ITERATION + i)
        batch = made.learner.make_batch(rollout, made.hypers, key)
        own = jax.tree.map(jnp.copy, made.state)
        updated, _ = made.learner.learn(own, rollout, batch, made.hypers, order, key)
        output = jax.jit(made.policy.apply)(updated.params, batch.observation)
        log_prob = np.asarray(made.policy.distribution.log_prob(output.policy, batch.action))
        keep.append(oracle.sample_dropout_keep(log_prob, np.asarray(batch.log_prob), 0.1))
    np.testing.assert_array_equal(made.found.last_weight, of_env_0(keep))
    np.testing.assert_array_equal(made.found.taken, of_env_0(keep))
    assert 0 < made.found.taken.sum() < len(made.found.taken)


@slow
def test_of_negative_advantages_positive_learns_nothing() -> None:
    made = asked("positive")
    keep = [oracle.positive_keep(advantages(rollout)[0]) for rollout in rollouts(made)]
    np.testing.assert_array_equal(made.found.taken, of_env_0(keep))


def test_a_dropped_step_is_no_sample() -> None:
    """Of a filter and a sampler together: numpy's rows among those that the filter keeps."""
    config = configured(
        arm="sauna+top-advantage", rollout_steps=STEPS, dropped="mask", minibatches=3, hidden="4"
    )
    policy = make_policy(config, SPACES)
    streams, h = floats(random_rollout(3, STEPS, 1)), floats(hypers())
    kept = np.random.default_rng(0).random((STEPS, 1)) < 0.7
    span = Span(np.zeros(1, int), np.ones((STEPS, 1), bool), kept)
    state = make_learner(config, policy, SPACES).init(jax.random.key(1))
    found = learned(config, policy, SPACES, state, streams, [span], h, SEED, ITERATION)
    rows = np.flatnonzero(kept)
    a = advantages(streams)[0][rows]
    expected = np.zeros(STEPS, bool)
    expected[rows[oracle.largest(np.abs(a), STEPS // 2)]] = True  # ceil(k M), of all M
    np.testing.assert_array_equal(found.taken, expected)
    np.testing.assert_array_equal(np.isnan(found.score), ~kept[:, 0])


# Of runs.


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A filter of one's own, then a sampler, in two environments."""
    settings = {**SMALL, "arm": "sauna+top-advantage", "rollout_steps": 16, "steps": 64, "envs": 2}
    settings |= {"sampler_kwargs": {"share": 0.3}}
    own = {"filter": "own_rules:likely", "filter_kwargs": '{"least": -3.6}', "dropped": "mask"}
    out = tmp_path_factory.mktemp("rules") / "run"
    with trained_here():
        return sauna.train("small_envs:Scripted", quiet=True, out=out, **settings, **own).path


@pytest.fixture(scope="module")
def found(run: Path) -> Inspection:
    settings = {"episodes": 3, "deterministic": False, "seed": 3, "frames": False}
    name = "sauna+own_rules.likely+top-advantage/0"
    return examine(run, load_artifact(run), name, **settings, say=print)


def test_a_filter_of_ones_own_sees_actions_values_and_log_probabilities(
    run: Path, found: Inspection
) -> None:
    policy = TrainedPolicy(load_artifact(run), 0)
    output = jax.jit(policy.policy.apply)(policy.params, found.played.observation)
    mean, log_std = np.split(np.asarray(output.policy, float), 2, -1)
    z = (found.played.action - mean) / np.exp(log_std)
    log_prob = -(0.5 * z**2 + log_std + 0.5 * np.log(2 * np.pi)).sum(-1)
    np.testing.assert_array_equal(found.decisions.keep, log_prob >= -3.6)
    assert 0 < found.decisions.keep.sum() < len(log_prob), "with zeros it would keep all"


def test_the_page_shows_what_is_taken_and_why(found: Inspection) -> None:
    data, made, keep = page_data(found), found.learned, found.decisions.keep
    assert made is not None and data["keep"] == made.taken.astype(int).tolist()
    assert 0 < made.taken.sum() < keep.sum() and not made.taken[~keep].any()
    assert data["words"] == ("taken", "left out") and [panel["name"] for panel in data["panels"]][
        :2
    ] == ["vex", "score"]
    shown = np.array(data["series"]["score"], float)
    np.testing.assert_array_equal(np.isnan(shown), ~keep)
    size = np.abs(found.advantage)
    np.testing.assert_allclose(shown[keep], size[keep], rtol=1e-3, atol=1e-5)
    said = " ".join(notes(found))
    assert re.search(r"Sampler top-advantage: 0\.\d+ of these steps are taken", said)
    assert "16 steps of 2 environments" in said and "sample rate in the last iteration" in said
    assert "keeps every step" not in said
    json.dumps(data, allow_nan=False)


def test_rollouts_are_filled_behind_the_last_episode(found: Inspection) -> None:
    """Half of each whole rollout of both environments is taken, not half of what is shown."""
    steps = len(found.reward)
    assert len(found.decisions.rollouts) == -(-steps // 16) and steps % 16
    last = found.decisions.spans[-1]
    assert last.valid.shape == (16, 2) and last.valid.all()


WITHOUT = {
    "spo": ({"objective": "spo"}, "spo changes the form of each policy term"),
    "espo": ({"stop": "espo"}, "espo says when the gradient steps of an iteration end"),
    "target-kl": ({"stop": "target-kl"}, "target-kl says when"),
    "avec": ({"critic": "avec"}, "avec changes the value loss"),
    "recompute": ({"recompute_advantages": True}, "recompute computes values and advantages anew"),
    "merl": ({"auxiliary": "next-observation"}, "next-observation trains a further head along"),
}


@pytest.mark.parametrize("arm", WITHOUT)
def test_a_rule_that_takes_no_subset_says_so(found: Inspection, arm: str) -> None:
    settings, sentence = WITHOUT[arm]
    plain = dataclasses.replace(
        found.member.config, sampler="none", filter="none", vex_coef=0.0, **settings
    )
    assert not reads_rollouts(plain)
    member = found.member._replace(config=plain)
    bare = found._replace(member=member, learned=None, head=False)
    (said,) = [text for text in notes(bare) if text.startswith("No subset is taken by: ")]
    assert sentence in said and "Every step is learned from." in said
    assert set(page_data(bare)["series"]) == {
        "value",
        "return",
        "advantage",
        "reward",
        "raw_reward",
    }
    both = dataclasses.replace(found.member.config, **settings)
    beside = " ".join(notes(found._replace(member=found.member._replace(config=both))))
    assert sentence in beside and "Every step is learned from." not in beside
