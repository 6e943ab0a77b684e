"""Row 10: disk full, read-only or broken at any write: said clearly, nothing lost or pruned."""

from __future__ import annotations

import errno
import os
import random
import shutil
import time
from pathlib import Path

import pytest

from faults.canned import BACKENDS, Ended, Trap, go, played_back, record, until
from faults.disk import Op, tree_of, watched
from faults.make_golden import GOLDEN
from faults.result import Result, Tally, assert_held
from sauna import cli
from sauna.system import checkpoint
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
    world = BACKENDS[backend]
    with played_back(record(world)):
        whole = Trap()
        until(place / backend, whole, world)
        expected = Ended(place / backend)
        tally.count(f"file operations of a run on the {backend}", len(whole.ops))
        cases = [(at, number) for at in range(len(whole.ops)) for number in ERRORS]
        if least < len(whole.ops):
            cases = rng.sample(cases, least)
        for at, number in cases:
            _fail(place / "run", world, at, number, expected, tally)


def _fail(run: Path, world: str, at: int, number: int, expected: Ended, tally: Tally) -> None:
    shutil.rmtree(run, ignore_errors=True)
    trap = Trap(at, OSError(number, os.strerror(number), "the disk"))
    clock = time.monotonic()
    error = until(run, trap, world)
    tally.took(time.monotonic() - clock)
    tally.tried += 1
    op = trap.ops[at] if at < len(trap.ops) else None
    what = f"{errno.errorcode[number]} at operation {at} ({op.kind} {op.path})" if op else "none"
    tally.count(errno.errorcode[number])
    if not isinstance(error, SaunaError) or os.strerror(number) not in str(error):
        tally.miss(f"{what}: ended with {error!r}")
    elif isinstance(error, BadInput) and (run / "config.json").exists():
        tally.lose(f"{what}: reported as bad input: {error}")
    _check_kept(run, trap, what, tally)
    try:
        go(run, world)  # there is space again
    except SaunaError as again:
        tally.lose(f"{what}: cannot go on: {again}")
        return
    if expected.differs(run):
        tally.miss(f"{what}: {expected.differs(run)}")


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
