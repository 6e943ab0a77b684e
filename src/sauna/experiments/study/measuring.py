"""The second phase of a study: what is measured of its members at checkpoints along training.

Each measurement is a file of its own under the study's folder, named after the run, the seed, the
checkpoint and what the checkpoint holds: a study that is run again measures what is missing, and
what was trained again is measured again.
"""

from __future__ import annotations

import hashlib
import json
import queue
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sauna.config.stored import read_stored
from sauna.experiments.curves import area_under_curve
from sauna.experiments.measure.measurement import Measurement
from sauna.experiments.study.execute.process import Message, UnitProcess
from sauna.experiments.study.spec import Spec, check
from sauna.experiments.study.units import Unit, parts
from sauna.system import run_directory
from sauna.system.checkpoint import numbered
from sauna.system.safe_write import own_folder

SETTINGS = ("threshold", "threshold_schedule", "keep_rate_target")  # that a cell is known by


class Item(NamedTuple):
    """One member's measurements."""

    task: str
    label: str
    arm: str  # as the members of its run are called
    seed: int
    run: Path
    points: list[float]  # of the measurement's points, those that have a checkpoint of their own
    iterations: list[int]
    files: list[Path]

    @property
    def is_done(self) -> bool:
        return all(file.exists() for file in self.files)


def items_of(spec: Spec, units: list[Unit], folder: Path, place: Path) -> list[Item]:
    """Returns every complete member that can be measured.

    What is measured in a scale belongs to the scale's checkpoint as well.
    """
    items = list(_items(spec, units, folder, place))
    if not _measurement(spec).scaled:
        return items
    scales = {task: scale_of(spec, items, task) for task in spec.tasks}
    marks = {
        task: _mark(Path(scale["run"]), scale["iteration"]) if scale else "unscaled"
        for task, scale in scales.items()
    }
    return [
        item._replace(
            files=[file.with_name(f"{file.stem}_{marks[item.task]}.json") for file in item.files]
        )
        for item in items
    ]


def _items(spec: Spec, units: list[Unit], folder: Path, place: Path) -> Iterator[Item]:
    measurement = _measurement(spec)
    for arm in spec.arms:
        for unit in (unit for unit in units if unit.label == arm.label):
            config = check(arm, unit.task)
            if not measurement.applies(config):
                continue
            for part in parts(unit, folder):
                if not part.is_complete(folder):
                    continue
                run = part.run(folder)
                called = read_stored(run_directory.read_config(run)).labels[arm.arm]
                for seed in part.seeds:
                    chosen = checkpoints_at(run, seed, config.steps, measurement.points)
                    name = f"{part.name.replace('/', '_')}_{seed}"
                    files = [
                        measurement.folder(place) / f"{name}_{i:08d}_{_mark(run, i)}.json"
                        for i in chosen.values()
                    ]
                    yield Item(
                        unit.task,
                        arm.label,
                        called,
                        seed,
                        run,
                        [*chosen],
                        [*chosen.values()],
                        files,
                    )


def _mark(run: Path, iteration: int) -> str:
    """Eight digits that differ between checkpoints of the same number."""
    manifest = run / "checkpoints" / f"{iteration:08d}" / "manifest.json"
    return hashlib.sha256(manifest.read_bytes() if manifest.exists() else b"").hexdigest()[:8]


def checkpoints_at(run: Path, seed: int, steps: int, points: tuple[float, ...]) -> dict[float, int]:
    """Returns `{point: iteration}`: the checkpoint of a seed nearest to each point, none of them
    twice."""
    rows = [row for row in run_directory.rows(run) if row["seed"] == seed]
    reached = {
        int(path.name): max(
            (row["env_steps"] for row in rows if row["iteration"] < int(path.name)), default=0
        )
        for path in numbered(run / "checkpoints")
    }
    chosen: dict[float, int] = {}
    for point in points:
        best = min(reached, key=lambda i: (abs(reached[i] - point * steps), i), default=None)
        if best is not None and best not in chosen.values():
            chosen[point] = best
    return chosen


def scale_of(spec: Spec, items: list[Item], task: str) -> dict[str, Any] | None:
    """Returns whose normaliser scales the observations of all arms: the baseline's first seed at
    its end.

    None while that is not trained. It is never another seed, so that all measurements, early and
    late ones, have one scale.
    """
    first = next(arm.seeds[0] for arm in spec.arms if arm.label == spec.baseline)
    for item in items:
        if (item.task, item.label, item.seed) == (task, spec.baseline, first) and item.iterations:
            last = max(item.iterations)
            return {"run": str(item.run), "member": f"{item.arm}/{item.seed}", "iteration": last}
    return None


def measure(
    spec: Spec,
    units: list[Unit],
    folder: Path,
    place: Path,
    jobs: int,
    say: Callable[[str], None],
    stopping: Callable[[], bool],
) -> None:
    """Makes what is missing of a study's measurements, `jobs` members at a time on this machine.

    A member whose measurement fails is reported and left out; the study, run again, tries it again.
    """
    measurement = _measurement(spec)
    items = items_of(spec, units, folder, place)
    scales = {}
    if measurement.scaled:
        scales = {task: scale_of(spec, items, task) for task in spec.tasks}
        for task in (task for task, scale in scales.items() if scale is None):
            say(
                f"{task} is not measured: the first seed of {spec.baseline}, whose normaliser is "
                f"the scale of all, is not trained"
            )
        items = [item for item in items if scales[item.task]]
    waiting = [item for item in items if not item.is_done]
    if not waiting or stopping():
        return
    own_folder(measurement.folder(place))
    say(f"measuring {measurement.name}: {len(waiting)} members")
    messages: queue.SimpleQueue[tuple[Item, Message | None]] = queue.SimpleQueue()
    running: dict[Path, UnitProcess] = {}
    try:
        while waiting or running:
            if stopping():
                return
            while waiting and len(running) < jobs:
                item = waiting.pop(0)
                running[item.files[0]] = _start(
                    measurement, item, scales.get(item.task), place, messages
                )
            try:
                item, message = messages.get(timeout=0.2)
            except queue.Empty:
                continue
            if message is not None:
                if "error" in message:
                    say(f"{_named(item)}: {message['error']}")
                continue
            how = running.pop(item.files[0]).end()
            log = measurement.folder(place) / "stderr.txt"
            say(f"{_named(item)}: {'measured' if item.is_done else f'{how}; see {log}'}")
    finally:
        for process in running.values():
            process.stop()
            process.end()


def _named(item: Item) -> str:
    return f"{item.label} on {item.task}, seed {item.seed}"


def _start(
    measurement: Measurement,
    item: Item,
    scale: dict[str, Any] | None,
    place: Path,
    messages: queue.SimpleQueue[tuple[Item, Message | None]],
) -> UnitProcess:
    given = {
        "compute": measurement.compute,
        "run": str(item.run),
        "member": f"{item.arm}/{item.seed}",
        "iterations": item.iterations,
        "files": [str(file) for file in item.files],
        "scale": scale,
    }
    log = measurement.folder(place) / "stderr.txt"
    return UnitProcess(
        given,
        log,
        lambda message: messages.put((item, message)),
        module="sauna.experiments.measure",
    )


def gather_measured(
    spec: Spec, units: list[Unit], folder: Path, place: Path, results: Mapping[str, Any]
) -> dict[str, Any]:
    """Returns what has been measured so far, beside the numbers of `results` that it is compared
    with.

    Every cell of `results` that can be measured is there, and of each complete member its
    `points`: none of a member whose later checkpoints are still to be measured, since early ones
    alone would pass for all.
    """
    measurement = _measurement(spec)
    points: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for item in items_of(spec, units, folder, place):
        points[item.task, item.label, item.seed] = [
            {"point": point, **json.loads(file.read_text())}
            for point, file in zip(item.points, item.files, strict=True)
            if item.is_done
        ]
    arms = {arm.label: arm for arm in spec.arms}
    cells = []
    for cell in results["cells"]:
        key, config = (cell["task"], cell["label"]), cell["config"]
        members = [
            {
                "seed": member["seed"],
                **{name: member[name] for name in ("keep_rate", "final_return", "env_steps")},
                "entropy": mean_over_training(member["curve"], "entropy"),
                "threshold": usual(member["curve"], "threshold"),
                "points": points[*key, member["seed"]],
                **_curves(member["curve"], measurement.curves),
            }
            for member in cell["members"]
            if (*key, member["seed"]) in points
        ]
        if measurement.applies(check(arms[key[1]], key[0])):
            settings = {name: config[name] for name in SETTINGS}
            cells.append(
                {
                    "task": key[0],
                    "label": key[1],
                    "arm": cell["arm"],
                    "steps": config["steps"],
                    "baseline": arms[key[1]].baseline,
                    "seeds": len(arms[key[1]].seeds),
                    "config": settings,
                    "members": members,
                }
            )
    return {
        "name": spec.name,
        "command": results["command"],
        "measure": spec.measure,
        "cells": cells,
        **{name: results[name] for name in ("versions", "machine", "git")},
    }


def _measurement(spec: Spec) -> Measurement:
    assert spec.measurement is not None
    return spec.measurement


def _curves(curve: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """The named curves of a member of `results`, as an entry; none if no name is given."""
    return {"curve": {name: curve[name] for name in ("env_steps", *names)}} if names else {}


def mean_over_training(curve: Mapping[str, Any], name: str) -> float | None:
    """Returns a curve's mean over env steps; None where it has no values."""
    return area_under_curve(np.array(curve["env_steps"], float), _values(curve, name))


def usual(curve: Mapping[str, Any], name: str) -> float | None:
    """Returns a curve's median: a threshold that keeps a target rate is far off if the median is
    near 0."""
    values = _values(curve, name)
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _values(curve: Mapping[str, Any], name: str) -> np.ndarray:
    return np.array(curve.get(name) or [None] * len(curve["env_steps"]), float)
