"""Schedules against optax's own, and the same on the host and on the device."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import configured
from sauna.algorithm.types import Hypers
from sauna.config.presets import resolve
from sauna.config.settings import Config
from sauna.system.errors import BadInput
from sauna.training.loop.budget import device_hypers, hypers_now
from sauna.training.loop.job import Setting
from sauna.training.loop.member_state import Counters
from sauna.training.loop.schedules import check_schedules, shaped

STEPS, ROLLOUT = 10_000, 100
ROUNDING = 1e-8  # of 0.1 (1 + cos) / 2 in float32, near the end
USED = (0, 100, 450, 500, 2_500, 9_900)


def squared(progress):
    return (1.0 - progress) ** 2


def in_two(progress):
    return 1.0 if progress < 0.5 else 0.1


def negative(progress):
    return -progress


NAMED = f"{__name__}:squared"


def small(**settings) -> Config:
    return configured(
        arm="ppo", steps=STEPS, rollout_steps=ROLLOUT, minibatches=5, learning_rate=0.1, **settings
    )


def now(config: Config, used: int) -> Hypers:
    return hypers_now(config, Counters(env_steps=used))


@pytest.mark.parametrize("schedule", ["linear", "cosine"])
def test_a_schedule_is_optax_s(schedule: str) -> None:
    oracle = {
        "linear": optax.linear_schedule(0.1, 0.0, STEPS),
        "cosine": optax.cosine_decay_schedule(0.1, STEPS),
    }[schedule]
    config = small(learning_rate_schedule=schedule)
    found = [float(now(config, used).learning_rate) for used in USED]
    np.testing.assert_allclose(found, [float(oracle(used)) for used in USED], 1e-5, ROUNDING)


def test_a_warm_up_is_optax_s_at_the_end_of_each_rollout() -> None:
    """5% of 10,000 steps are five rollouts of 100: a fifth of the rate, two fifths, ..."""
    config = small(learning_rate_schedule="cosine", warmup=0.05)
    oracle = optax.warmup_cosine_decay_schedule(0.0, 0.1, 500, STEPS)
    found = [float(now(config, used).learning_rate) for used in USED]
    rising = [float(oracle(used + ROLLOUT)) for used in (0, 100)]
    np.testing.assert_allclose(found[:2], rising, rtol=1e-5)
    np.testing.assert_allclose(found[:2], [0.02, 0.04], rtol=1e-5)
    np.testing.assert_allclose(
        found[2:], [0.1, *[float(oracle(u)) for u in USED[3:]]], 1e-5, ROUNDING
    )


def test_a_function_of_the_user_s_gets_the_progress() -> None:
    config = small(clip_range_schedule=NAMED, clip_range=0.2)
    np.testing.assert_allclose(now(config, 2_500).clip_range, 0.2 * 0.75**2, rtol=1e-6)


@pytest.mark.parametrize("schedule", ["constant", "linear", "cosine", NAMED])
def test_each_field_has_its_own_schedule_on_the_host_and_on_the_device(schedule: str) -> None:
    fields = {"learning_rate": 0.1, "clip_range": 0.2, "entropy_coef": 0.3}
    for name in fields:
        plain = {f"{other}_schedule": "constant" for other in fields}
        config = small(entropy_coef=0.3, **{**plain, f"{name}_schedule": schedule})
        first = Hypers(*[jnp.float32(getattr(config, field)) for field in Hypers._fields])
        setting = Setting(None, first, jnp.int32(STEPS))  # type: ignore[arg-type] # no key is read
        moved = jax.jit(lambda used, c=config, s=setting: device_hypers(c, s, used))
        for used in (0, 2_500, 9_900):
            here, there = now(config, used), moved(jnp.int32(used))
            np.testing.assert_allclose(np.array(here), np.array(there), 1e-5, 3 * ROUNDING)
            for other in set(fields) - {name}:
                assert float(getattr(here, other)) == np.float32(fields[other])
            factor = float(getattr(here, name)) / fields[name]
            np.testing.assert_allclose(factor, shaped(1.0, schedule, 1 - used / STEPS), 1e-5)


@pytest.mark.parametrize("settings", [{"learning_rate_schedule": "cosine"}, {"warmup": 0.05}])
def test_restarted_schedules_are_those_of_the_budget_behind_their_start(settings: dict) -> None:
    """Of 10,000 steps behind 5,000, as of 10,000 steps; before them, as at their beginning."""
    whole = dataclasses.replace(small(**settings), steps=STEPS + 5_000, schedule_start=5_000)
    first = Hypers(*[jnp.float32(getattr(whole, field)) for field in Hypers._fields])
    setting = Setting(None, first, jnp.int32(whole.steps))  # type: ignore[arg-type] # no key is read
    for used in USED:
        expected = now(small(**settings), used)
        assert now(whole, used + 5_000) == expected
        there = device_hypers(whole, setting, jnp.int32(used + 5_000))
        np.testing.assert_allclose(np.array(there), np.array(expected), 1e-4, 3 * ROUNDING)
    assert now(whole, 4_000) == now(whole, 5_000)


def test_a_warm_up_is_the_same_on_the_device() -> None:
    config = small(warmup=0.05)
    first = Hypers(*[jnp.float32(getattr(config, field)) for field in Hypers._fields])
    setting = Setting(None, first, jnp.int32(STEPS))  # type: ignore[arg-type] # no key is read
    for used in USED:
        there = device_hypers(config, setting, jnp.int32(used))
        np.testing.assert_allclose(
            there.learning_rate, now(config, used).learning_rate, rtol=1e-4, atol=1e-9
        )


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"learning_rate_schedule": "kl", "warmup": 0.1}, "warmup: not read"),
        ({"desired_kl": 0.02}, "desired_kl: not read"),
        ({"learning_rate_min": 1e-4}, "learning_rate_min: not read"),
        ({"learning_rate_schedule": "kl", "algorithm": "a2c"}, "kl needs algorithm ppo"),
        ({"learning_rate_schedule": "kl", "learning_rate": 0.1}, "lies outside"),
        ({"clip_range_schedule": "linear", "algorithm": "a2c"}, "clip_range_schedule: not read"),
        ({"entropy_coef_schedule": "linear"}, "entropy_coef_schedule: not read"),
        ({"clip_range_schedule": "kl"}, "unknown value 'kl'"),
        ({"learning_rate_schedule": "cosin"}, "did you mean 'cosine'"),
        ({"warmup": 1.0}, "at most 0.99"),
        ({"clip_range_schedule": "no_such_module:f"}, "cannot import 'no_such_module'"),
    ],
)
def test_what_a_schedule_does_not_read_is_refused(settings: dict, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        resolve({"env": "x", **settings})


def test_a_function_that_cannot_be_used_is_refused_before_the_run() -> None:
    config = small(learning_rate_schedule=f"{__name__}:in_two")
    check_schedules(config)
    with pytest.raises(BadInput, match=r"in_two cannot be used.*jnp\.where in place of if"):
        check_schedules(dataclasses.replace(config, backend="device"))
    with pytest.raises(BadInput, match=r"gives -0\.25 at progress 0\.25"):
        check_schedules(small(clip_range_schedule=f"{__name__}:negative"))
