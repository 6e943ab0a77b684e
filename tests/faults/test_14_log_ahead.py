"""Row 14: killed between the log and the checkpoint, no row is there twice, and none is missing."""

from __future__ import annotations

import random
import shutil
import time
from pathlib import Path

from faults.canned import Ended, Trap, go, played_back, record, until
from faults.disk import Disk, Op, Tree, make_tree
from faults.result import Result, Tally, assert_held
from sauna import rundir
from sauna.errors import SaunaError


def experiment(least: int, seed: int, place: Path) -> Result:
    """A run is cut off before each of its file operations: killed there, or without power.

    `worst`: seconds of the slowest resume.
    """
    rng, tally = random.Random(seed), Tally()
    with played_back(record()):
        whole = Trap()
        until(place / "whole", whole)
        expected = Ended(place / "whole")
        count = len(whole.ops)
        points = range(count) if least >= count else sorted(rng.sample(range(count), least // 2))
        tally.notes["file operations of a run"] = count
        for at in points:
            _kill(place / "run", at, expected, tally)
        for at, tree in _power_cuts(whole.ops, points, rng):
            shutil.rmtree(place / "run", ignore_errors=True)
            make_tree(tree, place / "run")
            tally.count("power cuts")
            _go_on(place / "run", f"power cut before operation {at}", expected, tally)
    return tally.result()


def _kill(run: Path, at: int, expected: Ended, tally: Tally) -> None:
    shutil.rmtree(run, ignore_errors=True)
    until(run, Trap(at))
    tally.count("kills")
    if rundir.rows(run) and not (run / "checkpoints").exists():
        tally.count("rows, but no checkpoint yet")
    _go_on(run, f"killed before operation {at}", expected, tally)


def _power_cuts(ops: list[Op], points: object, rng: random.Random) -> list[tuple[int, Tree]]:
    """What a power cut may leave of the run at some of these points."""
    disk, found = Disk({}), []
    for at, op in enumerate(ops):
        if at in points:  # type: ignore[operator]
            found += [(at, tree) for tree in disk.after_power_cut(rng, 1)]
        disk.apply(op)
    return found


def _go_on(run: Path, what: str, expected: Ended, tally: Tally) -> None:
    tally.tried += 1
    clock = time.monotonic()
    try:
        go(run)
    except SaunaError as error:
        tally.lose(f"{what}: {error}")
        return
    tally.took(time.monotonic() - clock)
    rows = [(row["member"], row["iteration"]) for row in rundir.rows(run)]
    if len(set(rows)) != len(rows):
        tally.miss(f"{what}: a row is there twice")
    if expected.differs(run):
        tally.miss(f"{what}: {expected.differs(run)}")


def test_cut_off_anywhere_no_row_is_lost_or_there_twice(tmp_path: Path) -> None:
    assert_held(experiment(30, 4, tmp_path), 30)
