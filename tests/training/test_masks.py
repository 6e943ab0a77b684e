"""Training with masks of valid actions, on the host and on the device."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
import small_envs
from helpers import equal, make_job, resumed, train_here
from sauna.config.presets import ARMS
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.system.errors import BadInput

MASKED: dict[str, Any] = {"action_mask": True, "envs": 2, "hidden": "8"}
SEVERAL = {"env_kwargs": '{"several": true}'}
# The host's environment raises at an action that is not valid; the device's says so in its `info`.
PLACES = {"host": ("small_envs:Choosy", SEVERAL), "device": ("jax_envs:choosy", {})}


@pytest.mark.parametrize("place", ["host", pytest.param("device", marks=pytest.mark.slow)])
def test_a_resumed_run_took_valid_actions_alone_and_is_the_same_to_the_byte(place: str) -> None:
    env, more = PLACES[place]
    evaluated = {"eval_every": 64, "eval_episodes": 2, "eval_deterministic": False}
    job = make_job(env, **MASKED, **more, **evaluated)
    whole = train_here(job)
    assert any("eval_return_mean" in row for row in whole.rows)
    again = train_here(resumed(job, train_here(job, stop=1)))
    assert equal(again.final, whole.final)
    if place == "device":
        assert {row["info_invalid"] for row in whole.rows if "info_invalid" in row} == {0.0}


@pytest.mark.slow
def test_without_masks_the_same_env_sees_invalid_actions() -> None:
    rows = train_here(make_job("jax_envs:choosy", envs=2, hidden="8")).rows
    assert any(row.get("info_invalid", 0.0) > 0.5 for row in rows)


def test_an_env_that_raises_at_invalid_actions_is_refused_without_masks() -> None:
    with pytest.raises(BadInput, match="is not valid"):
        make_job("small_envs:Choosy", envs=2, **SEVERAL)


@pytest.mark.slow
def test_a_mask_without_a_valid_action_ends_training_on_the_device_with_a_reason() -> None:
    with pytest.raises(EnvironmentFailure, match=r"step 2 .* leaves no valid action"):
        train_here(make_job("jax_envs:stuck", **MASKED))


def test_a_loaded_policy_needs_the_mask_and_follows_it(tmp_path: Path) -> None:
    settings = {**MASKED, "steps": 128, "rollout_steps": 32, "quiet": True}
    run = tmp_path / "run"
    sauna.train(small_envs.Choosy, env_kwargs={"by": "method"}, out=run, **settings)
    policy = sauna.load(run)
    seen = np.zeros((4, 3), np.float32)
    masks = np.eye(5, dtype=bool)[[3, 0, 4, 2]]
    np.testing.assert_array_equal(policy(seen, action_mask=masks), [4, 1, 5, 3])  # start=1
    assert policy(seen[0], action_mask=[0, 0, 1, 0, 0]) == 3
    assert policy.predict(seen[0], action_masks=masks[0])[0] == 4
    for given, words in ((None, "trained with masks"), ([0] * 5, "no valid action")):
        with pytest.raises(BadInput, match=f"^action_mask: .*{words}"):
            policy(seen[0], action_mask=given)
    result = sauna.evaluate(run, episodes=2, say=lambda text: None)
    assert len(result["members"]["ppo/0"]["returns"]) == 2


KINDS = {
    "masks": (PLACES["host"], MASKED),
    "masks on the device": (PLACES["device"], MASKED),
    "pictures": (("sauna.envs.small:Signpost", {}), {"envs": 2, "hidden": "8"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("arm", [*ARMS, "sauna+random", "kondo+stride"])
def test_every_rule_works_with_masks_and_with_pictures_beside_numbers(arm: str, kind: str) -> None:
    (env, more), settings = KINDS[kind]
    needed = {"drop_rate": 0.3} if arm == "random-drop" else {}
    rows = train_here(make_job(env, **{**settings, **more, **needed, "arm": arm})).rows
    assert rows
    numbers = [x for row in rows for x in row.values() if isinstance(x, float)]
    assert np.isfinite(numbers).all()
