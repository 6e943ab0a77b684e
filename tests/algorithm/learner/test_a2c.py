"""A2C on the same core: its loss, optimizer and returns, and everything around them."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arrays import (
    hypers,
    losses_of_terms,
    losses_on,
    no_key,
    parts_of,
    random_batch,
    random_rollout,
)
from helpers import Recorder, configured, equal, make_job, own, resumed, train_here
from sauna.algorithm.learner import a2c
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.update import init_state, update_on_all
from sauna.algorithm.learner.vex_targets import TARGETS
from sauna.algorithm.policy.policy import make_policy, score
from sauna.algorithm.types import Batch
from sauna.config.presets import PRESET_HELP, PRESETS, resolve
from sauna.config.settings import FIELDS
from sauna.config.stored import stored_config
from sauna.envs.spaces import Spaces
from sauna.experiments.study.command import comparison
from sauna.experiments.study.spec import check, load_spec
from sauna.system.checkpoint import BadCheckpoint
from sauna.system.errors import BadInput
from sauna.training.loop.member_state import named_optimizer, unpack_optimizer
from sauna.training.worker import train_members

VECTOR = Spaces("vector", (3,), "continuous", (2,), "", "")
ENV = "small_envs:Scripted"
PUBLISHED = {"algorithm": "a2c", "rollout_steps": 5, "envs": 16}


def job_of(arm: str, env: str = ENV, iterations: int = 6, **settings: Any) -> Any:
    """A short job at the published 5 steps x 16 environments."""
    given = {**PUBLISHED, "arm": arm, "steps": 80 * iterations, **settings}
    return make_job(env, **given)


def test_losses_by_hand() -> None:
    """Two samples and one that does not count, whatever it holds."""
    got = losses_of_terms(
        a2c,
        hypers(entropy_coef=0.1, value_coef=0.5, vex_coef=0.25),
        configured(algorithm="a2c"),
        log_ratio=[-1.0, -2.0, jnp.inf],
        advantage=[3.0, -1.0, 5.0],
        value=[1.0, 0.0, 9.0],
        old=[0.0, 0.0, 0.0],
        return_=[2.0, 2.0, 0.0],
        vex=[2.0, 0.0, 7.0],
        vex_target=[0.0, 0.0, 0.0],
        entropy=[1.5, 0.5, 8.0],
        weight=[1.0, 1.0, 0.0],
    )
    policy, value, vex, entropy = (3.0 - 2.0) / 2, (1.0 + 4.0) / 2, 2.0, 1.0
    total = policy - 0.1 * entropy + 0.5 * value + 0.25 * vex
    np.testing.assert_allclose(got[:5], [total, policy, value, vex, entropy], rtol=1e-6)
    assert np.isnan(got.kl) and np.isnan(got.clip_fraction)


@partial(jax.jit, static_argnames="config")
def losses_of(params: Any, batch: Batch, h: Any, config: Any) -> Any:
    policy = make_policy(config, VECTOR)
    return losses_on(params, batch, h, parts_of(config, policy))


gradient_of = jax.jit(
    jax.grad(lambda params, batch, h, config: losses_of(params, batch, h, config).total),
    static_argnums=3,
)


def test_the_loss_is_stable_baselines3s() -> None:
    """`a2c.py` of Stable-Baselines3, line by line in numpy, with a diagonal Gaussian of its own."""
    config, h = configured(algorithm="a2c", hidden="5"), hypers(vex_coef=0.0)
    with jax.enable_x64(True):
        policy = make_policy(config, VECTOR)
        params = policy.init(jax.random.key(0)).astype(jnp.float64) + 0.1
        batch = jax.tree.map(jnp.asarray, random_batch()._replace(weight=np.ones(24)))
        output = jax.jit(policy.apply)(params, batch.observation)
        got = losses_of(params, batch, h, config)
    mean, log_std = np.split(np.asarray(output.policy), 2, axis=-1)
    z = (np.asarray(batch.action) - mean) / np.exp(log_std)
    log_prob = (-0.5 * z**2 - log_std - 0.5 * np.log(2 * np.pi)).sum(-1)
    entropy = (0.5 + 0.5 * np.log(2 * np.pi) + log_std).sum(-1)
    policy_loss = -(np.asarray(batch.advantage) * log_prob).mean()
    value_loss = ((np.asarray(batch.return_) - np.asarray(output.value)) ** 2).mean()
    entropy_loss = -entropy.mean()
    loss = policy_loss + 0.01 * entropy_loss + 0.5 * value_loss
    np.testing.assert_allclose(got[:3], [loss, policy_loss, value_loss], rtol=1e-9)
    np.testing.assert_allclose(got.entropy, -entropy_loss, rtol=1e-9)


def test_its_gradient_is_ppos_where_the_policy_has_not_moved_yet() -> None:
    """Huang et al. (2022). The negative control: not where it has moved."""
    same = {"hidden": "5", "trunk": "shared", "normalize_advantages": False}
    a, b = configured(algorithm="a2c", **same), configured(clip_value=False, **same)
    with jax.enable_x64(True):
        policy = make_policy(a, VECTOR)
        params = policy.init(jax.random.key(0)).astype(jnp.float64) + 0.1
        batch = jax.tree.map(jnp.asarray, random_batch())
        now = jax.jit(partial(score, policy))(params, batch.observation, batch.action)[..., 0]
        one = gradient_of(params, batch, hypers(value_coef=0.25), a)
        unmoved = gradient_of(params, batch._replace(log_prob=now), hypers(), b)
        moved = gradient_of(params, batch._replace(log_prob=now + 0.3), hypers(), b)
    np.testing.assert_allclose(one, unmoved, atol=1e-12)
    assert np.abs(one - moved).max() > 1e-3


def test_the_update_is_one_step_of_clipped_rmsprop_over_the_whole_batch() -> None:
    """TensorFlow's RMSProp as a loop; PyTorch's (zeros first, epsilon outside) is another."""
    config = configured(algorithm="a2c", hidden="4", rollout_steps=24, envs=1, steps=24)
    h = hypers(max_grad_norm=0.5, learning_rate=0.02)
    with jax.enable_x64(True):
        policy = make_policy(config, VECTOR)
        step = jax.jit(partial(update_on_all, parts=parts_of(config, policy)))
        state = init_state(parts_of(config, policy), jax.random.key(0))
        state = jax.tree.map(lambda x: x.astype(jnp.float64), state)
        params = np.asarray(state.params)
        square, zeros, torchs = np.ones_like(params), np.zeros_like(params), params
        for number in range(3):
            batch = jax.tree.map(jnp.asarray, random_batch(seed=number))
            order = np.random.default_rng(number).permutation(24)[None].astype(np.int32)
            state, _, norm = step(state, batch, h, order)
            g = np.asarray(gradient_of(jnp.asarray(params), batch, h, config))
            np.testing.assert_allclose(norm, np.sqrt((g**2).sum()), rtol=1e-6)
            g = g * min(1.0, 0.5 / np.sqrt((g**2).sum()))
            square = 0.99 * square + 0.01 * g**2
            zeros = 0.99 * zeros + 0.01 * g**2
            params = params - 0.02 * g / np.sqrt(square + 1e-5)
            torchs = torchs - 0.02 * g / (np.sqrt(zeros) + 1e-5)
    np.testing.assert_allclose(state.params, params, atol=1e-9)
    assert np.abs(torchs - params).max() > 0.01


def test_n_step_returns_are_lambda_1() -> None:
    """`discount_with_dones` of baselines: backwards from the value after the last step."""
    rollout = random_rollout(5, steps=5, envs=16)
    single = jax.tree.map(lambda x: jnp.asarray(x, np.float32) if x.dtype == float else x, rollout)
    config = configured(**PUBLISHED)
    expected = np.zeros((5, 16))
    later = rollout.next_value[-1]
    for t in reversed(range(5)):
        later = np.where(rollout.truncated[t], rollout.next_value[t], later)
        later = expected[t] = rollout.reward[t] + 0.9 * later * ~rollout.terminated[t]

    def returns(gae_lambda: float) -> np.ndarray:
        h = jax.tree.map(np.float32, hypers(gae_lambda=gae_lambda))
        batch = make_batch(single, h, no_key(), config=config, target=TARGETS["sample"])
        return np.asarray(batch.return_).reshape(5, 16)

    np.testing.assert_allclose(returns(1.0), expected, atol=1e-5)
    assert np.abs(returns(0.95) - expected).max() > 0.01


def test_its_presets_are_the_published_numbers() -> None:
    config = resolve({"env": "x", "arm": "ppo", "algorithm": "a2c"})
    published = {
        "preset": "a2c",
        "algorithm": "a2c",
        "rollout_steps": 5,
        "envs": 16,
        "minibatches": 1,
        "epochs": 1,
        "learning_rate": 7e-4,
        "learning_rate_schedule": "linear",
        "optimizer": "rmsprop",
        "rmsprop_decay": 0.99,
        "rmsprop_epsilon": 1e-5,
        "value_coef": 0.5,
        "entropy_coef": 0.01,
        "max_grad_norm": 0.5,
        "gamma": 0.99,
        "gae_lambda": 1.0,
        "normalize_advantages": False,
        "trunk": "shared",
        "hidden": (64, 64),
    }
    assert {name: getattr(config, name) for name in published} == published
    assert resolve({"env": "x", "arm": "ppo", "preset": "a2c"}) == config
    other = resolve({"env": "x", "arm": "ppo", "preset": "a2c-mujoco"})
    changed = {name for name in FIELDS if getattr(other, name) != getattr(config, name)}
    assert changed == {"preset", "trunk", "entropy_coef"}
    atari = resolve({"env": "x", "arm": "ppo", "preset": "a2c-atari"})
    assert (atari.sign_rewards, atari.normalize_rewards) == (True, False)
    assert (atari.trunk, atari.entropy_coef) == ("shared", 0.01)
    assert PRESET_HELP.keys() == PRESETS.keys()


def test_ppo_is_what_it_was() -> None:
    """Where no algorithm is named, and in runs that were stored before there was another."""
    for config in (resolve({"env": "x"}), stored_config({"env": "x"})):
        assert (config.algorithm, config.optimizer, config.preset) == ("ppo", "adam", "mujoco")


@pytest.mark.parametrize(
    "given, message",
    [
        ({"algorithm": "a2c", "clip_range": 0.1}, "clip_range: not read .* algorithm ppo"),
        ({"algorithm": "a2c", "clip_value": False}, "clip_value: not read"),
        ({"algorithm": "a2c", "epochs": 1}, "epochs: not read"),
        ({"preset": "a2c", "minibatches": 1}, "minibatches: not read"),
        ({"algorithm": "a2c", "adam_epsilon": 1e-6}, "adam_epsilon: not read .* optimizer adam"),
        ({"rmsprop_decay": 0.9}, "rmsprop_decay: not read .* optimizer rmsprop"),
        ({"rmsprop_epsilon": 0.1}, "rmsprop_epsilon: not read"),
        ({"algorithm": "a2c", "preset": "mujoco"}, "not one of a2c's .a2c, a2c-atari, a2c-mujoco."),
        ({"algorithm": "ppo", "preset": "a2c"}, "a2c is not one of ppo's"),
        ({"algorithm": "a3c"}, "unknown value 'a3c'.*did you mean 'a2c'"),
        ({"algorithm": "a2c", "steps": 79}, "less than one rollout of 80"),
    ],
)
def test_settings_of_the_other_algorithm_are_refused(given: dict, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        resolve({"env": "x", **given})


@pytest.mark.parametrize("algorithm", ["ppo", "a2c"])
def test_either_algorithm_takes_either_optimizer(algorithm: str) -> None:
    """Whose state is stored under its own names, comes back, and fits no other one."""
    found = {}
    for optimizer in ("adam", "rmsprop"):
        config = configured(algorithm=algorithm, optimizer=optimizer, hidden="2")
        state = init_state(parts_of(config, make_policy(config, VECTOR)), jax.random.key(0))
        named = found[optimizer] = named_optimizer(state)
        again = unpack_optimizer(named, state)
        assert type(again) is type(state.optimizer)
        jax.tree.map(np.testing.assert_array_equal, again, state.optimizer)
    assert set(found["adam"]) == {"adam/count", "adam/mean", "adam/variance"}
    assert set(found["rmsprop"]) == {"rmsprop/mean_square"}
    with pytest.raises(BadCheckpoint, match="rmsprop/mean_square is missing"):
        unpack_optimizer(found["adam"], state)


OPTIONS = [
    ("sauna", {"threshold": 0.9}),
    pytest.param(
        "sauna",
        {"threshold": 0.9, "dropped": "mask", "history": "kept", "vex_target": "episode"},
        marks=pytest.mark.slow,
    ),
    pytest.param("sauna-paper", {"threshold": 0.9}, marks=pytest.mark.slow),
    pytest.param("sauna-reference", {"threshold": 0.9}, marks=pytest.mark.slow),
    pytest.param("random-drop", {"drop_rate": 0.5}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("arm, settings", OPTIONS)
def test_every_filter_works_at_5_steps_and_16_environments(arm: str, settings: dict) -> None:
    """It drops, no rollout is empty, and a resumed run ends with the same bytes."""
    job = job_of(arm, iterations=10, **settings)
    whole = train_here(job)
    assert len(whole.rows) > 3
    assert 0 < min(row["keep_rate"] for row in whole.rows) < 0.95
    for row in whole.rows:
        assert "kl" not in row and "clip_fraction" not in row
        assert row["policy_loss"] and row["vex_loss"] >= 0
    first = train_here(job, 2)
    second = train_here(resumed(job, first))
    assert equal(second.final, whole.final)
    assert first.rows + second.rows == whole.rows


def test_off_means_off_and_a_member_depends_on_its_own_seed_alone() -> None:
    plain = train_here(job_of("ppo", seeds=2)).final
    off = train_here(job_of("sauna", threshold=0.0, vex_coef=0.0, seeds="1,")).final
    assert equal(own(plain, "ppo/1"), own(off, "sauna/1"))
    on = train_here(job_of("sauna", threshold=0.9, seeds="1,")).final
    assert not equal(own(plain, "ppo/1"), own(on, "sauna/1"))


@pytest.mark.slow
def test_inside_the_compiled_program() -> None:
    """On the device: off means off, and a resumed run ends with the same bytes."""
    walk = "jax_envs:walk"
    plain = train_here(job_of("ppo", walk)).final
    off = train_here(job_of("sauna", walk, threshold=0.0, vex_coef=0.0)).final
    assert equal(own(plain, "ppo/0"), own(off, "sauna/0"))
    job = job_of("sauna", walk, iterations=20, threshold=0.9)
    whole = train_here(job)
    first = train_here(job, 3)
    assert equal(train_here(resumed(job, first)).final, whole.final)
    assert min(row["keep_rate"] for row in whole.rows) < 1


def test_a_comparison_calls_its_baseline_by_the_algorithm() -> None:
    spec = comparison("x", ("ppo", "vex-head", "sauna"), {"algorithm": "a2c", "rmsprop_decay": 0.9})
    assert [arm.label for arm in spec.arms] == ["a2c", "vex-head", "sauna"]
    assert spec.baseline == "a2c" and spec.arms[1].baseline == "a2c"
    assert check(spec.arms[0], "x").rmsprop_decay == 0.9
    assert [a.label for a in comparison("x", ("ppo", "sauna"), {}).arms] == ["ppo", "sauna"]


def test_the_study() -> None:
    spec = load_spec("a2c")
    assert [arm.label for arm in spec.arms] == ["a2c", "vex-head", "sauna 0.8 random", "sauna 0.8"]
    assert spec.tasks == ["Hopper-v5", "InvertedPendulum-v5"]
    for arm in spec.arms:
        config = check(arm, "Hopper-v5")
        assert (config.algorithm, config.steps, len(arm.seeds)) == ("a2c", 10**6, 6)


@pytest.mark.slow
def test_cartpole_is_solved() -> None:
    """475 on average over 100 episodes, by each of 3 seeds, within the 5e5 steps of SB3's zoo."""
    best: dict[int, float] = {}

    class UntilSolved(Recorder):
        def iteration(self, iteration: int, rows: list[dict], timing: dict) -> None:
            for row in rows:
                seed = row["seed"]
                best[seed] = max(best.get(seed, 0.0), row.get("return_mean", 0.0))

        def allowance(self, iteration: int) -> int:
            return 0 if len(best) == 3 and min(best.values()) > 475 else 1_000

    job = job_of(
        "ppo", "CartPole-v1", steps=500_000, seeds=3, envs=8, hidden="64,64", entropy_coef=0.0
    )
    train_members(job, UntilSolved())
    assert min(best.values()) > 475, best
