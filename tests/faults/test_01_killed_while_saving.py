"""Row 1: cut off any_member in a save or a prune, the old checkpoint or the new one is there."""

from __future__ import annotations

import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np

from faults.disk import Disk, Op, Tree, make_tree, tree_of, watched
from faults.result import Result, Tally, assert_held
from sauna.system import checkpoint

Scenario = Callable[[Path], tuple[int, int | None]]  # (kept checkpoints, the newest good one)
NEW = 9
MOST = 166  # states after a power cut at one point


def arrays(iteration: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(iteration)
    return {"params": rng.normal(size=7).astype(np.float32), "count": np.asarray(iteration)}


def save(folder: Path, iteration: int, keep: int) -> None:
    checkpoint.save_checkpoint(folder, iteration, arrays(iteration), {"logs": {"m": 1}}, keep)


def first_one(folder: Path) -> tuple[int, int | None]:
    return 2, None


def one_to_prune(folder: Path) -> tuple[int, int | None]:
    save(folder, 5, 2)
    save(folder, 7, 2)
    return 2, 7


def only_the_newest_is_kept(folder: Path) -> tuple[int, int | None]:
    save(folder, 7, 1)
    return 1, 7


def several_to_prune(folder: Path) -> tuple[int, int | None]:
    for iteration in (3, 5, 7):
        save(folder, iteration, 3)
    return 1, 7


def left_over_from_a_kill(folder: Path) -> tuple[int, int | None]:
    save(folder, 7, 2)
    (folder / ".writing-00000008").mkdir()
    (folder / ".writing-00000008" / "state.safetensors").write_bytes(b"half")
    return 2, 7


def over_a_bad_one(folder: Path) -> tuple[int, int | None]:
    save(folder, 7, 2)
    save(folder, NEW, 2)
    (folder / f"{NEW:08d}" / "state.safetensors").write_bytes(b"rotten")
    return 2, 7


SCENARIOS: list[Scenario] = [
    first_one,
    one_to_prune,
    only_the_newest_is_kept,
    several_to_prune,
    left_over_from_a_kill,
    over_a_bad_one,
]


def recorded(scenario: Scenario, run: Path) -> tuple[Tree, list[Op], int | None]:
    """What was on disk before, every operation of the save, and the newest good checkpoint."""
    run.mkdir()
    keep, old = scenario(run / "checkpoints")
    before, ops = tree_of(run), list[Op]()
    with watched(run, ops.append):
        save(run / "checkpoints", NEW, keep)
    disk = Disk(before)
    for op in ops:
        disk.apply(op)
    assert disk.now() == tree_of(run), "an operation was not seen"
    return before, ops, old


def states(before: Tree, ops: list[Op], rng: random.Random, most: int) -> Iterator[tuple]:
    """`(how much was done, whether the new one must be there, what is on disk)`."""
    published = max(i for i, op in enumerate(ops) if op.kind == "rename")
    durable = next(i for i, op in enumerate(ops) if i > published and op.kind == "fsync")
    disk = Disk(before)
    for done in range(len(ops) + 1):
        yield done, done > published, disk.now()
        for tree in disk.after_power_cut(rng, most):
            yield done, done > durable, tree
        if done < len(ops):
            if ops[done].kind == "write":
                for part in range(1, 8):
                    cut = Disk(disk.now())
                    cut.apply(ops[done]._replace(data=ops[done].data[: _share(ops[done], part)]))
                    yield done, False, cut.now()
            disk.apply(ops[done])


def _share(op: Op, eighths: int) -> int:
    return len(op.data) * eighths // 8


def experiment(least: int, seed: int, place: Path) -> Result:
    """At least `least` states over all scenarios. `worst`: seconds of the slowest load."""
    rng, tally = random.Random(seed), Tally()
    with patch("os.fsync", lambda descriptor: None):
        found = []
        for scenario in SCENARIOS:
            before, ops, old = recorded(scenario, place / scenario.__name__)
            name = scenario.__name__
            for done, must_be_new, tree in states(before, ops, rng, MOST):
                found.append((name, f"{done} of {len(ops)} operations", tree, old, must_be_new))
        chosen = found if least >= 2000 else rng.sample(found, least)
        for name, done, tree, old, must_be_new in chosen:
            tally.count(f"states of {name}")
            _judge(tree, old, must_be_new, place / "state", tally, f"{name}, {done}")
    return tally.result()


def _judge(
    tree: Tree, old: int | None, must_be_new: bool, run: Path, tally: Tally, what: str
) -> None:
    shutil.rmtree(run, ignore_errors=True)
    make_tree(tree, run)
    tally.tried += 1
    clock = time.perf_counter()
    try:
        found = checkpoint.load_newest(run / "checkpoints", lambda text: None)
    except checkpoint.BadCheckpoint as error:
        tally.lose(f"{what}: {error}")
        return
    tally.took(time.perf_counter() - clock)
    iteration = found.manifest["iteration"] if found else None
    if iteration not in ((NEW,) if must_be_new else (old, NEW)):
        tally.lose(f"{what}: {iteration} was loaded")
    elif found and iteration is not None:
        expected = arrays(iteration)
        if any(not np.array_equal(found.arrays[name], expected[name]) for name in expected):
            tally.miss(f"{what}: other numbers than were saved")
    if tally.tried % 7 == 0:
        save(run / "checkpoints", NEW + 1, 2)
        later = checkpoint.load_newest(run / "checkpoints", lambda text: None)
        if later is None or later.manifest["iteration"] != NEW + 1:
            tally.lose(f"{what}: what was saved next cannot be loaded")


def test_every_prefix_of_a_save_and_a_prune_can_be_loaded(tmp_path: Path) -> None:
    assert_held(experiment(200, 0, tmp_path), 200)


def test_the_harness_notices_a_save_that_does_not_flush(tmp_path: Path) -> None:
    """The negative control: without the flush of the files a power cut may lose them."""
    ops = recorded(only_the_newest_is_kept, tmp_path / "run")
    careless = [op for op in ops[1] if op.kind != "fsync"]
    tally, disk = Tally(), Disk(ops[0])
    for op in careless:
        disk.apply(op)
    for tree in disk.after_power_cut(random.Random(0), 50):
        _judge(tree, 7, False, tmp_path / "state", tally, "careless")
    assert tally.lost > 0
