"""A function of the user's that sees every row, and may stop the row's member."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from faults.canned import ENV, SAVED, SETTINGS, Ended, go, played_back, record
from sauna.experiments.run_list import examine
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput
from sauna.training.summary import STOPS
from threads import trained_here


class OfUser(Exception):
    """A mistake in a callback."""


def test_a_callback_sees_a_copy_of_each_row_in_order(tmp_path: Path) -> None:
    seen: list[dict[str, Any]] = []

    def look(row: dict[str, Any]) -> None:
        seen.append(copy.deepcopy(row))
        row["episode_returns"].clear()
        row["env_steps"] = -1

    with played_back(record()):
        sauna.train(ENV, out=tmp_path / "run", quiet=True, callback=look, **SAVED, **SETTINGS)
    assert seen == run_directory.rows(tmp_path / "run") == record().rows


def test_an_exception_of_a_callback_is_its_own_and_the_run_goes_on_later(tmp_path: Path) -> None:
    run, whole = tmp_path / "run", tmp_path / "whole"

    def fail(row: dict[str, Any]) -> None:
        if row["iteration"] == 3:
            raise OfUser("a typo")

    with played_back(record()):
        with pytest.raises(OfUser, match="a typo") as caught:
            sauna.train(ENV, out=run, quiet=True, callback=fail, **SAVED, **SETTINGS)
        assert "fail" in [frame.name for frame in caught.traceback]
        (note,) = caught.value.__notes__
        assert "iteration 3 of ppo/0" in note and f"sauna resume {run}" in note
        assert (run / "failure.txt").read_text().rstrip().endswith("OfUser: a typo")
        assert examine(run).state == "failed"
        go(run)
        go(whole)
    assert Ended(whole).differs(run) is None


def test_a_stop_is_in_the_checkpoint_at_the_end_of_the_same_iteration(tmp_path: Path) -> None:
    """A run that is killed right after it goes on without that member, also without callback."""
    run = tmp_path / "run"
    settings = {**SETTINGS, "seeds": 2, "checkpoint_every": 2, "keep_checkpoints": 9}
    settings["processes"] = 2  # of which one ends early

    def stop(row: dict[str, Any]) -> bool:
        return row["member"] == "ppo/0" and row["iteration"] >= 1

    with trained_here():
        result = sauna.train(ENV, out=run, quiet=True, callback=stop, **settings)
        metrics = (run / "metrics.jsonl").read_bytes()
        assert [r["iteration"] for r in result.metrics if r["member"] == "ppo/0"] == [0, 1]
        assert [r["iteration"] for r in result.metrics if r["member"] == "ppo/1"] == [*range(6)]
        assert result.summary["ppo/0"]["stopped_early"] == "callback"
        assert "stopped_early" not in result.summary["ppo/1"]
        first, *later = checkpoint.numbered(run / "checkpoints")
        loaded = checkpoint.load_checkpoint(first)
        assert loaded.manifest["iteration"] == 2
        assert loaded.arrays["ppo/0/counters/stopped"] == STOPS.index("callback")
        whole = Ended(run)
        for path in later:
            path.rename(path.with_name(f"{path.name}.gone"))
        (run / "summary.json").unlink()
        result = sauna.resume(run, quiet=True)
    assert (run / "metrics.jsonl").read_bytes() == metrics and whole.differs(run) is None
    assert result.summary["ppo/0"]["stopped_early"] == "callback"


@pytest.mark.parametrize(
    "callback, words",
    [(3, "must be a function of a row, not int"), (lambda: True, "cannot be called with a row")],
)
def test_what_cannot_be_called_with_a_row_is_refused(callback: Any, words: str, tmp_path) -> None:
    with pytest.raises(BadInput, match=f"callback: {words}") as error:
        sauna.train(ENV, out=tmp_path / "run", quiet=True, callback=callback, **SETTINGS)
    assert "\n" not in str(error.value) and list(tmp_path.iterdir()) == []


def test_callbacks_do_not_run_on_several_machines(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="callback: not called with distributed"):
        sauna.train(
            "jax_envs:walk",
            distributed="h:1,2,0",
            quiet=True,
            out=tmp_path / "run",
            callback=lambda row: None,
        )
    assert list(tmp_path.iterdir()) == []


def test_stopped_indices_are_whole_numbers_of_one_type() -> None:
    """The coordinator and a worker write the same bytes."""
    assert np.asarray(STOPS.index("callback")).dtype == np.int64


def test_what_a_callback_returns_by_accident_does_not_stop_the_training(tmp_path: Path) -> None:
    def log(row: dict[str, Any]) -> Any:
        return (tmp_path / "log").write_text(str(row["iteration"]))  # the number of characters

    with played_back(record()), pytest.raises(TypeError, match="callback returned a int; True"):
        sauna.train(ENV, out=tmp_path / "run", quiet=True, callback=log, **SAVED, **SETTINGS)


def test_an_error_of_a_callback_s_own_files_is_not_taken_for_one_of_the_run(tmp_path: Path) -> None:
    def fail(row: dict[str, Any]) -> None:
        raise TimeoutError("the server is away")

    with played_back(record()), pytest.raises(TimeoutError, match="server is away") as caught:
        sauna.train(ENV, out=tmp_path / "run", quiet=True, callback=fail, **SAVED, **SETTINGS)
    assert caught.value.__cause__ is None and caught.value.__context__ is None


def test_a_stop_at_the_last_iteration_is_no_early_one(tmp_path: Path) -> None:
    with trained_here():
        result = sauna.train(
            ENV,
            out=tmp_path / "run",
            quiet=True,
            callback=lambda row: row["iteration"] == 5,
            **SETTINGS,
        )
    assert [row["iteration"] for row in result.metrics] == [*range(6)]
    assert "stopped_early" not in result.summary["ppo/0"]


def test_a_resume_that_is_refused_changes_nothing(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with played_back(record()):
        sauna.train(ENV, out=run, quiet=True, **SAVED, **SETTINGS)
    before = {path: path.read_bytes() for path in run.iterdir() if path.is_file()}
    with pytest.raises(BadInput, match="callback: must be a function of a row"):
        sauna.resume(run, steps=10**6, callback=5, quiet=True)
    after = {path: path.read_bytes() for path in run.iterdir() if path.is_file()}
    assert after == before and examine(run).state == "finished"
