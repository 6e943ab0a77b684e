"""Bounded and state-dependent distributions in whole trainings, on the host and on the device."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np
import pytest

from helpers import SMALL, configured, equal, make_job, resumed, train_here
from joined_rules import JOINED, joined
from sauna.algorithm.policy.bounded import to_env
from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.rollout.actor import make_actor
from sauna.config.presets import resolve
from sauna.envs.spaces import Spaces, describe
from sauna.system.errors import BadInput
from sauna.training.prepare import prepare
from small_envs import Boxed

slow = pytest.mark.slow
KINDS = ("squashed", "beta", "gsde")
HOST, DEVICE = "small_envs:Boxed", "jax_envs:walk"
VECTOR = Spaces("vector", (11,), "continuous", (3,), "", "")


@pytest.mark.parametrize("kind", [pytest.param("squashed", marks=slow), "beta", "gsde"])
def test_the_compiled_actor_samples_as_the_network(kind: str) -> None:
    config = configured(distribution=kind, hidden="7,5", envs=2)
    policy = make_policy(config, VECTOR)
    params = np.stack([policy.init(jax.random.key(seed)) for seed in range(2)])
    params += np.random.default_rng(0).normal(0, 0.3, params.shape).astype(np.float32)
    actor = make_actor(config, VECTOR, policy, None, 2)
    actor.load(params)
    seen = np.random.default_rng(1).normal(0, 2, (2, 2, 11)).astype(np.float32)
    noise = np.asarray(policy.distribution.draw(jax.random.key(3), (20, 2, 2)))
    prepared = actor.prepare(noise)
    sample = jax.jit(lambda p, o, n: policy.sample(p, policy.apply(p, o), n))
    for row in range(20):
        actions = actor.act(seen, prepared[row])
        assert actions.dtype == np.float32
        for p, vector in enumerate(params):
            expected = sample(vector, seen[p], noise[row, p])
            np.testing.assert_allclose(actions[p], expected, rtol=1e-4, atol=5e-5)


SETTINGS: dict[str, dict[str, Any]] = {"gsde": {"sde_sample_freq": 5, "sde_expln": True}}


@pytest.mark.parametrize(
    "kind", [pytest.param("squashed", marks=slow), pytest.param("beta", marks=slow), "gsde"]
)
def test_a_resumed_run_ends_with_the_same_bytes(kind: str) -> None:
    settings = {"arm": "ppo", "distribution": kind, "steps": 96, **SETTINGS.get(kind, {})}
    job = make_job(HOST, **settings)
    whole = train_here(job)
    part = train_here(job, stop=2)
    assert equal(whole.final, train_here(resumed(job, part)).final)


@slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_on_the_device_ends_with_the_same_bytes(kind: str) -> None:
    settings = {"arm": "ppo", "distribution": kind, "steps": 96, **SETTINGS.get(kind, {})}
    job = make_job(DEVICE, **settings)
    whole = train_here(job)
    part = train_here(job, stop=2)
    assert equal(whole.final, train_here(resumed(job, part)).final)


@pytest.mark.parametrize("kind", ["squashed", "beta"])
def test_what_acts_stays_inside_the_box_and_reaches_its_bounds(kind: str) -> None:
    """A box of [-1, 5] x [2, 2.5]; the whole of it is used by actions that are far out."""
    box = gymnasium.spaces.Box(np.array([-1.0, 2.0]), np.array([5.0, 2.5]), dtype=np.float64)
    seen = gymnasium.spaces.Box(-1.0, 1.0, (3,))
    spaces = describe(seen, box)
    assert spaces.action_bounded

    class Env:
        observation_space, action_space = seen, box

    config = configured(distribution=kind, hidden="4", normalize_observations="no")
    assert config.rescale_actions
    policy = FrozenPolicy(config, spaces, Env)
    for u, expected in ((50.0, box.high), (-50.0, box.low), (0.0, [2.0, 2.25])):
        np.testing.assert_allclose(policy.write(np.full(2, u, np.float32)), expected, atol=1e-6)
    params = policy.policy.init(jax.random.key(0))
    policy.load(3.0 * params, None)
    seen_by = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    actions = policy(seen_by, deterministic=False, key=jax.random.key(1))
    assert all(box.contains(action) for action in actions)
    share = (actions - box.low) / (box.high - box.low)
    assert (share.min(0) < 0.2).all() and (share.max(0) > 0.8).all()
    same = policy.act(seen_by[0])
    expected = policy.policy.distribution.mode(
        policy.policy.apply(policy.params, seen_by[:1]).policy
    )
    np.testing.assert_allclose(policy(seen_by[0]), policy.write(np.asarray(expected)[0]), rtol=1e-5)
    np.testing.assert_allclose(same, expected[0], rtol=1e-5)


def test_the_environment_gets_what_the_tanh_bounds() -> None:
    """The rollout keeps `u`; the environment notes actions in its box."""
    job = make_job(HOST, arm="ppo", distribution="squashed", log_std_init=2.0, steps=32)
    Boxed.seen_actions.clear()
    train_here(job)
    actions = np.array(Boxed.seen_actions[-32:])
    assert actions.min() >= -3.0 and actions.max() <= 1.0
    assert (actions > 0.9).any() and (actions < -2.9).any()
    assert np.ptp(actions) > 3.5


REFUSED = [
    ({"distribution": "gsde", "sampler": "gradient-norm"}, "gradient-norm has no formula"),
    ({"distribution": "beta", "loss_weight": "delight"}, "no parameter for"),
    ({"distribution": "beta", "log_std_init": 1.0}, "log_std_init: not read"),
    ({"distribution": "squashed", "rescale_actions": "no"}, "rescale_actions: not read"),
    ({"sde_sample_freq": 4}, "sde_sample_freq: not read .* distribution gsde"),
    ({"distribution": "guassian"}, "did you mean 'gaussian'"),
]


@pytest.mark.parametrize("settings, text", REFUSED)
def test_what_does_not_go_together_is_refused(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(BadInput, match=text) as found:
        resolve({"env": "none", "arm": "ppo", **settings})
    assert "\n" not in str(found.value)


def test_actions_without_bounds_and_discrete_ones_are_refused() -> None:
    for kind in ("squashed", "beta"):
        with pytest.raises(BadInput, match=r"needs bounds of every action"):
            prepare({"env": "small_envs:Unbounded", "distribution": kind, **SMALL})
    with pytest.raises(BadInput, match=r"distribution: not read by .*continuous actions"):
        prepare({"env": "small_envs:GoodAction", "distribution": "gsde", **SMALL})


def test_the_default_is_the_gaussian_to_the_bit() -> None:
    plain, named = make_job(HOST, arm="ppo"), make_job(HOST, arm="ppo", distribution="gaussian")
    assert plain.config == named.config
    action = np.ones((2, 1), np.float32)
    assert to_env(make_policy(plain.config, plain.spaces).distribution, action) is action


@slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("arm", JOINED)
def test_every_rule_trains_with_every_distribution_or_is_refused(kind: str, arm: str) -> None:
    settings: dict[str, Any] = {**joined(arm), "distribution": kind, "envs": 2, "steps": 128}
    if kind == "gsde" and "gradient-norm" in arm:
        with pytest.raises(BadInput, match="no formula"):
            make_job(DEVICE, **settings)
        settings["arm"] = "sample-dropout+espo"
    if kind == "beta" and "delight" in arm:
        with pytest.raises(BadInput, match="no parameter for"):
            make_job(DEVICE, **settings)
        settings["loss_weight_kwargs"] = {"on": "all"}
    rows = train_here(make_job(DEVICE, **settings)).rows
    for name in ("policy_loss", "entropy", "gradient_norm"):
        assert np.isfinite(rows[-1][name]), name
