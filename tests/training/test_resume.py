"""A run interrupted any_member and resumed ends with the bytes of a run left alone."""

from __future__ import annotations

import csv
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from faults.canned import Ended
from helpers import SMALL, equal, make_job, resumed, train_here
from sauna.config import presets
from sauna.experiments.measure.streams import load_snapshot
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.training import run as runs
from sauna.training.display import make_display
from small_envs import Scripted
from threads import trained_here

ENV = "small_envs:Scripted"


@pytest.mark.parametrize("stops", [(1, 4, 7), pytest.param((2, 3, 5, 6), marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "settings",
    [
        {"arm": "sauna", "threshold": 0.9, "seeds": 2},
        {"arm": "sauna+random", "threshold": 0.9},
        {"arm": "ppo"},
    ],
)
def test_interrupted_after_any_iteration(stops: tuple[int, ...], settings) -> None:
    job = make_job(ENV, envs=2, steps=512, **settings)
    whole = train_here(job)
    for stop in stops:
        first = train_here(job, stop)
        second = train_here(resumed(job, first))
        assert equal(second.final, whole.final)
        assert first.rows + second.rows == whole.rows


MOVED = {
    "arm": "ppo",
    "learning_rate_schedule": "kl",
    "clip_range_schedule": "cosine",
    "entropy_coef": 0.01,
    "entropy_coef_schedule": "linear",
    "optimizer": "lion",
    "weight_decay": 0.1,
}


ON_DEVICE = {"env": "jax_envs:walk", "backend": "device", "devices": 1}


@pytest.mark.parametrize("env", [{"env": ENV}, pytest.param(ON_DEVICE, marks=pytest.mark.slow)])
def test_what_moves_during_training_resumes_exactly(env: dict[str, Any]) -> None:
    """A rate that follows the KL, two schedules, an optimizer of optax; on host and device."""
    job = make_job(envs=2, steps=512, checkpoint_every=3, **env, **MOVED)
    whole = train_here(job)
    second = train_here(job._replace(restored=whole.states[3], start=3))
    assert equal(second.final, whole.final)
    assert second.rows == whole.rows[3:]
    rates, clips = ([row[key] for row in whole.rows] for key in ("learning_rate", "clip_range"))
    assert whole.final["ppo/0/learning_rate"] == np.float32(rates[-1])
    assert len(set(rates)) > 1 and all(1e-5 <= rate <= 1e-2 for rate in rates)
    left = 1 - np.arange(8) / 8
    np.testing.assert_allclose(clips, 0.1 * (1 + np.cos(np.pi * (1 - left))), rtol=1e-5)
    np.testing.assert_allclose([row["entropy_coef"] for row in whole.rows], 0.01 * left, rtol=1e-5)


def test_evaluations_schedules_and_a_callback_together_resume_exactly(tmp_path: Path) -> None:
    """Of two members, the callback stops one; the run is interrupted before that, and after it."""
    settings = {**SMALL, **MOVED, "envs": 2, "steps": 512, "seeds": 2, "processes": 1}
    settings |= {"eval_every": 64, "eval_episodes": 2, "checkpoint_every": 2, "quiet": True}
    whole, run = tmp_path / "whole", tmp_path / "run"

    class Enough(Exception):
        pass

    def stopping(row: dict[str, Any]) -> bool:
        return row["seed"] == 1 and row["env_steps"] >= 256

    def interrupting(iteration: int) -> Any:
        def callback(row: dict[str, Any]) -> bool:
            if row["iteration"] == iteration:
                raise Enough
            return stopping(row)

        return callback

    with trained_here():
        expected = sauna.train(ENV, out=whole, callback=stopping, **settings)
        with pytest.raises(Enough):
            sauna.train(ENV, out=run, callback=interrupting(2), **settings)
        with pytest.raises(Enough):
            sauna.resume(run, quiet=True, callback=interrupting(6))
        result = sauna.resume(run, quiet=True, callback=stopping)
    assert Ended(whole).differs(run) is None
    stops = [member.get("stopped_early") for member in result.summary.values()]
    assert stops == [None, "callback"] and result.summary == expected.summary
    assert sum("eval_returns" in row for row in result.metrics) == 8 + 4


def test_resuming_a_complete_run_does_nothing(run: Path, capsys) -> None:
    before = {p: p.stat().st_mtime_ns for p in run.rglob("*") if p.name != ".lock"}
    sauna.resume(run)
    assert "nothing to do" in capsys.readouterr().out
    assert before == {p: p.stat().st_mtime_ns for p in run.rglob("*") if p.name != ".lock"}


def test_an_environment_that_cannot_be_restored_says_so_at_the_start(tmp_path, capsys) -> None:
    run = tmp_path / "run"
    sauna.train("small_envs:Forgetful", out=run, arm="sauna", **SMALL)
    said = capsys.readouterr().out
    assert "does not repeat itself" in said and "not resumed exactly" in said
    assert said.index("does not repeat") < said.index("writing to")
    assert run_directory.read_config(run)["exact_resume"] is False


def test_a_run_of_such_an_environment_goes_on_with_new_episodes(tmp_path, capsys) -> None:
    run = tmp_path / "run"
    sauna.train(
        "small_envs:Forgetful",
        out=run,
        quiet=True,
        checkpoint_every=2,
        keep_checkpoints=9,
        arm="ppo",
        **SMALL,
    )
    make_incomplete(run, 2)
    sauna.resume(run)
    assert "every environment starts a new episode" in capsys.readouterr().out
    assert [row["iteration"] for row in run_directory.rows(run)] == [0, 1, 2, 3]


def make_incomplete(run: Path, iteration: int) -> None:
    """As if the run had been killed after checkpoint `iteration`."""
    (run / "summary.json").unlink()
    for path in checkpoint.numbered(run / "checkpoints"):
        if int(path.name) > iteration:
            for part in path.iterdir():
                part.unlink()
            path.rmdir()


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, of which each test changes a copy."""
    run = tmp_path_factory.mktemp("finished") / "run"
    kept = {"checkpoint_every": 2, "keep_checkpoints": 9}
    with trained_here():
        sauna.train(ENV, out=run, quiet=True, arm="sauna", **kept, **SMALL)
    return run


@pytest.fixture
def run(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "run"))


def test_a_damaged_checkpoint_is_named_and_the_one_before_used(run, capsys) -> None:
    expected, table = (run / "metrics.jsonl").read_bytes(), timeless_table(run)
    (run / "summary.json").unlink()
    newest = checkpoint.numbered(run / "checkpoints")[-1]
    good = (newest / "state.safetensors").read_bytes()
    blob = bytearray(good)
    blob[len(blob) // 2] ^= 1
    (newest / "state.safetensors").write_bytes(blob)
    sauna.resume(run)
    said = capsys.readouterr().out
    assert newest.name in said and "SHA-256 differs" in said
    kept = newest.with_name(newest.name + ".bad")
    assert (kept / "state.safetensors").read_bytes() == bytes(blob)
    assert (newest / "state.safetensors").read_bytes() == good
    assert (run / "metrics.jsonl").read_bytes() == expected
    assert timeless_table(run) == table and len(table) > 2
    seconds = [row["wall_seconds"] for row in run_directory.rows(run, "timing.jsonl")]
    assert seconds == sorted(seconds)


def timeless_table(run: Path) -> list[list[str]]:
    """`metrics.csv` without the clock's column."""
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    clock = rows[0].index("wall_seconds")
    return [row[:clock] + row[clock + 1 :] for row in rows]


def test_a_damaged_newer_checkpoint_takes_no_place_of_a_good_one(tmp_path) -> None:
    arrays, manifest = {"x": np.ones(3, np.float32)}, {"config": {}}
    checkpoint.save_checkpoint(tmp_path, 50, arrays, manifest, keep=1)
    checkpoint.save_checkpoint(tmp_path, 100, arrays, manifest, keep=2)
    (tmp_path / "00000100" / "state.safetensors").write_bytes(b"cut")
    checkpoint.save_checkpoint(tmp_path, 70, arrays, manifest, keep=1)
    found = checkpoint.load_newest(tmp_path, lambda text: None)
    assert found is not None and found.path.name == "00000070"
    assert not (tmp_path / "00000050").exists()


def test_a_run_keeps_the_values_that_it_began_with(run, monkeypatch) -> None:
    """A later version may have other presets; members' own values are the run's."""
    expected = (run / "metrics.jsonl").read_bytes()
    make_incomplete(run, 2)
    changed = {**presets.PRESETS, "mujoco": {"learning_rate": 1e-3, "gae_lambda": 0.5}}
    monkeypatch.setattr(presets, "PRESETS", changed)
    opened = runs.reopen(run, {}, make_display())
    opened.lock.close()
    assert {(m.config.learning_rate, m.config.gae_lambda) for m in opened.members} == {(3e-4, 0.95)}
    snapshot = load_snapshot(run, opened.members[0].name, 2)
    assert float(snapshot.hypers.gae_lambda) == np.float32(0.95)
    sauna.resume(run, quiet=True)  # in this process, under the other presets
    assert (run / "metrics.jsonl").read_bytes() == expected


@pytest.mark.parametrize("change", [{"devices": 2}, {"distributed": "h:1,2,0"}])
def test_what_only_the_device_reads_is_refused_on_the_host(change: dict, run) -> None:
    make_incomplete(run, 2)
    with pytest.raises(BadInput, match="only read with backend device"):
        sauna.resume(run, quiet=True, **change)


def test_what_a_worker_finds_unusable_is_bad_input_and_leaves_nothing(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")

    def refuse(*given) -> None:
        raise BadInput("devices: 4 asked for, 1 are there")

    monkeypatch.setattr("sauna.training.worker.train_members", refuse)
    with pytest.raises(BadInput, match="4 asked for"):
        sauna.train(lambda: Scripted(), out=tmp_path / "a" / "run", quiet=True, **SMALL)
    assert not (tmp_path / "a" / "run").exists()
    ours = tmp_path / "ours"
    ours.mkdir()
    with pytest.raises(BadInput, match="4 asked for"):
        sauna.train(lambda: Scripted(), out=ours, quiet=True, **SMALL)
    assert list(ours.iterdir()) == []  # what the user made stays


def test_a_run_with_a_lambda_is_resumed_by_passing_it_again(tmp_path, capsys) -> None:
    run = tmp_path / "run"
    more = {"arm": "sauna", "checkpoint_every": 2, "keep_checkpoints": 9}
    sauna.train(lambda: Scripted(), out=run, **more, **SMALL)
    assert "can be resumed only from Python" in capsys.readouterr().out
    expected = (run / "metrics.jsonl").read_bytes()
    make_incomplete(run, 2)
    stored = run_directory.read_config(run)["config"]["env"]
    delattr(sauna.config.local, stored.partition(":")[2])
    with pytest.raises(BadInput, match="env: was passed by value; pass it again"):
        sauna.resume(run)
    sauna.resume(run, env=lambda: Scripted())
    assert (run / "metrics.jsonl").read_bytes() == expected
    assert sauna.load(run)(np.zeros(3)).shape == (2,)


def test_a_checkpoint_of_another_run_or_environment_is_refused(run) -> None:
    make_incomplete(run, 2)
    path = run / "config.json"
    stored = json.loads(path.read_text())
    stored["config"]["gamma"] = 0.5
    path.write_text(json.dumps(stored))
    with pytest.raises(BadInput, match=r"gamma is 0.99, not 0.5"):
        sauna.resume(run, quiet=True)
    stored["config"]["gamma"] = 0.99
    stored["config"]["env"] = "small_envs:Endless"
    path.write_text(json.dumps(stored))
    with pytest.raises(BadInput, match=r"names code .* env 'small_envs:Endless'"):
        sauna.resume(run, quiet=True)
    with pytest.raises(BadInput, match="other spaces"):
        sauna.resume(run, quiet=True, trust=True)


def test_where_rows_were_lost_an_older_checkpoint_is_used(run, capsys) -> None:
    """And the newer one, which counts on rows that are now written anew, is written anew, too."""
    expected = (run / "metrics.jsonl").read_bytes()
    (run / "summary.json").unlink()
    first = checkpoint.load_newest(run / "checkpoints", print)
    assert first is not None
    os.truncate(run / "metrics.jsonl", first.manifest["logs"]["metrics.jsonl"] - 1)
    sauna.resume(run)
    assert "rows are lost; using an older checkpoint" in capsys.readouterr().out
    assert (run / "metrics.jsonl").read_bytes() == expected
    again = checkpoint.load_newest(run / "checkpoints", print)
    assert again is not None and again.manifest["iteration"] == first.manifest["iteration"]
    assert again.manifest["logs"]["timing.jsonl"] == (run / "timing.jsonl").stat().st_size


def test_where_too_many_rows_were_lost_it_is_said(run) -> None:
    make_incomplete(run, 2)
    os.truncate(run / "metrics.jsonl", 10)
    with pytest.raises(checkpoint.BadCheckpoint, match="rows are lost"):
        sauna.resume(run, quiet=True)


def test_new_folders_are_flushed_into_those_that_were_there(tmp_path, monkeypatch) -> None:
    """Else a power cut could take a run with all of its checkpoints."""
    flushed: list[Path] = []
    monkeypatch.setattr(run_directory, "sync_folder", flushed.append)
    run_directory.create(tmp_path / "runs" / "first")
    assert flushed == [tmp_path / "runs", tmp_path]


def test_rows_end_where_a_power_cut_has_spoilt_them_and_a_complete_run_says_so(tmp_path) -> None:
    log = tmp_path / "timing.jsonl"
    log.write_bytes(b'{"a": 1}\n\0\0\0"b": 2}\n{"c": 3}\n{"d"')
    assert run_directory.rows(tmp_path, "timing.jsonl") == [{"a": 1}]
    run_directory.write_json(tmp_path / "summary.json", {"complete": True})
    with pytest.raises(SaunaError, match=r"timing\.jsonl: line 2 is damaged"):
        run_directory.rows(tmp_path, "timing.jsonl")
