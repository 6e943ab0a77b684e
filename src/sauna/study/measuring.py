"""The second phase of a study: what is measured of its members at checkpoints along training.

Each measurement is a file of its own under the study's folder, named after the run, the seed and
the checkpoint, so that a study that is run again measures what is missing.
"""

from __future__ import annotations

import json
import queue
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sauna import rundir
from sauna.checkpoint import numbered
from sauna.study.process import Message, UnitProcess
from sauna.study.spec import Spec, check, drops_nothing
from sauna.study.units import Unit, parts

POINTS = (0.05, 0.25, 0.5, 0.75, 1.0)  # shares of the budget that are nearest to a checkpoint


class Item(NamedTuple):
    """One member's measurements."""

    task: str
    label: str
    arm: str
    seed: int
    run: Path
    points: list[float]  # of `POINTS`, those that have a checkpoint of their own
    iterations: list[int]
    files: list[Path]

    @property
    def is_done(self) -> bool:
        return all(file.exists() for file in self.files)


def items_of(spec: Spec, units: list[Unit], folder: Path, place: Path) -> Iterator[Item]:
    """Every complete member that can be measured."""
    assert spec.measure is not None
    for arm in spec.arms:
        for unit in (unit for unit in units if unit.label == arm.label):
            config = check(arm, unit.task)
            if spec.measure == "noise" and drops_nothing(config):
                continue
            for part in parts(unit, folder):
                if not part.is_complete(folder):
                    continue
                for seed in part.seeds:
                    chosen = checkpoints_at(part.run(folder), seed, config.steps)
                    name = f"{part.name.replace('/', '_')}_{seed}"
                    files = [place / spec.measure / f"{name}_{i:08d}.json" for i in chosen.values()]
                    yield Item(unit.task, arm.label, arm.arm, seed, part.run(folder),
                               [*chosen], [*chosen.values()], files)  # fmt: skip


def checkpoints_at(run: Path, seed: int, steps: int) -> dict[float, int]:
    """`{point: iteration}`: the checkpoint of a seed nearest to each point, none of them twice."""
    rows = [row for row in rundir.rows(run) if row["seed"] == seed]
    reached = {
        int(path.name): max(
            (row["env_steps"] for row in rows if row["iteration"] < int(path.name)), default=0
        )
        for path in numbered(run / "checkpoints")
    }
    chosen: dict[float, int] = {}
    for point in POINTS:
        best = min(reached, key=lambda i: (abs(reached[i] - point * steps), i), default=None)
        if best is not None and best not in chosen.values():
            chosen[point] = best
    return chosen


def measure(
    spec: Spec,
    units: list[Unit],
    folder: Path,
    place: Path,
    jobs: int,
    say: Callable[[str], None],
    stopping: Callable[[], bool],
) -> None:
    """Makes what is missing of a study's measurements, `jobs` members at a time.

    A member whose measurement fails is told and left out; running the study again tries it again.
    """
    waiting = [item for item in items_of(spec, units, folder, place) if not item.is_done]
    if not waiting or stopping():
        return
    (place / str(spec.measure)).mkdir(exist_ok=True)
    say(f"measuring {spec.measure}: {len(waiting)} members")
    messages: queue.SimpleQueue[tuple[Item, Message | None]] = queue.SimpleQueue()
    running: dict[Path, UnitProcess] = {}
    try:
        while waiting or running:
            if stopping():
                return
            while waiting and len(running) < jobs:
                item = waiting.pop(0)
                running[item.files[0]] = _start(spec, item, place, messages)
            try:
                item, message = messages.get(timeout=0.2)
            except queue.Empty:
                continue
            if message is not None:
                say(f"{_named(item)}: {message['error']}")
                continue
            how = running.pop(item.files[0]).end()
            say(f"{_named(item)}: {'measured' if item.is_done else how}")
    finally:
        for process in running.values():
            process.stop()
            process.end()


def _named(item: Item) -> str:
    return f"{item.label} on {item.task}, seed {item.seed}"


def _start(
    spec: Spec, item: Item, place: Path, messages: queue.SimpleQueue[tuple[Item, Message | None]]
) -> UnitProcess:
    given = {
        "what": spec.measure,
        "run": str(item.run),
        "member": f"{item.arm}/{item.seed}",
        "iterations": item.iterations,
        "files": [str(file) for file in item.files],
    }
    log = place / str(spec.measure) / "stderr.txt"
    return UnitProcess(
        given, log, lambda message: messages.put((item, message)), module="sauna.measure"
    )


def gather_measured(spec: Spec, units: list[Unit], folder: Path, place: Path) -> dict[str, Any]:
    """What has been measured so far: a cell per task and label, in it members and their points."""
    cells: dict[tuple[str, str], dict[str, Any]] = {}
    for item in sorted(
        items_of(spec, units, folder, place), key=lambda i: spec.tasks.index(i.task)
    ):
        empty = {"task": item.task, "label": item.label, "arm": item.arm, "members": []}
        cell = cells.setdefault((item.task, item.label), empty)
        points = [
            {"point": point, **json.loads(file.read_text())}
            for point, file in zip(item.points, item.files, strict=True)
            if file.exists()
        ]
        cell["members"].append({"seed": item.seed, "points": points})
    steps = {arm.label: check(arm, arm.tasks[0]).steps for arm in spec.arms}
    for cell in cells.values():
        cell["steps"] = steps[cell["label"]]
    return {"name": spec.name, "measure": spec.measure, "cells": list(cells.values())}
