"""Rows that changed since they were written are found before anything is built on them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sauna
from helpers import SMALL
from sauna.experiments.study.found_runs import reopen_damaged
from sauna.experiments.study.units import Unit
from sauna.system import checkpoint, run_directory
from sauna.system.errors import SaunaError
from sauna.system.logs import NAMES, Logs, check_logs, cut_logs, damage_of, read_row

ROW = {"member": "ppo/0", "arm": "ppo", "seed": 0, "env_steps": 32, "return_mean": 1.5}


def row(iteration: int, **more: object) -> dict[str, object]:
    return {**ROW, "iteration": iteration, **more}


def written(run: Path, iterations: int) -> dict[str, object]:
    logs = Logs(run)
    for iteration in range(iterations):
        logs.append(NAMES[0], [row(iteration)])
        logs.append(NAMES[1], [{"iteration": iteration, "seconds": 1.0}])
    return {"iteration": iterations, **logs.counted()}


def test_the_digest_is_carried_along(tmp_path: Path) -> None:
    first = written(tmp_path, 3)
    second = Logs(tmp_path)  # of a process that goes on
    assert second.counted() == {name: first[name] for name in ("logs", "log_digests")}
    second.append(NAMES[0], [row(3)])
    check_logs(tmp_path, first)  # rows behind a checkpoint are no matter
    check_logs(tmp_path, {"iteration": 4, **second.counted()})


@pytest.mark.parametrize("digests", [True, False])
@pytest.mark.parametrize(
    "damage, said",
    [
        (
            lambda lines: [lines[0], lines[1][:8] + b"\0" + lines[1][9:], *lines[2:]],
            "line 2 is dam",
        ),
        (lambda lines: [*lines[:2], *lines[3:]], "shorter"),
        (lambda lines: [*lines[:2], *lines[3:], lines[2]], "line 3 is not of iteration 1 or 2"),
        (
            lambda lines: [lines[0], b"[1, 2]\n", *lines[2:], lines[0]],
            "line 2 is damaged: it is no",
        ),
        (lambda lines: [lines[0], b"{}\n", *lines[2:], lines[0]], "member is missing"),
        (lambda lines: [lines[0][:-1] + b" \n", *lines[1:]], "line 5 is not where it was"),
    ],
)
def test_every_kind_of_damage_is_named(tmp_path: Path, damage, said, digests) -> None:
    manifest = written(tmp_path, 5)
    if not digests:
        manifest["log_digests"] = {}
    path = tmp_path / NAMES[0]
    path.write_bytes(b"".join(damage(path.read_bytes().splitlines(True))))
    with pytest.raises(checkpoint.BadCheckpoint, match=said) as caught:
        check_logs(tmp_path, manifest)
    assert str(path) in str(caught.value)


def test_a_changed_digit_is_found_by_the_digest(tmp_path: Path) -> None:
    manifest = written(tmp_path, 3)
    path = tmp_path / NAMES[0]
    path.write_bytes(path.read_bytes().replace(b"1.5", b"9.5", 1))
    with pytest.raises(checkpoint.BadCheckpoint, match="SHA-256 differs"):
        check_logs(tmp_path, manifest)


def test_logs_are_cut_between_lines(tmp_path: Path) -> None:
    manifest = written(tmp_path, 2)
    Logs(tmp_path).append(NAMES[0], [row(2)])
    cut_logs(tmp_path, manifest["logs"])
    assert len(run_directory.rows(tmp_path)) == 2
    check_logs(tmp_path, manifest)


@pytest.mark.parametrize("line", [b"null", b"3", b'{"member": 1}', b"[" * 100_000, b'{"a": "x"}'])
def test_what_is_no_row_is_no_row(line: bytes) -> None:
    with pytest.raises((ValueError, RecursionError)):
        read_row(line, NAMES[0])
    with pytest.raises(ValueError, match="return_mean is no number"):
        read_row(json.dumps(row(0, return_mean="<b>")).encode(), NAMES[0])


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "unit" / "run"
    settings = {**SMALL, "checkpoint_every": 2, "keep_checkpoints": 9, "arm": "ppo"}
    sauna.train("small_envs:Scripted", out=path, quiet=True, **settings)
    return path


def damaged(run: Path, number: int) -> bytes:
    """Changes a digit in a row, which JSON does not notice; the log as it was."""
    path = run / "metrics.jsonl"
    before = path.read_bytes()
    lines = before.splitlines(True)
    place = lines[number].index(b'"env_steps": ') + len(b'"env_steps": ')
    digit = b"1" if lines[number][place : place + 1] != b"1" else b"2"
    lines[number] = lines[number][:place] + digit + lines[number][place + 1 :]
    path.write_bytes(b"".join(lines))
    return before


def test_resume_goes_on_from_before_the_damage_also_of_a_complete_run(run: Path, capsys) -> None:
    before = damaged(run, 3)
    with pytest.raises(SaunaError):
        check_logs(run, checkpoint.read_manifest(checkpoint.numbered(run / "checkpoints")[-1]))
    sauna.resume(run)
    said = capsys.readouterr().out
    assert "SHA-256 differs" in said and "using an older checkpoint" in said
    assert (run / "metrics.jsonl").read_bytes() == before and damage_of(run) is None
    assert run_directory.is_complete(run)


def test_where_no_checkpoint_fits_nothing_is_made_of_the_rest(run: Path) -> None:
    damaged(run, 0)
    summary = (run / "summary.json").read_bytes()
    with pytest.raises(checkpoint.BadCheckpoint, match=r"metrics\.jsonl"):
        sauna.resume(run, quiet=True)
    assert (run / "summary.json").read_bytes() == summary


def test_eval_names_the_damage_and_uses_what_fits(run: Path) -> None:
    said: list[str] = []
    damaged(run, 3)
    found = sauna.evaluate(run, episodes=1, say=said.append)
    assert found["iteration"] == 2 and "SHA-256 differs" in said[0]
    damaged(run, 0)
    found = sauna.evaluate(run, episodes=1, say=said.append)
    assert found["iteration"] == 4 and said[-1].endswith("the newest one is used")


def test_a_study_continues_a_complete_run_whose_rows_are_damaged(run: Path, tmp_path) -> None:
    unit = Unit("unit", "small_envs:Scripted", "ppo", (0,), {})
    said: list[str] = []
    reopen_damaged([unit], tmp_path, said.append)
    assert said == [] and unit.is_complete(tmp_path)
    damaged(run, 3)
    reopen_damaged([unit], tmp_path, said.append)
    assert "metrics.jsonl" in said[0] and not unit.is_complete(tmp_path)
