"""A resolved run goes through config.json unchanged, whatever the presets are afterwards."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from sauna.config import presets
from sauna.config.presets import ARMS, FIXED, RunConfig, overrides_of, resolve_run
from sauna.config.settings import Config, to_json
from sauna.config.stored import read_stored, to_stored
from sauna.system.errors import BadInput
from sauna.system.migrations import with_arms

# Settings of the user's own for every arm, and several arms in one program.
RUNS: list[dict[str, Any]] = [
    *({"arm": arm, **({"drop_rate": 0.2} if arm == "random-drop" else {})} for arm in ARMS),
    {"arm": "ppo,vex-head", "vex_coef": 0.7},
    {"arm": "ppo,vex-head,sauna", "threshold": 0.8, "seeds": "4,9", "preset": "mujoco-release"},
    {"arm": "vex-head,sauna-paper", "vex_coef": 0.1, "envs": 2, "decision": "joint"},
    {"arm": "ppo,sauna-reference", "history": "all", "truncation": "bootstrap", "gae_over": "all"},
    {"arm": "ppo", "algorithm": "a2c", "entropy_coef": 0.02},
]


def through_json(run: RunConfig) -> dict[str, Any]:
    return json.loads(json.dumps(to_stored(run)))


@pytest.mark.parametrize("overrides", RUNS, ids=lambda run: run["arm"])
def test_every_arm_goes_through_json_unchanged(overrides: dict[str, Any]) -> None:
    run = resolve_run({"env": "x", **overrides})
    again = read_stored(through_json(run))
    assert again == run and again.members == run.members


@pytest.mark.parametrize("overrides", RUNS, ids=lambda run: run["arm"])
def test_a_stored_run_needs_no_preset_or_default_of_today(
    overrides: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = resolve_run({"env": "x", **overrides})
    stored = through_json(run)
    for name in presets.PRESETS:
        monkeypatch.setitem(presets.PRESETS, name, {"learning_rate": 0.5, "gamma": 0.5, "envs": 4})
    for name in ARMS:
        monkeypatch.setitem(presets.ARMS, name, {**ARMS[name], "vex_coef": 0.25})
    assert read_stored(stored) == run


@pytest.mark.parametrize("overrides", RUNS, ids=lambda run: run["arm"])
def test_the_same_run_again_is_given_by_what_is_stored(
    overrides: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also when a preset has changed since; its directory and processes are a new run's own."""
    run = resolve_run({"env": "x", "out": "here", "processes": 3, **overrides})
    stored, fresh = through_json(run), run.replace(out="", processes=0)
    assert resolve_run(overrides_of(read_stored(stored))) == fresh
    for name, values in presets.PRESETS.items():
        monkeypatch.setitem(presets.PRESETS, name, {**values, "gae_lambda": 0.5, "steps": 10**7})
    assert resolve_run({"env": "x", **overrides}) != fresh.replace(out="", processes=0)
    assert resolve_run(overrides_of(read_stored(stored))) == fresh


def test_what_is_usual_for_an_environment_alone_is_given_again() -> None:
    """Actions of the published tasks are not rescaled unless a run says so."""
    run = resolve_run({"env": "Ant-v5", "rescale_actions": True})
    assert overrides_of(run)["rescale_actions"] is True
    assert resolve_run(overrides_of(run)) == run
    assert "rescale_actions" not in overrides_of(resolve_run({"env": "Ant-v5"}))


@pytest.mark.parametrize("overrides", RUNS, ids=lambda run: run["arm"])
def test_the_arms_of_runs_of_0_1_0_are_found(overrides: dict[str, Any]) -> None:
    """They held what the user gave, and each arm's values were derived from that."""
    run = resolve_run({"env": "x", **overrides})
    stored = {"given": presets.plain({"env": "x", **overrides}), "config": to_json(run.config)}
    assert read_stored(json.loads(json.dumps(stored))) == run


def test_arms_of_0_1_0_by_hand() -> None:
    config = {"arm": ["ppo", "vex-head"], "vex_coef": 0.0, "threshold": 0.3}
    found = with_arms({"config": config, "given": {"vex_coef": 0.7}})
    assert found == {"config": config, "arms": {"ppo": {}, "vex-head": {"vex_coef": 0.7}}}
    config = {"arm": ["vex-head", "sauna", "ppo"], "vex_coef": 0.5, "threshold": 0.3}
    off = {"threshold": 0.0}
    arms = {"vex-head": off, "sauna": {}, "ppo": {"vex_coef": 0.0, **off}}
    assert with_arms({"config": config, "given": {}})["arms"] == arms
    assert with_arms({"config": config, "arms": {"x": {}}})["arms"] == {"x": {}}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"config": {}}, "holds no 'config'"),
        ({"config": []}, "'config' is no table"),
        ({"arms": []}, "'arms' is no table"),
        ({"arms": {}}, "must hold a table for each of ppo, sauna"),
        ({"arms": {"ppo": {}, "sauna": 3}}, "must hold a table for each"),
        ({"arms": {"ppo": {}, "sauna": {"treshold": 1}}}, "did you mean 'threshold'"),
    ],
)
def test_a_damaged_config_is_one_line(change: dict[str, Any], message: str) -> None:
    stored = through_json(resolve_run({"env": "x", "arm": "ppo,sauna"}))
    with pytest.raises(BadInput, match=message):
        read_stored({**stored, **change})


def test_an_arm_fixes_only_what_it_sets() -> None:
    assert all(set(names) <= set(ARMS[arm]) for arm, names in FIXED.items())
    assert dataclasses.replace(Config(), arm=("ppo",)).arm == ("ppo",)
