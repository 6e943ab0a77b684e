"""A run that is trained further than it was to go."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from faults.canned import BACKENDS, Ended, Trap, go, played_back, record
from faults.disk import Crash, watched
from helpers import SMALL, configured
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.training import run as runs
from sauna.training.display import PlainDisplay
from sauna.training.loop.budget import device_hypers, hypers_now
from sauna.training.loop.job import Setting
from sauna.training.loop.member_state import Counters
from sauna.training.train import going_on
from threads import trained_here

WATCHED = {"eval_every": 64, "eval_episodes": 2}
KEPT = {"checkpoint_every": 2, "keep_checkpoints": 99}


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """A complete run of 192 steps, whose training was played back."""
    with played_back(record()):
        go(tmp_path / "run")
    return tmp_path / "run"


def rate(start: int, used: int, device: bool) -> float:
    config = configured(steps=200, schedule_start=start, minibatches=1, rollout_steps=10)
    if not device:
        return float(hypers_now(config, Counters(env_steps=used)).learning_rate)
    hypers = hypers_now(config, Counters())
    setting: Any = Setting(None, hypers, np.int32(200))  # type: ignore[arg-type]
    return float(device_hypers(config, setting, np.int32(used)).learning_rate)  # type: ignore[arg-type]


@pytest.mark.parametrize("device", [False, True])
def test_a_schedule_begins_where_it_is_told_to(device: bool) -> None:
    at_0 = [rate(0, used, device) / 3e-4 for used in (0, 100, 150)]
    at_100 = [rate(100, used, device) / 3e-4 for used in (0, 90, 100, 150, 200)]
    np.testing.assert_allclose(at_0, [1.0, 0.5, 0.25], rtol=1e-6)
    np.testing.assert_allclose(at_100, [1.0, 1.0, 1.0, 0.5, 0.0], rtol=1e-6, atol=1e-12)


def reopened(run: Path, **changes: Any) -> runs.Run:
    opened = runs.reopen(run, {"steps": 384}, PlainDisplay(), **changes)
    opened.lock.close()
    return opened


def test_more_steps_are_stored_and_the_run_is_not_complete_any_more(finished, capsys) -> None:
    assert reopened(finished).config.steps == 384
    assert "192 -> 384; learning_rate_schedule: as in a run of 384 steps, with 50% left" in (
        capsys.readouterr().out
    )
    stored = run_directory.read_config(finished)
    assert stored["config"]["steps"] == 384 and stored["config"]["schedule_start"] == 0
    assert [before["steps"] for before in stored["extended"]] == [192]
    assert not run_directory.is_complete(finished)


def test_restarted_schedules_begin_where_the_run_had_ended(finished, capsys) -> None:
    assert reopened(finished, restart_schedule=True).config.schedule_start == 192
    assert "learning_rate_schedule: anew from 192 to 384" in capsys.readouterr().out


def test_what_cannot_be_extended_says_why_and_changes_nothing(finished: Path) -> None:
    before = (finished / "config.json").read_bytes()
    for changes, message in (
        ({"steps": 128}, "steps: can only grow on resume; the run has 192"),
        ({"restart_schedule": True}, "restart_schedule: needs steps above 192"),
        ({"gamma": 0.5}, "gamma: cannot be changed on resume"),
        ({"schedule_start": 5}, "schedule_start: cannot be changed on resume"),
    ):
        with pytest.raises(BadInput, match=message):
            sauna.resume(finished, quiet=True, **changes)
    assert (finished / "config.json").read_bytes() == before
    run_directory.reopen_summary(finished)
    with pytest.raises(BadInput, match="is not complete"):
        sauna.resume(finished, quiet=True, steps=384, restart_schedule=True)


def test_a_run_with_constant_rates_has_no_schedule_to_restart(finished: Path) -> None:
    path = finished / "config.json"
    stored = json.loads(path.read_text())
    stored["config"]["learning_rate_schedule"] = "constant"
    path.write_text(json.dumps(stored))
    with pytest.raises(BadInput, match="has no schedule"):
        sauna.resume(finished, quiet=True, steps=384, restart_schedule=True)


def test_steps_that_were_changed_by_hand_are_refused(finished: Path) -> None:
    """Only a resume extends a run: it notes what the run was to be before."""
    path = finished / "config.json"
    stored = json.loads(path.read_text())
    stored["config"]["steps"] = 384
    path.write_text(json.dumps(stored))
    run_directory.reopen_summary(finished)
    with pytest.raises(BadInput, match="steps is 192, not 384"):
        sauna.resume(finished, quiet=True)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_run_given_twice_the_steps_is_one_given_them_at_once(backend: str, tmp_path) -> None:
    """With constant rates, to the byte; also if it is interrupted after that."""
    settings: dict[str, Any] = {**SMALL, **WATCHED, **KEPT, "arm": "ppo", "processes": 1}
    settings |= {"learning_rate_schedule": "constant", "quiet": True}
    whole, run = tmp_path / "whole", tmp_path / "run"
    with trained_here():
        sauna.train(BACKENDS[backend], out=whole, **{**settings, "steps": 256})
        sauna.train(BACKENDS[backend], out=run, **settings)
        sauna.resume(run, quiet=True, steps=256)
        assert Ended(whole).differs(run) is None
        (run / "summary.json").unlink()
        for path in checkpoint.numbered(run / "checkpoints")[2:]:
            path.rename(path.with_name(f"{path.name}.gone"))
        sauna.resume(run, quiet=True)
    assert Ended(whole).differs(run) is None


@pytest.mark.parametrize("changed", [{"steps": 9}, {"stop_at": 2.0}, {"stop_when_flat": 3}])
def test_a_run_that_goes_further_lets_stopped_members_go_on(changed: dict[str, Any]) -> None:
    config = {"steps": 5, "stop_at": 1.0, "stop_when_flat": 0}
    arrays = {
        "ppo/0/counters/stopped": np.array(1),
        "ppo/0/evaluation/since_best": np.array(4),
        "ppo/0/params/x": np.ones(2),
    }
    loaded = checkpoint.Checkpoint(Path(), {"config": config}, arrays)
    assert going_on(loaded, config) is loaded
    found = going_on(loaded, config | changed).arrays
    assert "ppo/0/counters/stopped" not in found
    assert found["ppo/0/evaluation/since_best"] == 0
    np.testing.assert_array_equal(found["ppo/0/params/x"], np.ones(2))


def test_killed_while_it_is_extended_a_run_is_the_old_one_or_the_new_one(
    finished, tmp_path
) -> None:
    """Whatever was written by then: the same command, or a plain resume, goes on from there."""
    rows = (finished / "metrics.jsonl").read_bytes()
    again = {"steps": 384, "quiet": True}
    with played_back(record()):
        whole = shutil.copytree(finished, tmp_path / "whole")
        trap = Trap()
        with watched(whole, trap):
            sauna.resume(whole, **again)
        assert len(trap.ops) > 4
        for at in range(len(trap.ops)):
            run = shutil.copytree(finished, tmp_path / f"killed-{at}")
            with pytest.raises((Crash, SaunaError)), watched(run, Trap(at)):
                sauna.resume(run, **again)
            stored = run_directory.read_config(run)
            assert stored["config"]["steps"] in (192, 384)
            assert ("extended" in stored) == (stored["config"]["steps"] == 384)
            sauna.resume(run, quiet=True)
            sauna.resume(run, **again)
            assert run_directory.is_complete(run)
            assert run_directory.read_config(run)["config"]["steps"] == 384
            assert (run / "metrics.jsonl").read_bytes() == rows
