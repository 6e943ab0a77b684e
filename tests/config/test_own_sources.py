"""A number of an edited rule is not taken for one of the package's own."""

from __future__ import annotations

import ast
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from sauna.config import own_sources, rule_sources
from sauna.config.code import changed_code, code_of
from sauna.config.own_sources import KEY, edited_sources, newer_sources, sources_of
from sauna.config.presets import resolve_run
from sauna.config.stored import to_stored
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
        with pytest.raises(
            BadInput, match=r"top-advantage.*sources differ, aaa\+changes -> .*rm -r"
        ):
            check_same_code(units, tmp_path, False, said.append)
        return
    check_same_code(units, tmp_path, True, said.append)
    check_same_code(units, tmp_path, False, said.append)  # they count as today's now
    monkeypatch.setattr("sauna.config.code.own_sources", lambda: "zzz 9")
    check_same_code(units, tmp_path, False, said.append)
    assert len(said) == 1 and "reused: 2 runs" in said[0]


def test_a_committed_edit_of_a_rule_is_refused_by_the_runs_of_that_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rules = tmp_path / "selection"
    shutil.copytree(rule_sources.FOLDER, rules)
    monkeypatch.setattr(rule_sources, "FOLDER", rules)
    monkeypatch.setattr("sauna.config.code.own_sources", lambda: "aaa 1")
    arms = ("ppo", "top-advantage", "top-advantage+random", "prioritized", "sauna+avec")
    units = {
        unit.label: unit for unit in units_of(comparison("Hopper-v5", arms, {"seeds": (0,)}), 3)
    }
    before = {arm: code_of(unit.settings) for arm, unit in units.items()}
    assert not [name for name in before["ppo"] if name.startswith(rule_sources.PREFIX)]
    for unit in units.values():
        run = unit.run(tmp_path)
        run.mkdir(parents=True)
        stored = {"config": {}, "spaces": [], "code": code_of(unit.settings)}
        (run / "config.json").write_text(json.dumps(stored))

    monkeypatch.setattr("sauna.config.code.own_sources", lambda: "bbb 2")  # committed
    said: list[str] = []
    check_same_code([*units.values()], tmp_path, False, said.append)
    assert len(said) == 1 and "reused: 5 runs of sauna aaa" in said[0]
    file = rules / "top_advantage.py"
    file.write_text("# a comment\n" + file.read_text().replace("Keeps the", "Holds the"))
    check_same_code([*units.values()], tmp_path, False, said.append)
    file.write_text(file.read_text() + "\nSHARE = 0.1\n")
    with pytest.raises(BadInput, match="source of the rule top-advantage differs"):
        check_same_code([*units.values()], tmp_path, False, said.append)
    changed = [
        arm for arm, unit in units.items() if changed_code(before[arm], code_of(unit.settings))
    ]
    assert changed == ["top-advantage", "top-advantage+random"]
    shared = rules / "scores.py"  # which prioritized imports, too
    shared.write_text(shared.read_text() + "\nSHARE = 0.1\n")
    changed = [
        arm for arm, unit in units.items() if changed_code(before[arm], code_of(unit.settings))
    ]
    assert changed == ["top-advantage", "top-advantage+random", "prioritized"]


def test_runs_that_noted_no_rule_are_named_with_what_trains_them_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sauna.config.code.own_sources", lambda: "bbb 2")
    units = units_of(comparison("Hopper-v5", ("ppo", "top-advantage"), {"seeds": (0,)}), 3)
    for unit in units:
        unit.run(tmp_path).mkdir(parents=True)
        stored = {"config": {}, "spaces": [], "code": {KEY: "aaa 1"}}
        (unit.run(tmp_path) / "config.json").write_text(json.dumps(stored))
    said: list[str] = []
    check_same_code(units, tmp_path, False, said.append)
    assert said[1].startswith("warning: 1 reused run did not note")
    assert said[1].endswith(f"rm -r {units[1].run(tmp_path)}")


def test_every_built_in_rule_is_found_in_its_file() -> None:
    from sauna.algorithm.selection import registry

    named = (registry.SAMPLERS, registry.LOSS_WEIGHTS, registry.STOPS)
    functions = (registry.OBJECTIVES, registry.CRITICS, registry.AUXILIARY)
    for name, rule in (pair for rules in (*named, *functions) for pair in rules.items()):
        if rule is not None:
            assert rule.__module__.rpartition(".")[2] == rule_sources.file_of(name)
    for name in ("sauna", "random-drop"):
        assert (rule_sources.FOLDER / f"{rule_sources.file_of(name)}.py").is_file()


def test_a_stored_run_names_the_rules_of_each_of_its_arms() -> None:
    run = resolve_run({"env": "Hopper-v5", "arm": "ppo,sauna"})
    keys = {"sauna rule sauna"}
    assert set(rule_sources.rule_sources(to_stored(run))) == keys
    assert set(rule_sources.rule_sources({"arm": ["ppo", "sauna"]})) == keys


def test_a_source_is_written_alike_by_every_python() -> None:
    """Newer versions give a function's tree a list of type parameters, which is empty here."""
    returned = ["Return", ["value", ["Constant", ["value", "1"]]]]
    function = [["name", "'f'"], ["args", ["arguments"]], ["body", [returned]]]
    assert rule_sources._plain(ast.parse("def f(): return 1")) == [
        "Module",
        ["body", [["FunctionDef", *function]]],
    ]
