"""Row 14: killed between the log and the checkpoint, no row is there twice, and none is missing."""

from __future__ import annotations

import random
import shutil
import time
from pathlib import Path

from faults.canned import BACKENDS, Ended, Trap, go, played_back, record, until
from faults.disk import Disk, Op, Tree, make_tree
from faults.result import Result, Tally, assert_held
from sauna.system import run_directory
from sauna.system.errors import SaunaError


def experiment(least: int, seed: int, place: Path) -> Result:
    """A run is cut off before each of its file operations: killed there, or without power.

    On each backend. `worst`: seconds of the slowest resume.
    """
    tally = Tally()
    for backend in BACKENDS:
        _cut_off_everywhere(backend, least, random.Random(seed), place, tally)
    return tally.result()


def _cut_off_everywhere(
    backend: str, least: int, rng: random.Random, place: Path, tally: Tally
) -> None:
    env = BACKENDS[backend]
    with played_back(record(env)):
        whole = Trap()
        until(place / backend, whole, env)
        expected = Ended(place / backend)
        count = len(whole.ops)
        points = range(count) if least >= count else sorted(rng.sample(range(count), least // 2))
        tally.count(f"file operations of a run on the {backend}", count)
        for at in points:
            _kill(place / "run", env, at, expected, tally)
        for at, tree in _power_cuts(whole.ops, points, rng):
            shutil.rmtree(place / "run", ignore_errors=True)
            make_tree(tree, place / "run")
            tally.count("power cuts")
            _go_on(place / "run", env, f"power cut before operation {at}", expected, tally)


def _kill(run: Path, env: str, at: int, expected: Ended, tally: Tally) -> None:
    shutil.rmtree(run, ignore_errors=True)
    until(run, Trap(at), env)
    tally.count("kills")
    if run_directory.rows(run) and not (run / "checkpoints").exists():
        tally.count("rows, but no checkpoint yet")
    _go_on(run, env, f"killed before operation {at}", expected, tally)


def _power_cuts(ops: list[Op], points: object, rng: random.Random) -> list[tuple[int, Tree]]:
    """What a power cut may leave of the run at some of these points."""
    disk, found = Disk({}), []
    for at, op in enumerate(ops):
        if at in points:  # type: ignore[operator]
            found += [(at, tree) for tree in disk.after_power_cut(rng, 1)]
        disk.apply(op)
    return found


def _go_on(run: Path, env: str, what: str, expected: Ended, tally: Tally) -> None:
    tally.tried += 1
    clock = time.monotonic()
    try:
        go(run, env)
    except SaunaError as error:
        tally.lose(f"{what}: {error}")
        return
    tally.took(time.monotonic() - clock)
    rows = [(row["member"], row["iteration"]) for row in run_directory.rows(run)]
    if len(set(rows)) != len(rows):
        tally.miss(f"{what}: a row is there twice")
    if expected.differs(run):
        tally.miss(f"{what}: {expected.differs(run)}")


def test_cut_off_anywhere_no_row_is_lost_or_there_twice(tmp_path: Path) -> None:
    tally = Tally()
    _cut_off_everywhere("host", 30, random.Random(4), tmp_path, tally)
    assert_held(tally.result(), 30)
