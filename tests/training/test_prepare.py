"""From what a user gives to what is trained: resolved, placed and settled, once."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from sauna.config.presets import resolve_run
from sauna.envs.probe import Probe
from sauna.system.errors import BadInput, SaunaError
from sauna.training.prepare import examine, place, prepare
from sauna.training.run import disk_errors, resume_command
from sauna.training.worker import read_job, write_job

ENV = "small_envs:Scripted"


def test_all_arms_have_what_the_environment_and_the_machine_decided() -> None:
    prepared = prepare({"env": "small_envs:Picture", "arm": "ppo,sauna", "seeds": "4,9"})
    assert [member.name for member in prepared.members] == ["ppo/4", "ppo/9", "sauna/4", "sauna/9"]
    for config in (prepared.config, *(member.config for member in prepared.members)):
        assert (config.network, config.normalize_observations) == ("nature-cnn", False)
        assert 1 <= config.processes <= 4
    ppo, sauna = prepared.run.arms["ppo"], prepared.run.arms["sauna"]
    assert (ppo.threshold, ppo.vex_coef, ppo.filter) == (0.0, 0.0, "sauna")
    assert (sauna.threshold, sauna.vex_coef) == (0.3, 0.5)


def test_a_worker_gets_the_members_that_the_run_has() -> None:
    prepared = prepare({"env": ENV, "arm": "ppo,vex-head", "seeds": 2, "vex_coef": 0.7})
    header = write_job(prepared.run, prepared.spaces, [1, 2], 3, True, False)
    job = read_job(header, {})
    assert job == prepared.job([1, 2], start=3)
    assert [member.config.vex_coef for member in job.members] == [0.0, 0.7]


def test_what_is_known_of_an_environment_is_not_asked_again(monkeypatch) -> None:
    spaces = prepare({"env": ENV}).spaces
    monkeypatch.setattr("sauna.training.prepare.look_at", None)
    overrides = {"env": ENV, "arm": "ppo", "log_std_init": 0.5}
    found = Probe(spaces, "reward")
    assert examine(place(resolve_run(overrides)), overrides, found).differs == "reward"
    discrete = Probe(spaces._replace(action_kind="discrete"), None)
    with pytest.raises(BadInput, match=r"log_std_init: not read by .* continuous actions"):
        examine(place(resolve_run(overrides)), overrides, discrete)


def test_a_run_with_an_odd_name_can_be_continued_by_what_is_said(tmp_path: Path) -> None:
    run = tmp_path / "it's; $(a) run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    assert shlex.split(resume_command(run)) == ["sauna", "resume", str(run)]
    with pytest.raises(SaunaError) as failed, disk_errors(run):
        raise OSError(28, "No space left on device")
    assert str(failed.value).endswith(f"continue with: {resume_command(run)}")
