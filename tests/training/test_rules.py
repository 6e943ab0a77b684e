"""Every arm trains on the host and on the device, and resumes to the same bytes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arrays import random_rollout
from helpers import configured, equal, make_job, resumed, train_here
from sauna.algorithm.learner.program import make_learner, make_parts
from sauna.algorithm.learner.selected import drawn_length
from sauna.algorithm.learner.update import device_minibatch_order
from sauna.algorithm.policy.policy import make_policy, score
from sauna.algorithm.selection.control import controlled_filter
from sauna.algorithm.types import Hypers, member_keys, selection_key
from sauna.config.presets import ARMS
from sauna.envs.spaces import Spaces
from sauna.training.loop.device_program import IterationParts, learn_from
from sauna.training.loop.job import Setting
from sauna.training.loop.member_state import named_sampler

slow = pytest.mark.slow
RULES = [arm for arm in ARMS if arm not in ("ppo", "random-drop", "sauna-reference")]
SAMPLERS = [arm for arm in ARMS if ARMS[arm].get("sampler", "none") != "none"]
FAST = "gigaflow+random"
STATEFUL = {"gigaflow+random": 1, "prioritized": 1, "kondo": 0, "sauna+random": 0}
WALK = {"envs": 2, "steps": 512}


def marked(names: Any) -> list[Any]:
    return [name if name == FAST else pytest.param(name, marks=slow) for name in names]


@pytest.mark.parametrize("arm", marked([FAST, *RULES, "delight+random", "sauna+stride"]))
@pytest.mark.parametrize("place", ["device", pytest.param("host", marks=slow)])
def test_an_arm_trains_and_its_work_is_told(arm: str, place: str) -> None:
    """Two epochs of four minibatches of 16 rows; no rule takes more rows than there are."""
    env = {"host": "small_envs:Scripted", "device": "jax_envs:walk"}[place]
    job = make_job(env, arm=arm, **({"backend": "device"} if place == "device" else {}), **WALK)
    recorder = train_here(job)
    assert len(recorder.rows) >= (2 if "sauna" in arm else 8)
    for row in recorder.rows:
        assert row["samples_backward"] <= row["samples_forward"]
        if "gradient-norm" not in arm:
            assert row["samples_backward"] in (
                row["gradient_steps"] * 16,
                row["gradient_steps"] * 16 + 16,  # a step that a stop rule forbids
            )
        assert 0 <= row["sample_rate"] <= 1 and row["gradient_steps"] <= 8
        assert all(np.isfinite(x) for x in row.values() if isinstance(x, float))
    final = recorder.final
    assert all(np.isfinite(x).all() for name, x in final.items() if "/params/" in name)
    shares = {"top-advantage": 0.5, "kondo": 0.3}
    for name, share in shares.items():
        if arm == name:
            expected = np.ceil(share * 64) / 64
            np.testing.assert_allclose([row["sample_rate"] for row in recorder.rows], expected)


@pytest.mark.usefixtures("fresh_programs")
@pytest.mark.parametrize("dropped", ["replace", pytest.param("mask", marks=slow)])
@pytest.mark.parametrize("place", ["host", "device"])
def test_a_control_keeps_as_many_steps_of_each_env_as_its_rule(
    place: str, dropped: str, monkeypatch
) -> None:
    """In every iteration of a training. The first step of an env, which has no history, is kept."""
    seen: list[tuple[np.ndarray, ...]] = []

    def recorded(kind: str, keep: Any, advantage: Any, valid: Any, key: Any) -> Any:
        chosen = controlled_filter(kind, keep, advantage, valid, key)
        jax.debug.callback(
            lambda *masks: seen.append(tuple(map(np.asarray, masks))),
            keep,
            chosen,
            valid,
            ordered=True,
        )
        return chosen

    monkeypatch.setattr("sauna.algorithm.learner.samples.controlled_filter", recorded)
    env = {"host": "small_envs:Scripted", "device": "jax_envs:walk"}[place]
    settings = {"arm": "sauna+random", "threshold": 0.9, "dropped": dropped, **WALK}
    job = make_job(env, **settings, **({"backend": "device"} if place == "device" else {}))
    rows = train_here(job).rows
    ran = [masks for masks in seen if masks[2].any()]  # the device looks once more, in vain
    assert len(ran) == len(rows) > 2
    for (rule, chosen, valid), row in zip(ran, rows, strict=True):
        np.testing.assert_array_equal(chosen.sum(0), rule.sum(0))
        assert chosen[0].all() and not chosen[~valid].any()
        assert row["keep_rate"] == pytest.approx(chosen.sum() / valid.sum()) and rule.sum() > 2
    assert min(row["keep_rate"] for row in rows) < 0.9
    assert any(not np.array_equal(rule, chosen) for rule, chosen, _ in ran)


@pytest.mark.parametrize("place", ["host", pytest.param("device", marks=slow)])
@pytest.mark.parametrize("arm", marked(STATEFUL))
def test_a_rules_state_is_resumed_to_the_same_bytes(arm: str, place: str) -> None:
    env = {"host": "small_envs:Scripted", "device": "jax_envs:walk"}[place]
    job = make_job(env, arm=arm, **({"backend": "device"} if place == "device" else {}), **WALK)
    whole, first = train_here(job), train_here(job, 3)
    again = train_here(resumed(job, first))
    assert equal(again.final, whole.final) and first.rows + again.rows == whole.rows
    carried = [name for name in whole.final if "/sampler/" in name]
    assert len(carried) == STATEFUL[arm]
    for name in carried:
        assert not np.array_equal(first.final[name], whole.final[name])


@pytest.mark.parametrize(
    "arm", marked(dict.fromkeys(["gigaflow+random", *SAMPLERS, "delight", "espo", "recompute"]))
)
def test_the_device_learns_what_the_host_learns(arm: str) -> None:
    """From one rollout, with one order and one key; the device does it as one program."""
    spaces = Spaces("vector", (2,), "continuous", (1,), "", "")
    config = configured(
        arm=arm, rollout_steps=16, envs=2, minibatches=4, epochs=2, hidden="4", steps=128
    )
    policy = make_policy(config, spaces)
    learner = make_learner(config, policy, spaces)
    rollout = jax.tree.map(
        lambda x: jnp.asarray(x, np.float32 if x.dtype == float else None),
        random_rollout(2, 16, 2),
    )
    keys = member_keys(0)
    scores = score(policy, learner.init(keys.init).params, rollout.observation, rollout.action)
    rollout = rollout._replace(log_prob=scores[..., 0])  # a rule that stops sees ratios of 1 first
    values = {name: jnp.float32(getattr(config, name)) for name in Hypers._fields}
    h, iteration = Hypers(**values), jnp.int32(3)
    setting = Setting(keys, h, jnp.int32(128))
    parts = IterationParts(config, None, policy, make_parts(config, policy, spaces))  # type: ignore[arg-type]
    device, arrays = jax.jit(
        lambda state, rollout: learn_from(parts, state, rollout, setting, h, iteration)
    )(learner.init(keys.init), rollout)
    own = jax.random.fold_in(keys.order, iteration)
    order = device_minibatch_order(config, own, drawn_length(parts.learning))
    key = selection_key(keys, iteration)
    batch = learner.make_batch(rollout, h, key)
    host, said = learner.learn(learner.init(keys.init), rollout, batch, h, order, key)
    np.testing.assert_allclose(device.params, host.params, rtol=1e-4, atol=1e-6)
    assert not np.array_equal(host.params, learner.init(keys.init).params)
    for one, other in zip(
        named_sampler(device).values(), named_sampler(host).values(), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    for one, other in zip(jax.tree.leaves(arrays), jax.tree.leaves(said), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)
