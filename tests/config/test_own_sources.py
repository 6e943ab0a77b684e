"""A number of an edited rule is not taken for one of the package's own."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from sauna.config import own_sources
from sauna.config.code import changed_code, code_of
from sauna.config.own_sources import KEY, edited_sources, newer_sources, sources_of
from sauna.experiments.study.command import comparison
from sauna.experiments.study.found_runs import check_same_code
from sauna.experiments.study.units import units_of
from sauna.system.errors import BadInput

OLD, NEW, EDITED = {KEY: "aaa 1"}, {KEY: "bbb 2"}, {KEY: "aaa+changes 3"}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A checkout with a rule, committed."""
    folder = tmp_path / "src" / "sauna"
    for name in own_sources.COMPUTING:
        (folder / name).mkdir(parents=True)
    (folder / "config").mkdir()
    for name in ("__init__.py", "config/hints.py", *own_sources.DEFAULTS):
        (folder / name).write_text("")
    (folder / "cli.py").write_text("")
    (folder / "algorithm" / "rule.py").write_text("SHARE = 0.5\n")
    _git(tmp_path, "init", "-q")
    _commit(tmp_path)
    return folder


def _git(folder: Path, *arguments: str) -> None:
    who = ["-c", "user.name=x", "-c", "user.email=x@y.z"]
    subprocess.run(["git", "-C", str(folder), *who, *arguments], check=True, capture_output=True)


def _commit(folder: Path) -> None:
    _git(folder, "add", "-A")
    _git(folder, "commit", "-qm", "x")


def test_an_edit_of_a_rule_and_its_undoing_are_told(package: Path) -> None:
    clean = {KEY: sources_of(package)}
    (package / "algorithm" / "rule.py").write_text("SHARE = 0.25\n")
    edited = {KEY: sources_of(package)}
    assert "+changes" in edited[KEY] and "+changes" not in clean[KEY]
    assert edited_sources(clean, edited) and edited_sources(edited, clean)
    _git(package, "checkout", "--", ".")
    assert {KEY: sources_of(package)} == clean
    (package / "cli.py").write_text("# computes nothing\n")
    assert {KEY: sources_of(package)} == clean
    (package / "algorithm" / "new.py").write_text("")  # not yet added
    assert edited_sources(clean, {KEY: sources_of(package)})


@pytest.mark.parametrize("name", own_sources.DEFAULTS)
def test_an_edited_default_is_told_as_no_name_of_a_run_holds_it(package: Path, name: str) -> None:
    assert (own_sources.PACKAGE / name).is_file()
    clean = {KEY: sources_of(package)}
    (package / "config" / "hints.py").write_text("# decides no number\n")
    assert {KEY: sources_of(package)} == clean
    (package / name).write_text("gae_lambda = 0.9\n")
    assert edited_sources(clean, {KEY: sources_of(package)})


def test_a_commit_is_named_and_not_refused(package: Path) -> None:
    before = {KEY: sources_of(package)}
    (package / "algorithm" / "rule.py").write_text("SHARE = 0.25\n")
    _commit(package.parents[1])
    after = {KEY: sources_of(package)}
    assert not edited_sources(before, after) and newer_sources(before, after)


def test_outside_of_git_the_version_counts(package: Path, monkeypatch) -> None:
    (package.parents[1] / ".git").rename(package.parents[1] / "no-git")
    monkeypatch.setattr(own_sources, "_version", lambda: "1.0")
    before = {KEY: sources_of(package)}
    assert before[KEY].startswith("1.0 ")
    (package / "algorithm" / "rule.py").write_text("SHARE = 0.25\n")
    assert edited_sources(before, {KEY: sources_of(package)})
    monkeypatch.setattr(own_sources, "_version", lambda: "1.1")
    assert not edited_sources(before, {KEY: sources_of(package)})
    assert newer_sources(before, {KEY: sources_of(package)})


@pytest.mark.parametrize(
    ("before", "now", "refused", "named"),
    [
        (OLD, OLD, False, False),
        (OLD, NEW, False, True),
        (OLD, EDITED, True, False),
        (EDITED, OLD, True, False),
        ({}, NEW, False, False),  # stored before there was an entry
        (EDITED, {KEY: "ccc 3"}, False, False),  # the edit was committed
    ],
)
def test_what_is_refused_and_what_is_named(before, now, refused: bool, named: bool) -> None:
    assert bool(changed_code(before, now)) == refused
    assert bool(newer_sources(before, now)) == named


@pytest.mark.parametrize("accept", [False, True])
def test_a_comparison_reuses_no_run_of_an_edited_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, accept: bool
) -> None:
    monkeypatch.setattr("sauna.config.code.own_sources", lambda: "aaa 1")
    units = units_of(comparison("Hopper-v5", ("ppo", "top-advantage"), {"seeds": (0,)}), 3)
    today = code_of(units[0].settings)[KEY]
    for unit, sources in zip(units, (today, "aaa+changes 3"), strict=True):
        run = unit.run(tmp_path)
        run.mkdir(parents=True)
        stored = {"config": {}, "spaces": [], "code": {KEY: sources}}
        (run / "config.json").write_text(json.dumps(stored))
    said: list[str] = []
    if not accept:
        with pytest.raises(BadInput, match=r"top-advantage.*sources, aaa\+changes -> .*edited"):
            check_same_code(units, tmp_path, False, said.append)
        return
    check_same_code(units, tmp_path, True, said.append)
    check_same_code(units, tmp_path, False, said.append)  # they count as today's now
    monkeypatch.setattr("sauna.config.code.own_sources", lambda: "zzz 9")
    check_same_code(units, tmp_path, False, said.append)
    assert len(said) == 1 and "reused: 2 runs" in said[0]
