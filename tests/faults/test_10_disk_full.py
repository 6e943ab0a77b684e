"""Row 10: disk full, read-only or broken at any write: said clearly, nothing lost or pruned.

A write of `metrics.csv`, which follows from the logs, is said and ends no training.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import time
from pathlib import Path
from unittest.mock import patch

import pytest

from faults.canned import BACKENDS, Ended, Trap, go, played_back, record, until
from faults.disk import Op, tree_of, watched
from faults.make_golden import GOLDEN
from faults.result import Result, Tally, assert_held
from sauna import cli
from sauna.system import checkpoint, metrics_csv, run_directory
from sauna.system.errors import BadInput, SaunaError

ERRORS = (errno.ENOSPC, errno.EROFS, errno.EIO)


def experiment(least: int, seed: int, place: Path) -> Result:
    """The operations of a run fail, each with some error; all if there is time, on each backend.

    `worst`: seconds from the failing operation to the end of the command.
    """
    tally = Tally()
    for backend in BACKENDS:
        _fail_everywhere(backend, least, random.Random(seed), place, tally)
    return tally.result()


def _fail_everywhere(
    backend: str, least: int, rng: random.Random, place: Path, tally: Tally
) -> None:
    env = BACKENDS[backend]
    with played_back(record(env)):
        whole = Trap()
        until(place / backend, whole, env)
        expected = Ended(place / backend)
        tally.count(f"file operations of a run on the {backend}", len(whole.ops))
        cases = [(at, number) for at in range(len(whole.ops)) for number in ERRORS]
        if least < len(whole.ops):
            cases = rng.sample(cases, least)
        for at, number in cases:
            _fail(place / "run", env, at, number, expected, tally)


def _fail(run: Path, env: str, at: int, number: int, expected: Ended, tally: Tally) -> None:
    shutil.rmtree(run, ignore_errors=True)
    trap = Trap(at, OSError(number, os.strerror(number), "the disk"))
    clock, said = time.monotonic(), []
    with patch("sauna.api._Silent.say", lambda display, text: said.append(text)):
        error = until(run, trap, env)
    tally.took(time.monotonic() - clock)
    tally.tried += 1
    op = trap.ops[at] if at < len(trap.ops) else None
    what = f"{errno.errorcode[number]} at operation {at} ({op.kind} {op.path})" if op else "none"
    tally.count(errno.errorcode[number])
    told = [text for text in said if os.strerror(number) in text]
    if told or (op is not None and metrics_csv.NAME in op.path):
        _check_table(run, error, told, what, tally)
    elif not isinstance(error, SaunaError) or os.strerror(number) not in str(error):
        tally.miss(f"{what}: ended with {error!r}")
    elif isinstance(error, BadInput) and (run / "config.json").exists():
        tally.lose(f"{what}: reported as bad input: {error}")
    _check_kept(run, trap, what, tally)
    try:
        go(run, env)  # there is space again
    except SaunaError as again:
        tally.lose(f"{what}: cannot go on: {again}")
        return
    if expected.differs(run):
        tally.miss(f"{what}: {expected.differs(run)}")


def _check_table(
    run: Path, error: BaseException | None, said: list[str], what: str, tally: Tally
) -> None:
    """The training went on, one line says why the table had to wait, and it is whole in the end."""
    if len(said) != 1 or metrics_csv.NAME not in said[0]:
        tally.miss(f"{what}: said {said}")
    if error is not None or not run_directory.is_complete(run):
        tally.lose(f"{what}: ended with {error!r}")
        return
    table = (run / metrics_csv.NAME).read_bytes()
    metrics_csv.MetricsCsv(run, said.append)
    if table != (run / metrics_csv.NAME).read_bytes():
        tally.lose(f"{what}: the table is not what the logs say")


def _check_kept(run: Path, trap: Trap, what: str, tally: Tally) -> None:
    """The newest checkpoint that was finished is still there and good."""
    said: list[str] = []
    try:
        found = checkpoint.load_newest(run / "checkpoints", said.append)
    except checkpoint.BadCheckpoint as error:
        tally.lose(f"{what}: {error}")
        return
    newest = max((int(name.rpartition("/")[2]) for name in trap.saved), default=0)
    if said or (found.manifest["iteration"] if found else 0) < newest:
        tally.lose(f"{what}: {said or found} instead of iteration {newest}")


def test_every_failing_write_is_told_and_loses_nothing(tmp_path: Path) -> None:
    tally = Tally()
    _fail_everywhere("host", 30, random.Random(3), tmp_path, tally)
    assert_held(tally.result(), 30)


def test_a_table_that_cannot_be_written_ends_no_training(tmp_path: Path) -> None:
    """Each of its writes, of which the sample above may hold none."""
    tally = Tally()
    env = BACKENDS["host"]
    with played_back(record(env)):
        whole = Trap()
        until(tmp_path / "whole", whole, env)
        expected = Ended(tmp_path / "whole")
        at = [n for n, op in enumerate(whole.ops) if metrics_csv.NAME in op.path]
        at += [n + 1 for n in at if whole.ops[n].kind == "rename"]  # the folder is flushed
        assert {whole.ops[n].path for n in at if metrics_csv.NAME not in whole.ops[n].path} == {"."}
        for n in at:
            _fail(tmp_path / "run", env, n, errno.ENOSPC, expected, tally)
    assert {whole.ops[n].kind for n in at} >= {"create", "write", "fsync", "rename"}
    assert_held(tally.result(), len(at))


def test_an_evaluation_that_cannot_be_written_is_one_line(tmp_path: Path, capsys) -> None:
    """And the run that it evaluates is as it was."""
    number = errno.EROFS
    run = tmp_path / "run"
    shutil.copytree(GOLDEN / "format-1-host", run)
    before = tree_of(run)

    def fail(op: Op) -> None:
        raise OSError(number, os.strerror(number), str(run / op.path))

    with watched(run, fail), pytest.raises(SystemExit) as end:
        cli.main(["eval", str(run), "--episodes", "1", "--trust"])
    errors = capsys.readouterr().err
    assert end.value.code == 1 and errors.count("\n") == 1
    assert errors.startswith("sauna: cannot read or write ") and os.strerror(number) in errors
    assert tree_of(run) == before
