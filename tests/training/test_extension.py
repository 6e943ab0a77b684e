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
from sauna.algorithm.types import Hypers
from sauna.config.settings_file import settings_in
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


def rate(start: int, used: int, device: bool, **settings: Any) -> float:
    settings = {"minibatches": 1, "rollout_steps": 10, **settings}
    config = configured(steps=200, schedule_start=start, **settings)
    if not device:
        return float(hypers_now(config, Counters(env_steps=used)).learning_rate)
    values = {name: np.float32(getattr(config, name)) for name in Hypers._fields}
    setting: Any = Setting(None, Hypers(**values), np.int32(200))  # type: ignore[arg-type]
    return float(device_hypers(config, setting, np.int32(used)).learning_rate)  # type: ignore[arg-type]


@pytest.mark.parametrize("device", [False, True])
def test_a_schedule_begins_where_it_is_told_to(device: bool) -> None:
    at_0 = [rate(0, used, device) / 3e-4 for used in (0, 100, 150)]
    at_100 = [rate(100, used, device) / 3e-4 for used in (0, 90, 100, 150, 200)]
    np.testing.assert_allclose(at_0, [1.0, 0.5, 0.25], rtol=1e-6)
    np.testing.assert_allclose(at_100, [1.0, 1.0, 1.0, 0.5, 0.0], rtol=1e-6, atol=1e-12)
    warm: dict[str, Any] = {"learning_rate_schedule": "constant", "warmup": 0.5}
    rising = [rate(100, used, device, **warm) / 3e-4 for used in (0, 100, 130, 140, 200)]
    np.testing.assert_allclose(rising, [0.2, 0.2, 0.8, 1.0, 1.0], rtol=1e-6)


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


def test_a_new_run_with_its_settings_begins_its_schedules_at_the_start(finished: Path) -> None:
    reopened(finished, restart_schedule=True)
    settings = settings_in(str(finished / "config.json"), trust=False)
    assert settings["steps"] == 384 and "schedule_start" not in settings
    assert settings_in(str(finished), trust=False) == settings
    stored = json.loads((finished / "config.json").read_text())
    stored["extended"][0]["schedule_start"] = 64  # the user's own
    (finished / "config.json").write_text(json.dumps(stored))
    assert settings_in(str(finished / "config.json"), trust=False)["schedule_start"] == 64


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


def with_rates(run: Path, **changes: Any) -> Path:
    """A run as if it had been trained with other schedules."""
    path = run / "config.json"
    stored = json.loads(path.read_text())
    stored["config"] |= changes
    path.write_text(json.dumps(stored))
    return run


@pytest.mark.parametrize("schedule", ["constant", "kl"])
def test_a_run_whose_rates_follow_no_budget_has_no_schedule_to_restart(
    finished: Path, schedule: str, capsys
) -> None:
    with_rates(finished, learning_rate_schedule=schedule)
    with pytest.raises(BadInput, match="has no schedule or warm-up of its budget"):
        sauna.resume(finished, quiet=True, steps=384, restart_schedule=True)
    reopened(finished)
    assert "steps: 192 -> 384\n" in capsys.readouterr().out


@pytest.mark.parametrize("restart, said", [(False, "as in a run of 384"), (True, "anew from 192")])
def test_a_warm_up_is_a_share_of_the_budget_and_counts_as_a_schedule(
    finished: Path, restart: bool, said: str, capsys
) -> None:
    with_rates(finished, learning_rate_schedule="constant", warmup=0.5)
    config = reopened(finished, restart_schedule=restart).config
    assert f"steps: 192 -> 384; warmup: {said}" in capsys.readouterr().out
    assert (config.warmup, config.schedule_start) == (0.5, 192 * restart)


def test_steps_that_were_changed_by_hand_are_refused(finished: Path) -> None:
    """Only a resume extends a run: it notes what the run was to be before."""
    path = finished / "config.json"
    stored = json.loads(path.read_text())
    stored["config"]["steps"] = 384
    path.write_text(json.dumps(stored))
    run_directory.reopen_summary(finished)
    with pytest.raises(BadInput, match="steps is 192, not 384"):
        sauna.resume(finished, quiet=True)


@pytest.mark.parametrize(
    "backend, schedule", [("host", "constant"), ("device", "constant"), ("host", "kl")]
)
def test_a_run_given_twice_the_steps_is_one_given_them_at_once(
    backend: str, schedule: str, tmp_path: Path
) -> None:
    """With rates that follow no budget, to the byte; also if it is interrupted after that."""
    settings: dict[str, Any] = {**SMALL, **WATCHED, **KEPT, "arm": "ppo", "processes": 1}
    settings |= {"learning_rate_schedule": schedule, "quiet": True}
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


MOVED = {"learning_rate_schedule": "linear", "warmup": 0.25, "clip_range_schedule": "cosine"}
SCHEDULED: dict[str, Any] = {**SMALL, **WATCHED, **MOVED, "arm": "ppo", "processes": 1}
SCHEDULED |= {"checkpoint_every": 1, "quiet": True}


class Interruption(Exception):
    """Of the user's, by a callback."""


def interrupted(iteration: int, train: Any, *given: Any, **settings: Any) -> None:
    """A training that ends before the checkpoint of an iteration is saved."""

    def callback(row: dict[str, Any]) -> None:
        if row["iteration"] == iteration:
            raise Interruption

    with pytest.raises(Interruption):
        train(*given, callback=callback, **settings)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete run of four iterations, in which two rates move."""
    run = tmp_path_factory.mktemp("scheduled") / "short"
    with trained_here():
        sauna.train(BACKENDS["host"], out=run, **SCHEDULED)
    return run


def rates(run: Path) -> list[tuple[float, float]]:
    return [(row["learning_rate"], row["clip_range"]) for row in run_directory.rows(run)]


def test_rates_after_an_extension_are_those_of_a_run_of_the_new_budget(short, tmp_path) -> None:
    """Before it they are the shorter run's; and interruptions on the way change no byte."""
    run = shutil.copytree(short, tmp_path / "run")
    at_once, halting = tmp_path / "at_once", tmp_path / "halting"
    with trained_here():
        sauna.resume(run, quiet=True, steps=256)
        sauna.train(BACKENDS["host"], out=at_once, **{**SCHEDULED, "steps": 256})
        interrupted(2, sauna.train, BACKENDS["host"], out=halting, **SCHEDULED)
        sauna.resume(halting, quiet=True)
        assert Ended(short).differs(halting) is None
        interrupted(6, sauna.resume, halting, quiet=True, steps=256)
        sauna.resume(halting, quiet=True)
    assert rates(run) == [*rates(short), *rates(at_once)[4:]]
    assert rates(short) != rates(at_once)[:4] and len(rates(run)) == 8
    assert Ended(run).differs(halting) is None


def test_restarted_rates_run_through_all_of_their_values_again(short, tmp_path) -> None:
    """The steps that are added are as many as those of before, so the rates are the same."""
    run = shutil.copytree(short, tmp_path / "run")
    with trained_here():
        sauna.resume(run, quiet=True, steps=256, restart_schedule=True)
    assert rates(run) == 2 * rates(short) and len(set(rates(short))) == 4


def test_a_member_that_was_stopped_goes_on_and_the_other_one_as_it_would_have(tmp_path) -> None:
    settings = {**SCHEDULED, "learning_rate_schedule": "constant", "warmup": 0.0, "seeds": 2}
    del settings["clip_range_schedule"]
    whole, run = tmp_path / "whole", tmp_path / "run"
    with trained_here():
        result = sauna.train(BACKENDS["host"], out=whole, **{**settings, "steps": 256})
        first = [row for row in result.metrics if row["env_steps"] == 64]
        low, high = sorted(first, key=lambda row: row["eval_return_mean"])
        level = (low["eval_return_mean"] + high["eval_return_mean"]) / 2
        before = sauna.train(BACKENDS["host"], out=run, stop_at=level, **settings)
        assert before.summary[high["member"]]["stopped_early"] == "stop_at"
        after = sauna.resume(run, quiet=True, steps=256, stop_at=1e9)
    assert not any("stopped_early" in member for member in after.summary.values())

    def of(result: sauna.Result, member: str) -> list[dict[str, Any]]:
        return [row for row in result.metrics if row["member"] == member]

    steps = [row["env_steps"] for row in of(after, high["member"])]
    assert steps == [*range(32, 257, 32)]
    assert "stopped_early" not in before.summary[low["member"]]
    assert of(after, low["member"]) == of(result, low["member"])


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
